"""From a grid to work: which networks are compiled how, on what they run, and the commands that do the same."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from spikeloom import __version__
from spikeloom.compiler.targets.base import Target
from spikeloom.models.recordings.windows import WHOLE
from spikeloom.runtime.inputs.recordings import bin_words
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import Given
from spikeloom.runtime.studies.chart.tasks import FORMAT, Build, Data, Decide, Run
from spikeloom.runtime.studies.jobs import Point, content_key

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Storage:
    """How a network is stored on the chip.

    Parameters
    ----------
    bits : tuple of int
        Width of all layers, or of each.
    planes, groups : int
        Times that a synapse is stored, scales in a layer.
    prune : bool
        Whether neurons that never fired on training recordings are left out.
    own : bool
        Whether the network was fine-tuned for it, or trained in it.
    levels : int, optional
        Levels of weights that have no width of their own.
    """

    bits: tuple[int, ...]
    planes: int
    groups: int
    prune: bool
    own: bool = False
    levels: int | None = None

    def words(self) -> list[str]:
        """Options of ``compile`` that ask for it."""
        if self.own:
            return []
        words = [] if self.bits == (8,) else ["--weight-bits", ",".join(map(str, self.bits))]
        words += [] if self.planes == 1 else ["--planes", str(self.planes)]
        words += [] if self.groups == 1 else ["--scale-groups", str(self.groups)]
        return [*words, *(["--prune-unused"] if self.prune else [])]

    def label(self) -> str:
        """Short name: ``4b``, ``8-4-4-8b 2p 3g pruned``, ``7 levels``."""
        if self.levels is not None:
            return f"{self.levels} levels"
        words = [f"{'-'.join(map(str, self.bits))}b"]
        words += [] if self.planes == 1 else [f"{self.planes}p"]
        words += [] if self.groups == 1 else [f"{self.groups}g"]
        return " ".join([*words, *(["pruned"] if self.prune else [])])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stored:
    """A network in one storage, in all layouts of the grid.

    Parameters
    ----------
    network : Given
    storage : Storage
    build : Build
        What makes its netlists.
    key : str
        Of that work.
    """

    network: Given
    storage: Storage
    build: Build
    key: str

    def point(self) -> Point:
        """It as a point of a sweep."""
        label = f"{self.network.name} {self.storage.label()}"
        return Point(key=self.key, label=label, payload=self.build)


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What decides every result, beside what a single one is about.

    Parameters
    ----------
    data : Data
    data_sha256 : str
        Of both splits.
    targets : mapping of str to Target
        Chips, with their tables, by name.
    folder : Path
        Of the chart.
    """

    data: Data
    data_sha256: str
    targets: Mapping[str, Target]
    folder: Path

    def key(self, network: Given, **facts: Any) -> str:
        """Content key of a piece of work on a network."""
        target = repr(self.targets[network.target])
        shared = {"format": FORMAT, "spikeloom": __version__, "data": self.data_sha256, "target": target}
        return content_key(shared | {"bin_s": self.data.bin_s} | facts)


def identity(network: Given) -> Json:
    """What tells a network from others."""
    return {
        "checkpoint": network.sha256,
        "weights": network.weights,
        "sees": network.sees,
        "options": list(network.words[2:]),  # all but the name of the file
    }


def decisions(network: Given, grid: Grid, facts: Facts) -> Point:
    """Work that finds the decisions of a float network."""
    words = from_anywhere([*network.words, "-o", "x.loom"])
    work = Decide(words=words, sha256=network.sha256, data=_data(facts), windows=tuple(sorted(grid.window)))
    key = facts.key(network, what="float", **identity(network), windows=list(work.windows))
    return Point(key=key, label=f"{network.name} float", payload=work)


def storages(network: Given, grid: Grid) -> Iterator[Storage]:
    """Every storage that a grid asks for; of a network that was trained in one its own and no other."""
    forms = network.forms
    if network.levels is not None:
        yield Storage(bits=(), planes=1, groups=1, prune=False, own=True, levels=network.levels)
        return
    if forms is not None:
        bits = tuple(form.bits for form in forms)
        yield Storage(
            bits=bits[:1] if len(set(bits)) == 1 else bits,
            planes=max(len(form.exponents) for form in forms),
            groups=max(len(set(form.threshold.tolist())) for form in forms),
            prune=False,
            own=True,
        )
        return
    for bits, planes, groups, prune in product(grid.bits, grid.planes, grid.groups, grid.prune):
        yield Storage(bits=bits, planes=planes, groups=groups, prune=bool(prune))


def layouts_of(network: Given, grid: Grid) -> tuple[str, ...]:
    """Layouts that a grid asks for; crossbars have one."""
    return grid.cores if network.levels is None else Grid().cores


def stored_networks(networks: Sequence[Given], grid: Grid, facts: Facts) -> list[Stored]:
    """Every network in every storage, with the work that compiles it."""
    found = []
    for network in networks:
        for storage in storages(network, grid):
            layouts, files = {}, {}
            for layout in layouts_of(network, grid):
                layouts[layout] = from_anywhere(compile_words(network, storage, layout, facts))
                key = facts.key(network, what="netlist", **identity(network), storage=storage.words(), layout=layout)
                files[layout] = facts.folder.resolve() / "netlists" / f"{key}.loom"
            work = Build(layouts=layouts, sha256=network.sha256, files=files, data=_data(facts))
            key = facts.key(network, what="build", **identity(network), storage=storage.words(), layouts=list(layouts))
            found.append(Stored(network=network, storage=storage, build=work, key=key))
    return found


def runs(stored: Stored, layout: str, sha256: str, grid: Grid, facts: Facts) -> dict[int, Point]:
    """Work that runs a netlist, by window."""
    return {
        window: Point(
            key=facts.key(stored.network, what="run", netlist=sha256, window=window),
            label=f"{stored.network.name} {stored.storage.label()} {layout} {window}%",
            payload=Run(build=stored.build, layout=layout, sha256=sha256, window=window),
        )
        for window in grid.window
    }


# -- commands ----------------------------------------------------------------------------------------------------------


def compile_words(network: Given, storage: Storage, layout: str, facts: Facts) -> list[str]:
    """What to type after ``spikeloom`` to get a netlist."""
    calibrated = [] if storage.levels is not None else ["--calibrate", facts.data.path, *bin_words(facts.data.bin_s)]
    words = [*network.words, *storage.words(), *calibrated]
    return [*words, *layout_words(layout), "-o", file_name(network, storage, layout)]


READ = ("--calibrate", "--taxels", "--edges")
"""Options of ``compile`` that may name what is read."""


def from_anywhere(words: Sequence[str]) -> tuple[str, ...]:
    """The same words for a process that works in another folder: what they read is named by its whole path.

    Examples
    --------
    >>> from_anywhere(["compile", "pretrained:grasps", "--calibrate", "synthetic", "-o", "x.loom"])
    ('compile', 'pretrained:grasps', '--calibrate', 'synthetic', '-o', 'x.loom')
    """
    reads = {1, *(at + 1 for at, word in enumerate(words) if word in READ)}
    return tuple(_whole(word) if at in reads else word for at, word in enumerate(words))


def _whole(path: str) -> str:
    return str(Path(path).resolve()) if Path(path).exists() else path


def _data(facts: Facts) -> Data:
    return Data(path=_whole(facts.data.path), bin_s=facts.data.bin_s, sha256=facts.data_sha256)


def layout_words(layout: str) -> list[str]:
    """Options of ``compile`` that ask for a layout.

    Examples
    --------
    >>> layout_words("latency"), layout_words("fc1:6+conv1:4"), layout_words("cores")
    (['--optimize', 'latency'], ['--cores-for', 'fc1=6,conv1=4'], [])
    """
    if layout == "cores":
        return []
    if ":" in layout:
        return ["--cores-for", layout.replace(":", "=").replace("+", ",")]
    return ["--optimize", layout]


def file_name(network: Given, storage: Storage, layout: str) -> str:
    """What a netlist is called in commands."""
    words = [network.name, *storage.label().split(), *([] if layout == "cores" else [layout])]
    return "-".join(words).replace(":", "").replace("+", "-") + ".loom"


def commands(stored: Stored, layout: str, window: int, facts: Facts) -> list[str]:
    """What to type to get a point: its netlist, then its figures."""
    compiled = compile_words(stored.network, stored.storage, layout, facts)
    words = ["run", compiled[-1], "--data", facts.data.path, *bin_words(facts.data.bin_s), "--detail", "counts"]
    words += [] if window == WHOLE else ["--window", f"{window}%"]
    return [shlex.join(["spikeloom", *each]) for each in (compiled, words)]
