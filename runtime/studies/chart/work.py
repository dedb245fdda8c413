"""What a chart measures, in steps that can be kept: float decisions, netlists, and netlists on recordings.

Everything here is a function of files and of a request, so that a netlist is the file, byte for byte, that the command
``compile`` would write.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import Options, lay_out_again, to_integers, write_netlist
from spikeloom.compiler.errors import CapacityError, DataError, FormatError, ModelError
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.interpret import cut, vote
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.windows import first_part, steps_of
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import parse_cores, parse_packings, provenance
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.base import DEFAULT, Machine, Price, chip_chart, machine_for
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.chart.networks import Given, Source
from spikeloom.runtime.studies.chart.requests import SPLITS, Build, Built, Data, Decide, Run, Work, layout_options

PART = 16
"""Recordings whose float spikes are held at a time."""

Decisions = Mapping[str, Mapping[str, tuple[int, ...]]]
"""Of a float model, by split and window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ran:
    """Decisions of a netlist on one split, and its costs on a mean recording; `step_s` is of the longest step."""

    decisions: tuple[int, ...]
    synaptic_operations: float
    energy_j: Mapping[str, float]
    time_s: Mapping[str, float]
    step_s: Mapping[str, float]
    steps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RanBoth:
    """The same on both splits, and how fast the simulator is here."""

    train: Ran
    test: Ran
    recordings_per_s: float


def measure(work: Work) -> Any:
    """Do one piece of a chart's work; the JSON of `Decisions`, of `Built` by layout, or of `RanBoth`."""
    if isinstance(work, Decide):
        return encode(_decide(work))
    return encode(_build(work) if isinstance(work, Build) else _run(work))


# -- what is kept from one piece to the next ---------------------------------------------------------------------------


@lru_cache(maxsize=1)
def both_splits(data: Data, taxels: int, classes: int) -> dict[str, Recordings]:
    """Training and test recordings by split; refused if they are others than those of who asks for the work."""
    from spikeloom.models.training.protocols import data_digest

    shared: dict[str, Any] = {"classes": classes, "taxels": taxels, "bin_s": data.bin_s, "labels_for": "chart"}
    splits = {split: recordings(data.path, split, **shared) for split in SPLITS}
    if data.sha256 not in (None, data_digest(splits["train"], splits["test"])):
        raise DataError(f"{data.path}: holds other recordings than where the chart was asked for; copy those here")
    return splits


@lru_cache(maxsize=2)
def _in_steps(data: Data, taxels: int, classes: int, bins: int) -> dict[str, Recordings]:
    """The same in the steps of a network that joins bins."""
    return {split: joined_bins(each, bins) for split, each in both_splits(data, taxels, classes).items()}


@lru_cache(maxsize=2)
def _network(source: Source, sha256: str) -> LoadedNetwork:
    network = load_network(source.path, source.arguments())
    _require_same(source, network.sha256, sha256)
    return network


def _require_same(source: Source, sha256: str, wanted: str) -> None:
    if sha256 != wanted:
        raise ModelError(f"{source.path}: is another file than where the chart was asked for; copy that here")


def _chart_of(network: Given) -> Any | None:
    """What its chip does for a chart, of a network that was trained for it."""
    source = network.source
    chart = None if source.target is None else chip_chart(source.target)
    if chart is not None:
        _require_same(source, chart.trained(source.path, source.weights).sha256, network.sha256)
    return chart


@lru_cache(maxsize=1)
def _machine(path: Path, sha256: str) -> Machine | None:
    """A netlist that is kept; None if it is gone or another one."""
    return machine_for(path) if path.is_file() and sha256_of(path) == sha256 else None


# -- float model -------------------------------------------------------------------------------------------------------


def _decide(work: Decide) -> Decisions:
    """Decisions of the float32 model by split and window; one run each, since what comes later changes nothing."""
    from spikeloom.models.networks.reference import float_spikes  # torch, so only here

    source, windows = work.network.source, work.windows
    chart = _chart_of(work.network)
    if chart is not None:
        network = chart.trained(source.path, source.weights).network
        splits = both_splits(work.data, network.taxels, network.classes)
        return {split: chart.decisions(source.path, source.weights, data, windows) for split, data in splits.items()}
    loaded = _network(source, work.network.sha256)
    checkpoint, adjacency = loaded.checkpoint, loaded.adjacency
    assert checkpoint is not None, "a chart takes checkpoints"
    assert adjacency is not None, "and these have a first layer that sees something"
    decided: dict[str, dict[str, tuple[int, ...]]] = {}
    for split, data in _in_steps(work.data, checkpoint.taxels, checkpoint.classes, checkpoint.bins).items():
        counts: dict[int, list[IntArray]] = {window: [] for window in windows}
        steps = data.step_counts
        for first in range(0, len(data), PART):
            part = slice(first, first + PART)
            *_, spikes = float_spikes(checkpoint, adjacency, data.events[part]).values()
            for window in windows:
                seen = cut(spikes, steps_of(steps[part], window))
                counts[window].append(readout_counts(checkpoint.readout, checkpoint.classes, seen))
        decided[split] = {str(window): tuple(vote(np.concatenate(each)).tolist()) for window, each in counts.items()}
    return decided


# -- netlists ----------------------------------------------------------------------------------------------------------


def _build(work: Build) -> dict[str, Built]:
    """Compile what is not there; by layout."""
    source, chart = work.network.source, _chart_of(work.network)
    if chart is not None:
        try:
            return {
                layout: _built(*chart.build(source.path, source.weights, file)) for layout, file in work.files.items()
            }
        except CapacityError as error:
            return dict.fromkeys(work.files, _refused(error))
    network = _network(source, work.network.sha256)
    options = {layout: _compile_options(work, layout) for layout in work.files}
    some = next(iter(options.values()))
    sensor = network.network.input
    training = _in_steps(work.data, sensor.taxels, network.network.classes, sensor.bins)["train"]
    try:
        stored = to_integers(
            network.source,
            Options(
                forms=None if network.checkpoint is None else network.checkpoint.forms,
                packings=parse_packings(some),
                prune_unused=some.prune_unused,
                training_events=training.events,
            ),
            load_target(some.target),
        )
    except (CapacityError, ModelError) as error:
        return dict.fromkeys(work.files, _refused(error))
    built = {}
    for layout, each in options.items():
        try:
            placing = Options(
                cores_for=parse_cores(each.cores_for),
                optimize=each.optimize,
                provenance=provenance(each, network, calibrated=True),
            )
            netlist = lay_out_again(stored, placing).netlist
        except CapacityError as error:
            built[layout] = _refused(error)
            continue
        file = work.files[layout]
        file.parent.mkdir(parents=True, exist_ok=True)
        built[layout] = _built(netlist, netlist.n_compartments, write_netlist(netlist, file))
    return built


def _compile_options(work: Build, layout: str) -> argparse.Namespace:
    """What the command ``compile`` would have parsed."""
    return argparse.Namespace(
        **{name: value for name, value in vars(work.network.source.arguments()).items() if name != "target"}
        | {"target": DEFAULT}
        | {name: repeat.USUAL.get(name) for name in (*repeat.ROUNDING, *repeat.PLACING)}
        | {name: value for name, value in work.storage.options().items() if value is not None}
        | layout_options(layout)
    )


def _built(netlist: Any, neurons: int, sha256: str) -> Built:
    return Built(sha256=sha256, cores=netlist.n_cores, neurons=neurons, synapses=netlist.n_synapses)


def _refused(error: CapacityError | ModelError) -> Built:
    return Built(refused=tuple(str(error).splitlines()))


# -- netlists on recordings --------------------------------------------------------------------------------------------


def _run(work: Run) -> RanBoth:
    """What a netlist decides on both splits, what that costs, and how fast the simulator is."""
    path = work.build.files[work.layout]
    machine = _machine(path, work.built.sha256)
    if machine is None:
        _machine.cache_clear()
        _build(work.build)
        machine = _machine(path, work.built.sha256)
    if machine is None:
        raise FormatError(f"{path}: is not the netlist that was measured before; begin anew with --fresh")
    netlist, data = machine.netlist, work.build.data
    splits = _in_steps(data, netlist.taxels, netlist.classes, netlist.bins)
    parts = {split: first_part(each, work.window) for split, each in splits.items()}
    return RanBoth(
        train=_costs(machine, parts["train"], data.bin_s),
        test=_costs(machine, parts["test"], data.bin_s),
        recordings_per_s=_throughput(machine, parts["test"]),
    )


def _costs(machine: Machine, data: Recordings, bin_s: float) -> Ran:
    """Decisions, and the mean inference: operations, energy by table, time by table, the longest step."""
    steps, size = data.step_counts, machine.batch(data.steps)
    parts = [slice(first, first + size) for first in range(0, len(data), size)]
    priced = [machine.price(data.events[part], bin_s=bin_s, lengths=steps[part]) for part in parts]
    prices = [price for _, price in priced]

    def mean(of: Callable[[Price], Mapping[str, FloatArray]]) -> dict[str, float]:
        return {name: float(np.concatenate([of(price)[name] for price in prices]).mean()) for name in of(prices[0])}

    return Ran(
        decisions=tuple(np.concatenate([ran.decisions for ran, _ in priced]).tolist()),
        synaptic_operations=float(np.concatenate([price.synaptic_operations for price in prices]).mean()),
        energy_j=mean(lambda price: price.energy_j),
        time_s=mean(lambda price: price.time_s),
        step_s={name: max(0.0, *(price.step_s[name] for price in prices)) for name in prices[0].time_s},
        steps=float(steps.mean()),
    )


def _throughput(machine: Machine, data: Recordings) -> float:
    """Recordings a second on one thread, decisions only; the better of two rounds."""
    rounds = []
    for _ in range(2):
        began = time.perf_counter()
        machine.run(data.events, lengths=data.lengths, threads=1)
        rounds.append(time.perf_counter() - began)
    return len(data) / min(rounds)
