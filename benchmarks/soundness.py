"""Proofs of ``certify`` held against all inputs: how many events are proven, and how many do alter a decision.

    python benchmarks/soundness.py OUT.json

Random small networks and counting networks on random recordings; every change of up to three events that a proof says
is harmless is run from the first step to the last.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler.formats.counters import counting_network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.studies.robustness.exhaustive import certificate
from spikeloom.runtime.studies.robustness.proofs.counting import tally_of
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from made_files import CLASSES, sparse_events
from random_crossbars import random_counters
from random_networks import random_checkpoint, ring

MOST = 3
STEPS = 10
PART = 4096


def networks(count: int) -> Iterator[tuple[str, Machine, int]]:
    """Machines of both kinds, and their taxels; a network for every seed."""
    for seed in range(count):
        if seed % 4:
            drawn = random_checkpoint(seed=seed, taxels=2, features=5, sizes=(9, 8, CLASSES))
            yield "layers", machine_of(compile_network(expand(drawn, ring(2))).netlist), 2
        else:
            counters = random_counters(seed, taxels=2, classes=3)
            yield "counters", machine_of(compile_network(counting_network(counters)).netlist), 2


def altered(machine: Machine, one: Any, events: int, decision: int) -> tuple[int, int]:
    """Changes of so many events of a recording, and those of them that alter its decision; all are run."""
    cells = cells_of(one, machine.netlist)
    channels = channels_of(one[None], machine.netlist)[0]
    every = np.array(list(combinations(range(len(cells.cells)), events)))
    every = every[cells.cost[every].sum(axis=1) == events]
    wrong = 0
    for first in range(0, len(every), PART):
        part = every[first : first + PART]
        runs = np.repeat(channels[None], len(part), axis=0)
        for change in part.T:
            channel, step = cells.cells[change].T
            runs[np.arange(len(part)), channel, step] ^= 1
        wrong += int(np.count_nonzero(machine.votes(runs).argmax(axis=1) != decision))
    return len(every), wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--networks", type=int, default=40)
    arguments = parser.parse_args()
    found: dict[str, Any] = {}
    for kind, machine, taxels in networks(arguments.networks):
        row = found.setdefault(
            kind, {"networks": 0, "tried": 0, "wrong": 0, "proven": Counter(), "least": Counter()}
        )
        row["networks"] += 1
        for one in sparse_events(row["networks"], 2, taxels, 2, STEPS, rate=0.25):
            proof = certificate(machine, (one, 0, ""), shift=0, most=MOST, tally=tally_of(machine))
            alters = 0
            for events in range(1, MOST + 1):
                tried, wrong = altered(machine, one, events, proof.decision)
                if events <= proof.at_least:
                    row["tried"] += tried
                    row["wrong"] += wrong
                if wrong:
                    alters = events
                    break
            row["proven"][str(proof.at_least)] += 1
            row["least"][str(alters - 1 if alters else MOST)] += 1
    sums = {key: sum(row[key] for row in found.values()) for key in ("tried", "wrong")}
    arguments.output.write_text(json.dumps(made() | sums | {"by_kind": found}, indent=1) + "\n")
