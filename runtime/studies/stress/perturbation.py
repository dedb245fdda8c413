"""What a perturbation is: a function that does something to recordings or to a network, and how much of it to do."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import build_graph
from spikeloom.runtime.studies.stress.pair import Pair

Events = npt.NDArray[np.uint8]

Level = int | float | str

TAXELS = "taxels"
"""Unit of levels of which a sensor has only so many."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensor:
    """What perturbations must know beside the network."""

    # (taxels, taxels) float64; in millimetres, or in steps on the graph where positions are not known
    distance: FloatArray
    places: FloatArray | None  # (taxels, dimensions) float64, or None; positions in millimetres
    edges: IntArray | None  # (edges, 2) int64, or None; graph that the network was trained on
    checkpoint: Checkpoint | None  # What the network was made from; None for an ONNX or NIR file

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return len(self.distance)


Obstacle = Callable[[Pair, Sensor], str | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Perturbation:
    """One kind of trouble, its levels from mild to harsh, and which others make sense.

    Its function takes what it is done to, first: `events`, a `pair`, or a `bench` of which recordings follow each other
    in another way; then the level; then `sensor` and `rng`, a source of chance, if it needs them.
    """

    act: Callable[..., Any]
    unit: str
    levels: tuple[Level, ...]
    least: float
    most: float
    obstacle: Obstacle | None

    @property
    def name(self) -> str:
        """That of the function."""
        return self.act.__name__

    @property
    def what(self) -> str:
        """A line for people."""
        line = str(inspect.getdoc(self.act)).partition("\n")[0].removesuffix(".")
        return line[0].lower() + line[1:]

    @property
    def seeded(self) -> bool:
        """Whether chance has a part in it."""
        return "rng" in self._takes

    @property
    def to(self) -> str:
        """What it is done to: ``events``, ``pair`` or ``bench``."""
        return self._takes[0]

    @property
    def _takes(self) -> list[str]:
        return list(inspect.signature(self.act).parameters)

    def __call__(self, *arguments: Any) -> Any:
        """The function itself."""
        return self.act(*arguments)

    def done(self, to: Any, level: Any, sensor: Sensor, rng: np.random.Generator) -> Any:
        """What becomes of events, a pair or a bench."""
        known = {"sensor": sensor, "rng": rng}
        return self.act(to, level, *(known[name] for name in self._takes[2:]))

    def why_not(self, pair: Pair, sensor: Sensor) -> str | None:
        """Why it makes no sense for a network, or None where it does."""
        return None if self.obstacle is None else self.obstacle(pair, sensor)

    def level_of(self, words: str) -> Level:
        """Read a level; refused if it is none that makes sense."""
        if isinstance(self.levels[0], str):
            return build_graph(words).name
        try:
            level = float(words)
        except ValueError:
            level = float("nan")
        whole = all(isinstance(each, int) for each in self.levels)
        if not self.least <= level <= self.most or (whole and level != int(level)):
            kind = "a whole number" if whole else "a number"
            limits = f"from {self.least:g}" + ("" if self.most == np.inf else f" to {self.most:g}")
            raise OptionError(f"{self.name}:{words}: {words!r} is no level of it; give {kind} {limits} ({self.unit})")
        return int(level) if level == int(level) else level

    def levels_of(self, taxels: int, *, full: bool, also: Sequence[Level] = ()) -> tuple[Level, ...]:
        """Levels to measure on a sensor of so many taxels, further ones among them; with `full` those between, too."""
        levels = list(self.levels)
        if full and not isinstance(levels[0], str):
            between = [float(f"{(float(a) + float(b)) / 2:.2g}") for a, b in pairwise(levels)]
            levels += [int(level) for level in between] if isinstance(levels[0], int) else between
        if self.unit == TAXELS:
            levels = [level for level in levels if float(level) <= taxels]
        every = list(dict.fromkeys([*levels, *also]))
        if isinstance(levels[0], str):
            return tuple(every)
        return tuple(sorted(every, key=float, reverse=float(self.levels[0]) > float(self.levels[-1])))


def perturbation(
    unit: str, levels: tuple[Level, ...], *, least: float = 0, most: float = 1, unless: Obstacle | None = None
) -> Callable[[Callable[..., Any]], Perturbation]:
    """Make a function a perturbation; the first line of its documentation is what people read of it.

    Levels are counted in `unit` and lie between `least` and `most`; `unless` says why it makes no sense for a network.
    """

    def made(act: Callable[..., Any]) -> Perturbation:
        return Perturbation(act=act, unit=unit, levels=levels, least=least, most=most, obstacle=unless)

    return made
