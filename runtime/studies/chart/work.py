"""What a chart measures: a network in one storage, in every layout, on parts of every recording.

Everything here is a function of files and of a request, so that a netlist is the file, byte for byte, that
the command ``compile`` would write. A network is rounded once for any number of layouts.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.calibrate import evenly_spaced
from spikeloom.compiler.targets.base import Target, load_target
from spikeloom.compiler.targets.compartments import (
    Compilation,
    Options,
    lay_out_again,
    to_integers,
    write_netlist,
)
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.models.recordings.conditions import by_condition
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import BIN_S, WHOLE, Recordings, first_part
from spikeloom.runtime.equivalence.reference import votes_so_far
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import parse_cores, provenance, storage_of
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import recordings, require_splits
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.requests.main_job import CompileRequest
from spikeloom.runtime.studies.chart.grid import FEWEST, Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile, Storage
from spikeloom.runtime.studies.chart.results import FORMAT, SPLITS, Figures
from spikeloom.runtime.studies.jobs import Job, content_key
from spikeloom.runtime.studies.robustness.exhaustive import share_robust_to_one_event
from spikeloom.runtime.studies.search.measure import measure as measure_costs
from spikeloom.runtime.studies.search.results import Data, Share, share

CERTIFIED = 48
"""Training recordings whose every single event is changed, evenly spaced."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Groups:
    """Names of groups as they were typed, and a hash of those of every recording."""

    words: str | None
    sha256: str


def groups_in(splits: Mapping[str, Recordings], words: str | None) -> Groups:
    """Those of recordings."""
    return Groups(
        words=words, sha256=content_key({name: dict(data.groups) for name, data in splits.items()})
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement(Job):
    """A network in one storage, the file of its netlist by layout, and parts of each recording in per cent."""

    network: NetworkFile
    storage: Storage
    files: Mapping[str, Path]
    windows: tuple[int, ...]
    data: Data
    groups: Groups
    certify: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Built:
    """Size and hash of a netlist, and its figures by window and split; or the limits that it breaks."""

    sha256: str = ""
    cores: int = 0
    neurons: int = 0
    synapses: int = 0
    figures: Mapping[int, Mapping[str, Figures]] = field(default_factory=dict)
    refused: tuple[str, ...] = ()


def measurement(
    network: NetworkFile,
    storage: Storage,
    grid: Grid,
    data: Data,
    target: Target,
    folder: Path,
    groups: Groups,
    *,
    certify: bool,
) -> Measurement:
    """Work whose key, and the names of its netlists in a folder, are of everything that decides the result."""

    def keyed(what: str, **about: Any) -> str:
        shared = {"format": FORMAT, "spikeloom": __version__, "data": data.sha256, "bin_s": data.bin_s}
        shared |= {"target": repr(target), "what": what, **network.identity, "storage": asdict(storage)}
        return content_key(shared | about)

    windows = tuple(sorted(grid.window))
    known: dict[str, Any] = {"layouts": grid.cores, "windows": windows, "groups": groups.sha256}
    return Measurement(
        key=keyed("figures", **known, **({"certified": True} if certify else {})),
        label=f"{network.name} {storage.label()}",
        network=network,
        storage=storage,
        files={
            layout: folder / "netlists" / f"{keyed('netlist', layout=layout)}.loom" for layout in grid.cores
        },
        windows=windows,
        data=data,
        groups=groups,
        certify=certify,
    )


def _layout_options(layout: str) -> JsonObject:
    """Options of ``compile`` that ask for a layout, where it is not the usual one."""
    return {} if layout == FEWEST else {"cores_for": layout.replace(":", "=").replace("+", ",")}


def commands(work: Measurement, layout: str, window: int) -> tuple[str, ...]:
    """What to type for the netlist of a network, and for its decisions and costs on a part of every recording."""
    network = work.network
    storage = work.storage
    data = work.data
    parts = [network.name, *storage.label().split(), *([] if layout == FEWEST else [layout])]
    file = "-".join(parts).replace(":", "").replace("+", "-") + ".loom"
    bin_s = None if data.bin_s == BIN_S else data.bin_s
    calibrated = {"calibrate": data.path, "bin": bin_s}
    stored = repeat.words(dict(network.options) | storage.options() | calibrated | _layout_options(layout))
    part = None if window == network.window == WHOLE else f"{window}%"
    read = repeat.words({"data": data.path, "bin": bin_s, "window": part})
    return (
        repeat.command("compile", network.path, *stored, "-o", file),
        repeat.command("run", file, *read),
        repeat.command("estimate", file, *read),
    )


def read_splits(
    path: str, bin_s: float | None, network: NetworkFile, groups: str | None = None
) -> dict[str, Recordings]:
    """Whole training and test recordings by split, in bins."""
    shared: dict[str, Any] = {"classes": network.classes, "taxels": network.taxels, "labels_for": "chart"}
    shared |= {"trained": {**origin_of(network.training), "window": WHOLE}, "groups": groups}
    require_splits(path)
    return {split: recordings(path, split, bin_s=bin_s, **shared) for split in SPLITS}


@lru_cache(maxsize=2)
def _read(data: Data, network: NetworkFile, groups: Groups) -> dict[str, Recordings]:
    return read_splits(data.path, data.bin_s, network, groups.words)


def _calibration(work: Measurement) -> Recordings:
    """The part of the training recordings that ``compile`` calibrates on, in their own bins."""
    return first_part(_read(work.data, work.network, work.groups)["train"], work.network.window)


@lru_cache(maxsize=2)
def _loaded(network: NetworkFile) -> LoadedNetwork:
    loaded = load_network(network.path, network.choice())
    if loaded.sha256 != network.sha256:
        raise ModelError(f"{network.path}: was written anew since the chart began; begin it again")
    return loaded


@lru_cache(maxsize=8)
def _decided(
    network: NetworkFile, data: Data, groups: Groups, windows: tuple[int, ...]
) -> dict[int, dict[str, IntArray]]:
    """Decisions of the float32 model by window and split."""
    loaded = _loaded(network)
    splits = _read(data, network, groups)

    def decisions(part: Recordings) -> IntArray:
        return vote(votes_so_far(loaded.network, part)[:, -1])

    return {
        window: {split: decisions(_part(network, part, window)) for split, part in splits.items()}
        for window in windows
    }


def _part(network: NetworkFile, data: Recordings, window: int) -> Recordings:
    """As long a part of each recording as a window says, in steps of the network, run as long as it says."""
    return of_length(joined_bins(first_part(data, window), network.bins), network.length)


def measure(work: Measurement) -> JsonObject:
    """Do one piece of a chart's work; the JSON of a :class:`Built` by layout."""
    loaded = _loaded(work.network)
    try:
        stored = _rounded(work, loaded)
    except (CapacityError, ModelError) as error:
        built = dict.fromkeys(work.files, Built(refused=tuple(str(error).splitlines())))
    else:
        built = {layout: _built(work, stored, layout) for layout in work.files}
    found: JsonObject = encode(built)
    return found


def _share(decisions: IntArray, wanted: IntArray) -> Share:
    return share(int(np.count_nonzero(decisions == wanted)), len(wanted))


def _built(work: Measurement, stored: Compilation, layout: str) -> Built:
    """Write the netlist of a layout and measure it."""
    request = _compile_request(work, layout)
    placing = Options(
        cores_for=parse_cores(request.cores_for),
        provenance=provenance(request, _loaded(work.network), calibrated=_calibration(work)),
    )
    try:
        netlist = lay_out_again(stored, placing).netlist
    except (CapacityError, ModelError) as error:
        return Built(refused=tuple(str(error).splitlines()))
    file = work.files[layout]
    file.parent.mkdir(parents=True, exist_ok=True)
    sha256 = write_netlist(netlist, file)
    machine = machine_of(netlist)
    splits = _read(work.data, work.network, work.groups)
    figures = {
        window: {
            split: _figures(machine, _part(work.network, splits[split], window), work.data.bin_s, decisions)
            for split, decisions in each.items()
        }
        for window, each in _decided(work.network, work.data, work.groups, work.windows).items()
    }
    if work.certify:
        for window, each in figures.items():
            rows = evenly_spaced(np.arange(len(splits["train"])), CERTIFIED)
            some = first_part(splits["train"].part(rows), window)
            each["train"] = replace(each["train"], certified=share_robust_to_one_event(machine, some))
    return Built(
        sha256=sha256,
        cores=netlist.n_cores,
        neurons=netlist.n_compartments,
        synapses=netlist.n_synapses,
        figures=figures,
    )


def _rounded(work: Measurement, loaded: LoadedNetwork) -> Compilation:
    """A network in its storage; how it is laid out is yet to be said."""
    request = _compile_request(work, FEWEST)
    options = Options(
        storage=storage_of(request, work.network.forms),
        prune_unused=request.prune_unused,
        training_events=_part(work.network, _calibration(work), WHOLE).events,
    )
    return to_integers(loaded.network, options, load_target(request.target))


def _compile_request(work: Measurement, layout: str) -> CompileRequest:
    """What is compiled for a layout; it is written by :func:`_built`."""
    stored = {name: value for name, value in work.storage.options().items() if value is not None}
    options = dict(work.network.options) | stored | _layout_options(layout)
    return CompileRequest(checkpoint=work.network.path, output="", **options)


def _figures(machine: Machine, data: Recordings, bin_s: float, decided: IntArray) -> Figures:
    """Decisions beside those of the float model, and the costs of a mean inference."""
    decisions, costs = measure_costs(machine, data, bin_s)
    return Figures(
        **asdict(_share(decisions, data.labels)),
        samples=len(data),
        model=_share(decided, data.labels),
        equal=int(np.count_nonzero(decisions == decided)),
        costs=costs,
        steps=float(data.step_counts.mean()),
        conditions={
            name: _share(decisions[those], data.labels[those]) for name, those in by_condition(data).items()
        },
    )
