"""Counters and a TactileSGNet together, whose votes are added, against counters alone.

    python benchmarks/ensemble.py DATA OUT.json [--parts 5] [--levels 5] [--epochs 30]

All of it by cross-validation in the training split: five folds, in each both are trained on the others. The network is
a TactileSGNet of the timed recipe in bins of 200 ms, as the chip runs it. Sums of counters and votes of the network are
set to unit spread over classes, recording by recording, and added; `gain` is what that has ahead of counters, with its
standard error over recordings.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import joined_bins, load_data
from spikeloom.models.training.counters import FOLDS, Plan, counted, folds, linear_rules
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.smallest.trained import Sensor, plan_of, without

JOIN = 10
STRENGTH = 0.1


def unit(votes: np.ndarray) -> np.ndarray:
    """Votes (samples, classes) of unit spread."""
    centred = votes - votes.mean(axis=1, keepdims=True)
    return centred / np.maximum(centred.std(axis=1, keepdims=True), 1e-9)


def main() -> None:
    """Cross-validate, write, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--parts", type=int, default=1)
    parser.add_argument("--levels", type=int, default=1, help="classes in a row that are levels of one thing")
    parser.add_argument("--epochs", type=int, default=30)
    arguments = parser.parse_args()
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    options = {"recipe": "timed", "join": JOIN, "features": 32, "hidden": "128,256"}
    network = plan_of(Candidate(system="tactilesgnet", options=options), Sensor(graph=build_graph("manual")), training)
    counts = counted(training, Plan(parts=arguments.parts, levels=arguments.levels))
    classes, steps = int(training.labels.max()) + 1, joined_bins(training, JOIN)
    fold = folds(training.labels, FOLDS, np.random.default_rng(0))
    sums = {name: np.zeros((len(training), classes)) for name in ("counters", "network")}
    for part in range(FOLDS):
        held = fold == part
        rule = linear_rules(counts.part(~held), classes, [STRENGTH])[STRENGTH]
        sums["counters"][held] = unit(rule.sums(counts.part(held)))
        netlist = without(network, training, held, arguments.epochs, load_target("loihi1"), None)
        sums["network"][held] = unit(machine_of(netlist).run(steps.part(held).events).votes.astype(float))
        share = {name: np.mean(each[held].argmax(axis=1) == training.labels[held]) for name, each in sums.items()}
        print(part, {name: round(float(each), 3) for name, each in share.items()}, flush=True)
    sums["both"] = sums["counters"] + sums["network"]
    right = {name: each.argmax(axis=1) == training.labels for name, each in sums.items()}
    ahead = right["both"].astype(float) - right["counters"]
    found = made(training, test) | {"data": Path(arguments.recordings).name, "recordings": len(training)}
    found["accuracy"] = {name: float(each.mean()) for name, each in right.items()}
    found["gain"] = {"mean": float(ahead.mean()), "error": float(ahead.std(ddof=1) / np.sqrt(len(ahead)))}
    with write_atomically(arguments.output) as file:
        file.write(json.dumps(found, indent=1).encode() + b"\n")
    print(found["accuracy"], found["gain"])


if __name__ == "__main__":
    main()
