"""What a chart asks its workers for, and the commands that do the same.

A network is rounded once for any number of layouts, a netlist is compiled once for any number of windows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.windows import WHOLE
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.chart.networks import Given, Storage, from_anywhere
from spikeloom.runtime.studies.jobs import Job, content_key

FORMAT = 1
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
