"""What a chart measures of networks for crossbar cores: decisions of the model, netlists, and these on recordings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.lower import lower
from spikeloom.compiler.targets.truenorth.native import NativeNetwork
from spikeloom.compiler.targets.truenorth.native_file import Trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.targets.truenorth.netlist_file import write_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import steps_of
from spikeloom.runtime.machines.truenorth import cost, engine
from spikeloom.runtime.machines.truenorth.native import provenance
from spikeloom.runtime.machines.votes import class_counts

Json = dict[str, Any]

TICK = "tick"
"""What the one length that a tick has is called among the tables of times."""

PART = 16
"""Recordings whose counts on the chip are held at a time."""


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


def measure(netlist: CrossbarNetlist, splits: Mapping[str, Recordings]) -> Json:
    """What a netlist decides on each split, what a mean inference costs, and how fast the simulator is."""
    prepared = engine.prepare(netlist)
    found: Json = {split: _costs(prepared, data) for split, data in splits.items()}
    found["recordings_per_s"] = _throughput(prepared, splits["test"])
    return found


def _costs(prepared: engine.Engine, data: Recordings) -> Json:
    netlist = prepared.netlist
    chip = load_target(netlist.target, CROSSBARS)
    own = np.full(len(data), data.steps) if data.lengths is None else data.lengths
    events = with_clocks(data.events, netlist.clocks)
    decided: list[int] = []
    operations, seconds = [], []
    energy: dict[str, list[Any]] = {}
    for first in range(0, len(data), PART):
        part = slice(first, first + PART)
        counts = engine.simulate(prepared, events[part], lengths=own[part]).counts
        costs = cost.estimate(netlist, chip, counts)
        decided += vote(class_counts(netlist, counts.votes)).tolist()
        operations.append(costs.synaptic_events.sum(axis=1))
        seconds.append(costs.time_s)
        for name, each in costs.energy.items():
            energy.setdefault(name, []).append(each.total_j)
    return {
        "decisions": decided,
        "synaptic_operations": float(np.concatenate(operations).mean()),
        "energy_j": {name: float(np.concatenate(each).mean()) for name, each in energy.items()},
        "time_s": {TICK: float(np.concatenate(seconds).mean())},
        "step_s": {TICK: netlist.bin_ticks * chip.limit("tick.length") * 1e-6},
        "steps": float(own.mean()),
    }


def _throughput(prepared: engine.Engine, data: Recordings) -> float:
    """Recordings a second, one at a time, decisions only; the better of two rounds."""
    events = with_clocks(data.events, prepared.netlist.clocks)
    rounds = []
    for _ in range(2):
        began = time.perf_counter()
        for index in range(len(data)):
            engine.simulate(prepared, events[index : index + 1, :, : data.steps_of(index)])
        rounds.append(time.perf_counter() - began)
    return len(data) / min(rounds)
