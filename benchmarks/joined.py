"""How right networks of one training recipe are alone and joined, as float model and on the chip.

    python benchmarks/joined.py DATA OUT.json --towers 5 s0.pt s1.pt …

Members are taken in the order given, so many at a time, each once: joined networks share no member. Scales are chosen
on training recordings; test recordings are only reported, except that the epoch *best* was chosen on them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
from made import made
from paper.measured import float_decisions

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.tensors import join
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.recordings.events import joined_bins, load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.votes import predictions
from spikeloom.runtime.report.numbers import of_mean

Json = dict[str, Any]

WEIGHTS = ("last", "clean", "best")


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("members", nargs="+")
    parser.add_argument("--towers", type=int, action="append", help="members of a joined network (default: 5)")
    parser.add_argument("--weights", choices=WEIGHTS, action="append", help="epochs to take (default: all three)")
    parser.add_argument("--float-only", action="store_true", help="leave the chip away")
    arguments = parser.parse_args()
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    found: Json = made(training, test) | {"data": Path(arguments.recordings).name, "test_samples": len(test)}
    for weights in arguments.weights or WEIGHTS:
        members = [read_checkpoint(path, weights=weights) for path in arguments.members]
        of_weights: Json = {"1": _summary([_decided(member, test) for member in members])}
        for towers in arguments.towers or [5]:
            groups = [members[i : i + towers] for i in range(0, len(members) - towers + 1, towers)]
            joined = [join(group, arguments.members[:towers]) for group in groups]
            of_weights[str(towers)] = _summary(
                [_decided(one, test) if arguments.float_only else measured(one, training, test) for one in joined]
            )
            print(weights, towers, json.dumps(of_weights[str(towers)]["mean"]), file=sys.stderr)
        found[weights] = of_weights
        arguments.output.write_text(json.dumps(found, indent=1) + "\n")


def _decided(network: Checkpoint, test: Recordings) -> Json:
    """Recordings that the float model has right."""
    test = joined_bins(test, network.bins)
    _, adjacency = propagation(network, None, "member")
    return {"float": int(np.sum(float_decisions(network, adjacency, test) == test.labels))}


def measured(network: Checkpoint, training: Recordings, test: Recordings, *, spike_exact: bool = False) -> Json:
    """Float model and chip at 8 bits."""
    training, test = (joined_bins(each, network.bins) for each in (training, test))
    _, adjacency = propagation(network, None, "joined")
    decided = float_decisions(network, adjacency, test)
    compilation = compile_network(
        expand(network, adjacency), Options(training_events=training.events, spike_exact=spike_exact)
    )
    netlist = compilation.netlist
    events = with_clocks(test.events, netlist.clocks)
    trace, costs = estimate(netlist, load_target("loihi1"), events, lengths=test.lengths)
    chip = predictions(netlist, trace.counts.spikes)
    return {
        "float": int(np.sum(decided == test.labels)),
        "chip": int(np.sum(chip == test.labels)),
        "equal": int(np.sum(chip == decided)),
        "cores": netlist.n_cores,
        "synaptic_operations": float(costs.costs.synaptic_operations.sum(axis=1).mean()),
        "energy_j": {name: float(each.sum(axis=1).mean()) for name, each in costs.costs.energy.items()},
    }


def _summary(networks: list[Json]) -> Json:
    """All networks, and mean, deviation and Student's 95 % interval of what they have right."""
    mean: Json = {}
    for key in ("float", "chip"):
        right = [network[key] for network in networks if key in network]
        if len(right) > 1:
            low, high = of_mean(right)
            mean[key] = {"mean": statistics.mean(right), "std": statistics.stdev(right), "interval": [low, high]}
    return {"networks": networks, "mean": mean}


if __name__ == "__main__":
    main()
