"""What it takes and what it costs to lead the sums of a trained network through 20 ticks a data step.

    python benchmarks/truenorth_in_time.py DATA OUT.json CHECKPOINT [--graph manual]

What follows the checkpoint are options of compile that name the network.
Every layer forgets within a step, whatever the network was trained with. Test accuracy of the float network as it was
trained and history-free, then of what ``compile --in-time`` places, for each number of axons an input: with partial
sums that saturate at 19 and with such that do not, the share of those that do by layer, and the largest of all.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.interpret import channels_last, run_float, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.codebook import COPIES, MOST, LevelNetwork, PartialSums, in_levels, run_levels
from spikeloom.compiler.targets.truenorth.in_time import lower_in_time
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.cli import build_parser
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.votes import readout_counts

ENDLESS = 1 << 30
"""More than any partial sum."""


def float_right(network: Network, data: Recordings) -> int:
    """Test recordings that the float network decides rightly."""
    right = 0
    for index in range(len(data)):
        events = channels_last(data.events[index : index + 1, ..., : data.steps_of(index)])
        spikes = run_float(network, events).spikes[network.readout.population]
        right += int(vote(readout_counts(network.readout, network.classes, spikes))[0] == data.labels[index])
    return right


def level_right(network: LevelNetwork, data: Recordings, most: int) -> tuple[int, list[PartialSums]]:
    """The same for a network in levels, and its partial sums."""
    sums, right = [], 0
    for index in range(len(data)):
        events = data.events[index].reshape(-1, data.steps)[:, : data.steps_of(index)]
        spikes, counts = run_levels(network, events, most=most)
        last = spikes[network.layers[-1].name].sum(axis=0)
        votes = np.bincount(network.label, weights=last, minlength=network.classes)
        right += int(votes.argmax() == data.labels[index])
        sums.append(counts)
    return right, [reduce(add, each) for each in zip(*sums, strict=True)]


def main() -> None:
    """Measure and write."""
    data_path, output, *words = sys.argv[1:]
    arguments = build_parser().parse_args(["compile", *words, "-o", "unused.loom"])
    network, chip = load_network(arguments.checkpoint, arguments).network, load_target("truenorth")
    forgetful = replace(network, populations=tuple(replace(p, beta=0.0, alpha=0.0) for p in network.populations))
    read = {"classes": network.classes, "taxels": network.input.taxels}
    training, data = (recordings(data_path, split, **read) for split in ("train", "test"))
    found = made(training, data) | {"test_samples": len(data)}
    found |= {"float": float_right(network, data), "history_free": float_right(forgetful, data), "axons": {}}
    for copies in COPIES:
        levels = in_levels(forgetful, copies, chip)
        netlist = lower_in_time(levels, chip)
        right, sums = level_right(levels, data, MOST)
        endless, _ = level_right(levels, data, ENDLESS)
        found["axons"][copies] = {
            "cores": netlist.n_cores,
            "ticks": netlist.ticks(data.steps),
            "right": right,
            "right_without_saturation": endless,
            "saturated": {each.layer: each.saturated / each.partial for each in sums},
            "largest": max(each.largest for each in sums),
        }
    with write_atomically(output) as file:
        file.write((json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
