"""What a chart asks of networks that were trained for the chip: facts, decisions of the model, netlists."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.truenorth.native import SYSTEM, highest_level
from spikeloom.compiler.targets.truenorth.native_file import Trained, read_trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, write_crossbars
from spikeloom.compiler.targets.truenorth.passes import Options
from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import steps_of
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.machines.truenorth.commands import provenance
from spikeloom.runtime.machines.truenorth.cost import TICK

NAME = "truenorth"


def times(chip: Target) -> dict[str, str]:
    """What is known of the chip's time, by name."""
    return {TICK: f"{chip.title}: every tick takes {chip.limit('tick.length')} µs, whatever happens in it"}


@lru_cache(maxsize=2)
def trained(path: str, weights: str | None) -> Trained:
    """The network of a file."""
    return read_trained(shipped(path), weights=weights)


def facts(path: str, weights: str | None) -> JsonObject:
    """What a chart says of a network: it knows everything but its weights itself."""
    found = trained(path, weights)
    network = found.network
    return {
        "target": NAME,
        "graph": found.graph,
        "sha256": found.sha256,
        "weights": found.weights,
        "system": SYSTEM,
        "taxels": network.taxels,
        "classes": network.classes,
        "layers": tuple(stage.name for stage in network.stages),
        "training": found.training,
        "levels": 2 * highest_level(network.copies) + 1,
    }


def votes(path: str, weights: str | None, data: Recordings, windows: Sequence[int]) -> dict[int, IntArray]:
    """Votes of the model, in torch, when parts of each recording have passed, by window in per cent."""
    from spikeloom.models.truenorth.network import votes_by_step  # torch, so only here

    network, counts = trained(path, weights).network, {window: list[IntArray]() for window in windows}
    for index in range(len(data)):
        steps = data.steps_of(index)
        added = votes_by_step(network, data.events[index : index + 1, ..., :steps]).cumsum(axis=0)
        for window in windows:
            counts[window].append(added[int(steps_of(np.array([steps]), window)[0]) - 1])
    return {window: np.stack(each) for window, each in counts.items()}


def build(path: str, weights: str | None, file: Path) -> tuple[CrossbarNetlist, int, str]:
    """Place a network and write it; the netlist, its neurons, the hash of its file; or CapacityError."""
    found, chip = trained(path, weights), load_target(NAME)
    netlist: CrossbarNetlist = chip.compile(found.network, Options(provenance=provenance(found))).netlist
    return netlist, netlist.n_neurons, write_crossbars(netlist, file)
