"""What a chart measures, in steps that can be kept: float decisions, netlists, and netlists on recordings.

Everything here is a function of files and of a request, so that a netlist is the file, byte for byte, that the command
``compile`` would write. A network is rounded once for any number of layouts, a netlist is compiled once for any number
of windows.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import Options, __version__, lay_out_again, to_integers, write_netlist
from spikeloom.compiler.errors import CapacityError, DataError, FormatError, ModelError
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.types import FloatArray, JsonObject
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import Recordings, data_digest
from spikeloom.models.recordings.windows import WHOLE, first_part, steps_of
from spikeloom.runtime.equivalence.reference import votes_so_far
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import parse_cores, parse_packings, provenance
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.base import DEFAULT, Machine, Price, chip_chart, machine_for
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.chart.networks import Given, Source, Storage, from_anywhere
from spikeloom.runtime.studies.jobs import Job, content_key

FORMAT = 2
"""Of what is measured; goes up when a figure means something else."""

SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Where recordings are, seconds of a bin, and the hash over both splits that every process must find."""

    path: str
    bin_s: float
    sha256: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decide(Job):
    """Decisions of a float model when parts of each recording have passed, in per cent."""

    network: Given
    data: Data
    windows: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Build(Job):
    """A network in one storage, rounded once for several layouts, and the file that keeps each netlist."""

    network: Given
    storage: Storage
    files: Mapping[str, Path]
    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class Built:
    """Size and hash of a netlist, or the limits that it breaks."""

    sha256: str = ""
    cores: int = 0
    neurons: int = 0
    synapses: int = 0
    refused: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(Job):
    """A netlist, with what makes it should its file be gone, on a part of every recording."""

    build: Build
    layout: str
    built: Built
    window: int


Work = Decide | Build | Run


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What decides every result, beside what a single one is about."""

    data: Data
    targets: Mapping[str, Target]
    folder: Path

    def _key(self, network: Given, what: str, **about: Any) -> str:
        shared = {"format": FORMAT, "spikeloom": __version__, "data": self.data.sha256, "bin_s": self.data.bin_s}
        return content_key(shared | {"target": repr(self.targets[network.target]), "what": what} | encode(about))

    @property
    def _data(self) -> Data:
        return replace(self.data, path=str(from_anywhere(self.data.path)))

    def decide(self, network: Given, windows: tuple[int, ...]) -> Decide:
        """Work that finds the decisions of a float network."""
        key = self._key(network, "float", **network.identity, windows=windows)
        travelling = network.from_anywhere()
        return Decide(key=key, label=f"{network.name} float", network=travelling, data=self._data, windows=windows)

    def build(self, network: Given, storage: Storage, layouts: tuple[str, ...]) -> Build:
        """Work that compiles a network in a storage."""
        about = network.identity | {"storage": storage}
        folder = self.folder.resolve() / "netlists"
        names = {layout: self._key(network, "netlist", **about, layout=layout) for layout in layouts}
        return Build(
            key=self._key(network, "build", **about, layouts=layouts),
            label=f"{network.name} {storage.label()}",
            network=network.from_anywhere(),
            storage=storage,
            files={layout: folder / f"{name}.loom" for layout, name in names.items()},
            data=self._data,
        )

    def run(self, build: Build, layout: str, built: Built, window: int) -> Run:
        """Work that measures a netlist."""
        key = self._key(build.network, "run", netlist=built.sha256, window=window)
        label = f"{build.label} {layout} {window}%"
        return Run(key=key, label=label, build=build, layout=layout, built=built, window=window)


# -- commands ----------------------------------------------------------------------------------------------------------


def layout_options(layout: str) -> JsonObject:
    """Options of ``compile`` that ask for a layout, where it is not the usual one.

    Examples
    --------
    >>> layout_options("latency"), layout_options("fc1:6+conv1:4"), layout_options("cores")
    ({'optimize': 'latency'}, {'cores_for': 'fc1=6,conv1=4'}, {})
    """
    if layout == "cores":
        return {}
    if ":" in layout:
        return {"cores_for": layout.replace(":", "=").replace("+", ",")}
    return {"optimize": layout}


def commands(network: Given, storage: Storage, layout: str, window: int, data: Data) -> tuple[str, str]:
    """What to type for the netlist of a network, and for its figures on a part of every recording."""
    parts = [network.name, *storage.label().split(), *([] if layout == "cores" else [layout])]
    file = "-".join(parts).replace(":", "").replace("+", "-") + ".loom"
    calibrated = {} if storage.levels is not None else {"calibrate": data.path, "bin": data.bin_s}
    stored = repeat.words(network.source.options() | storage.options() | calibrated | layout_options(layout))
    part = None if window == WHOLE else f"{window}%"
    read = repeat.words({"data": data.path, "bin": data.bin_s, "detail": "counts", "window": part})
    return repeat.command("compile", network.source.path, *stored, "-o", file), repeat.command("run", file, *read)


# -- results -----------------------------------------------------------------------------------------------------------

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


def measure(work: Work) -> Any:
    """Do one piece of a chart's work; the JSON of `Decisions`, of `Built` by layout, or of `Ran` by split."""
    if isinstance(work, Decide):
        return encode(_decide(work))
    return encode(_build(work) if isinstance(work, Build) else _run(work))


# -- what is kept from one piece to the next ---------------------------------------------------------------------------


@lru_cache(maxsize=1)
def both_splits(data: Data, taxels: int, classes: int) -> dict[str, Recordings]:
    """Training and test recordings by split; refused if they are others than those of who asks for the work."""
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
    source, windows = work.network.source, work.windows
    chart = _chart_of(work.network)
    if chart is not None:
        network = chart.trained(source.path, source.weights).network
        splits = both_splits(work.data, network.taxels, network.classes)
        return {split: chart.decisions(source.path, source.weights, data, windows) for split, data in splits.items()}
    loaded = _network(source, work.network.sha256)
    readout, classes = loaded.network.readout, loaded.network.classes
    decided = {}
    for split, data in _in_steps(work.data, loaded.network.input.taxels, classes, loaded.network.input.bins).items():
        votes, steps = votes_so_far(readout, classes, loaded.model, data), data.step_counts
        seen = {window: votes[np.arange(len(data)), steps_of(steps, window) - 1] for window in windows}
        decided[split] = {str(window): tuple(vote(each).tolist()) for window, each in seen.items()}
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
            network.model,
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


def _run(work: Run) -> dict[str, Ran]:
    """What a netlist decides on both splits, and what that costs."""
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
    return {split: _costs(machine, first_part(each, work.window), data.bin_s) for split, each in splits.items()}


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
