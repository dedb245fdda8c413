"""What a chart measures of networks for crossbar cores: decisions of the model, netlists, and these on recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.lower import lower
from spikeloom.compiler.targets.truenorth.native import NativeNetwork
from spikeloom.compiler.targets.truenorth.native_file import Trained
from spikeloom.compiler.targets.truenorth.netlist_file import write_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import steps_of
from spikeloom.runtime.machines.truenorth.commands import provenance

Json = dict[str, Any]


def time_title(chip: Target) -> str:
    """What is known of a chip's time."""
    return f"{chip.title}: every tick takes {chip.limit('tick.length')} µs, whatever happens in it"


def model_decisions(network: NativeNetwork, data: Recordings, windows: Sequence[int]) -> dict[str, list[int]]:
    """Decisions of the model, in torch, when parts of each recording have passed, by window in per cent."""
    from spikeloom.models.truenorth.network import run_network  # torch, so only here

    last = network.towers[0][-1].name
    counts: dict[int, list[IntArray]] = {window: [] for window in windows}
    for index in range(len(data)):
        own = data.steps_of(index)
        votes = run_network(network, data.events[index : index + 1, ..., :own])[last][0]
        added = votes.reshape(own, -1, network.classes).sum(axis=1).cumsum(axis=0)
        for window in windows:
            counts[window].append(added[int(steps_of(np.array([own]), window)[0]) - 1])
    return {str(window): vote(np.stack(each)).tolist() for window, each in counts.items()}


def build(trained: Trained, file: Path) -> Json:
    """Place a network, write it, and tell its size and hash.

    Raises
    ------
    CapacityError
        If it does not fit.
    """
    chip = load_target("truenorth", CROSSBARS)
    netlist = lower(trained.network, chip, provenance=provenance(trained))
    require_legal(netlist, chip)
    file.parent.mkdir(parents=True, exist_ok=True)
    return {
        "sha256": write_crossbars(netlist, file),
        "cores": netlist.n_cores,
        "neurons": netlist.n_neurons,
        "synapses": netlist.n_synapses,
    }
