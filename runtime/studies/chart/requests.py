"""What a chart asks its workers for, and the commands that do the same.

A network is rounded once for any number of layouts, a netlist is compiled once for any number of windows.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.windows import WHOLE
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.jobs import content_key

FORMAT = 1
"""Of what is measured; goes up when a figure means something else."""

SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A network's file and the options of :func:`options.add_model` that it is read with.

    `target` is the chip of a network that was trained for one.
    """

    path: str
    graph: str | None = None
    taxels: str | None = None
    edges: str | None = None
    directed: bool = False
    system: str | None = None
    run: int = 0
    weights: str | None = None
    beta: float | None = None
    theta: float | None = None
    target: str | None = None

    def options(self) -> JsonObject:
        """All but the file."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "path"}

    def arguments(self) -> argparse.Namespace:
        """As a command would have parsed them."""
        others = dict.fromkeys(("polarities", "polarities_first", "dt", "convention"))
        return argparse.Namespace(**self.options(), **others)

    def from_anywhere(self) -> Source:
        """The same for a process that works in another folder."""
        taxels, edges = (path and whole(path) for path in (self.taxels, self.edges))
        return replace(self, path=whole(self.path), taxels=taxels, edges=edges)


@dataclass(frozen=True, slots=True, kw_only=True)
class Storage:
    """How a network is stored on the chip: width of all layers or of each, planes, scale groups, pruning.

    It is a network's own if it was fine-tuned for it or trained in it; weights that have no width have `levels`.
    """

    bits: tuple[int, ...]
    planes: int
    groups: int
    prune: bool
    own: bool = False
    levels: int | None = None

    def options(self) -> JsonObject:
        """Options of ``compile`` that ask for it, where it is not the usual one."""
        if self.own:
            return {}
        return {
            "weight_bits": None if self.bits == (8,) else ",".join(map(str, self.bits)),
            "planes": None if self.planes == 1 else str(self.planes),
            "scale_groups": None if self.groups == 1 else str(self.groups),
            "prune_unused": self.prune,
        }

    def label(self) -> str:
        """Short name: ``4b``, ``8-4-4-8b 2p 3g pruned``, ``7 levels``."""
        if self.levels is not None:
            return f"{self.levels} levels"
        parts = [f"{'-'.join(map(str, self.bits))}b"]
        parts += [] if self.planes == 1 else [f"{self.planes}p"]
        parts += [] if self.groups == 1 else [f"{self.groups}g"]
        return " ".join([*parts, *(["pruned"] if self.prune else [])])


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Where recordings are, seconds of a bin, and the hash over both splits that every process must find."""

    path: str
    bin_s: float
    sha256: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decide:
    """Decisions of a float model when parts of each recording have passed, in per cent."""

    source: Source
    sha256: str
    data: Data
    windows: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """A network in one storage, rounded once for several layouts, and the file that keeps each netlist."""

    source: Source
    sha256: str
    storage: Storage
    files: Mapping[str, Path]
    data: Data


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A netlist, with what makes it should its file be gone, on a part of every recording."""

    build: Build
    layout: str
    sha256: str
    window: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What decides every result, beside what a single one is about."""

    data: Data
    targets: Mapping[str, Target]
    folder: Path

    @property
    def data_anywhere(self) -> Data:
        """The recordings for a process that works in another folder."""
        return replace(self.data, path=whole(self.data.path))

    def key(self, target: str, **about: Any) -> str:
        """Content key of a piece of work for a chip."""
        shared = {"format": FORMAT, "spikeloom": __version__, "data": self.data.sha256, "bin_s": self.data.bin_s}
        return content_key(shared | {"target": repr(self.targets[target])} | encode(about))


def whole(path: str) -> str:
    """A path that means the same in another folder."""
    return str(Path(path).resolve()) if Path(path).exists() else path


# -- commands ----------------------------------------------------------------------------------------------------------


def compile_command(name: str, source: Source, storage: Storage, layout: str, data: Data) -> tuple[str, str]:
    """What to type for the netlist of a network of this name, and the name of the file that this writes."""
    parts = [name, *storage.label().split(), *([] if layout == "cores" else [layout])]
    file = "-".join(parts).replace(":", "").replace("+", "-") + ".loom"
    calibrated = {} if storage.levels is not None else {"calibrate": data.path, "bin": data.bin_s}
    options = source.options() | storage.options() | calibrated | layout_options(layout)
    return repeat.command("compile", source.path, *repeat.words(options), "-o", file), file


def run_command(file: str, window: int, data: Data) -> str:
    """What to type for the figures of a netlist."""
    part = None if window == WHOLE else f"{window}%"
    options = {"data": data.path, "bin": data.bin_s, "detail": "counts", "window": part}
    return repeat.command("run", file, *repeat.words(options))
