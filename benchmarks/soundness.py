"""Proofs of ``certify`` held against all inputs: how many events are proven, and how many do alter a decision.

    python benchmarks/soundness.py OUT.json

Random small networks, their float models and counting networks on random recordings; every change of up to three events
that a proof says is harmless is run from the first step to the last.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler.formats.counters import counting_network
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.bounds.floats import laid_out
from spikeloom.runtime.studies.robustness.exhaustive import certificate
from spikeloom.runtime.studies.robustness.float_proof import verdict
from spikeloom.runtime.studies.robustness.proofs.counting import tally_of
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from made_files import CLASSES, sparse_events
from random_crossbars import random_counters
from random_networks import random_checkpoint, ring

MOST = 3
STEPS = 10
PART = 4096


Votes = Callable[[Any], Any]
"""Votes (samples, classes) of recordings (samples, channels, steps)."""

Proof = Callable[[Any], tuple[int, int]]
"""What is decided of a recording, and how many events are proven not to alter that."""


def on_chip(machine: Machine) -> tuple[Votes, Proof]:
    """How a netlist runs, and what is proven of it."""

    def prove(one: Any) -> tuple[int, int]:
        proof = certificate(machine, (one, 0, ""), shift=0, most=MOST, tally=tally_of(machine))
        return proof.decision, proof.at_least

    return machine.votes, prove


def in_floats(network: Network, netlist: Netlist) -> tuple[Votes, Proof]:
    """The same of a float model."""
    model = laid_out(network, STEPS)

    def prove(one: Any) -> tuple[int, int]:
        proof = verdict(model, netlist, MOST, one)
        return proof.decision, proof.at_least

    return partial(model.votes, classes=network.classes), prove


def networks(count: int) -> Iterator[tuple[str, Netlist, Votes, Proof]]:
    """Netlists of both kinds for 2 taxels, one for every seed, and the float model of every other."""
    for seed in range(count):
        if seed % 4:
            drawn = random_checkpoint(seed=seed, taxels=2, features=5, sizes=(9, 8, CLASSES))
            network = expand(drawn, ring(2))
            netlist = compile_network(network).netlist
            yield "layers", netlist, *on_chip(machine_of(netlist))
            alpha = 0.5 * (seed % 2)  # currents last in every other
            populations = tuple(replace(each, alpha=alpha) for each in network.populations)
            yield "float model", netlist, *in_floats(replace(network, populations=populations), netlist)
        else:
            counters = random_counters(seed, taxels=2, classes=3)
            netlist = compile_network(counting_network(counters)).netlist
            yield "counters", netlist, *on_chip(machine_of(netlist))


def altered(netlist: Netlist, votes: Votes, one: Any, events: int, decision: int) -> tuple[int, int]:
    """Changes of so many events of a recording, and those of them that alter its decision; all are run."""
    cells = cells_of(one, netlist)
    channels = channels_of(one[None], netlist)[0]
    every = np.array(list(combinations(range(len(cells.cells)), events)))
    every = every[cells.cost[every].sum(axis=1) == events]
    wrong = 0
    for first in range(0, len(every), PART):
        part = every[first : first + PART]
        runs = np.repeat(channels[None], len(part), axis=0)
        for change in part.T:
            channel, step = cells.cells[change].T
            runs[np.arange(len(part)), channel, step] ^= 1
        wrong += int(np.count_nonzero(votes(runs).argmax(axis=1) != decision))
    return len(every), wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--networks", type=int, default=40)
    arguments = parser.parse_args()
    found: dict[str, Any] = {}
    for kind, netlist, votes, prove in networks(arguments.networks):
        row = found.setdefault(
            kind, {"networks": 0, "tried": 0, "wrong": 0, "proven": Counter(), "least": Counter()}
        )
        row["networks"] += 1
        for one in sparse_events(row["networks"], 2, netlist.taxels, 2, STEPS, rate=0.25):
            decision, at_least = prove(one)
            alters = 0
            for events in range(1, MOST + 1):
                tried, wrong = altered(netlist, votes, one, events, decision)
                if events <= at_least:
                    row["tried"] += tried
                    row["wrong"] += wrong
                if wrong:
                    alters = events
                    break
            row["proven"][str(at_least)] += 1
            row["least"][str(alters - 1 if alters else MOST)] += 1
    sums = {key: sum(row[key] for row in found.values()) for key in ("tried", "wrong")}
    arguments.output.write_text(json.dumps(made() | sums | {"by_kind": found}, indent=1) + "\n")
