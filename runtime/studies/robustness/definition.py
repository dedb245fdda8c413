"""What a perturbation is: a function with a name, a unit and a line for people; drawn, or all its cases."""

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import EventArray, FloatArray
from spikeloom.runtime.studies.robustness.pair import Pair

Events = EventArray
Level = int | float

TAXELS = "taxels"
"""Unit of levels of which a sensor has only so many."""

TAXEL = "taxel"
"""Unit of cases that are a single one of them."""

BINS = "bins"

Obstacle = Callable[[Pair], str | None]

Case = tuple[tuple[int, ...], Events]
"""Numbers of taxels, or of bins, and what becomes of a recording (taxels, polarities, bins)."""


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One kind of trouble; the first line of its function's documentation is what people read of it."""

    act: Callable[..., Any]
    unit: str

    @property
    def what(self) -> str:
        """A line for people."""
        line = str(inspect.getdoc(self.act)).partition("\n")[0].removesuffix(".")
        return line[0].lower() + line[1:]

    @property
    def to(self) -> str:
        """What it is done to: the name of its function's first parameter."""
        return self._takes[0]

    @property
    def _takes(self) -> list[str]:
        return list(inspect.signature(self.act).parameters)

    def __call__(self, *arguments: Any) -> Any:
        """The function itself."""
        return self.act(*arguments)


@dataclass(frozen=True, slots=True)
class Sampled(Perturbation):
    """One that is drawn by chance, or has one case a level; its levels from mild to harsh.

    Its function takes what it is done to, first: `events`, a `memory` of a chip, or a `bench` of which
    recordings follow each other in another way; then the level; then, if it needs them, `distance` between
    taxels, (taxels, taxels), and `rng`, a source of chance.
    """

    levels: tuple[Level, ...]
    least: float
    most: float
    obstacle: Obstacle | None

    @property
    def name(self) -> str:
        """That of the function."""
        return self.act.__name__

    @property
    def seeded(self) -> bool:
        """Whether chance has a part in it."""
        return "rng" in self._takes

    def done(self, to: Any, level: Any, distance: FloatArray, rng: np.random.Generator) -> Any:
        """What becomes of events, a memory or a bench."""
        known = {"distance": distance, "rng": rng}
        return self.act(to, level, *(known[name] for name in self._takes[2:]))

    def why_not(self, pair: Pair) -> str | None:
        """Why it makes no sense for a network, or None where it does."""
        if self.to == "memory" and pair.memory is None:
            return "what the chip stores cannot be damaged"
        return None if self.obstacle is None else self.obstacle(pair)

    def level_of(self, words: str) -> Level:
        """Read a level; refused if it is none that makes sense."""
        try:
            level = float(words)
        except ValueError:
            level = float("nan")
        whole = all(isinstance(each, int) for each in self.levels)
        if not self.least <= level <= self.most or (whole and level != int(level)):
            kind = "a whole number" if whole else "a number"
            limits = f"from {self.least:g}" + ("" if self.most == np.inf else f" to {self.most:g}")
            raise OptionError(
                f"{self.name}:{words}: {words!r} is no level of it; give {kind} {limits} ({self.unit})"
            )
        return int(level) if level == int(level) else level

    def levels_of(self, taxels: int, also: Sequence[Level] = ()) -> tuple[Level, ...]:
        """Levels to measure on a sensor of so many taxels, further ones among them."""
        levels = [level for level in self.levels if self.unit != TAXELS or level <= taxels]
        return tuple(sorted({*levels, *also}, reverse=self.levels[0] > self.levels[-1]))


@dataclass(frozen=True, slots=True)
class Exhaustive(Perturbation):
    """One of which every case is decided.

    Its function takes one recording, `events` (taxels, polarities, bins), and if it needs it `shift`, how
    many bins that is moved by at most; it gives all cases, the smallest first. Or it takes `there`, which
    entries of a recording hold an event, and gives those that are flipped, each alone.
    """

    @property
    def name(self) -> str:
        """That of the function, in words."""
        return self.act.__name__.replace("_", " ")

    @property
    def sized(self) -> bool:
        """Whether cases are larger or smaller: by so many bins."""
        return self.unit == BINS

    def cases(self, events: Events, shift: int) -> Iterator[Case]:
        """All of one recording."""
        yield from self.act(events, *([shift] if "shift" in self._takes else []))

    def words(self, numbers: tuple[int, ...]) -> str:
        """Which case it is."""
        if self.sized:
            return f"{numbers[0]} bins"
        return f"taxel{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"


def sampled(
    unit: str,
    levels: tuple[Level, ...],
    *,
    least: float = 0,
    most: float = 1,
    unless: Obstacle | None = None,
) -> Callable[[Callable[..., Any]], Sampled]:
    """Make a function a perturbation that is drawn.

    Levels are counted in `unit` and lie between `least` and `most`; `unless` says why it makes no sense
    for a network.
    """
    return partial(Sampled, unit=unit, levels=levels, least=least, most=most, obstacle=unless)


def exhaustive(unit: str) -> Callable[[Callable[..., Any]], Exhaustive]:
    """Make a function a perturbation of which every case is decided, counted in `unit`."""
    return partial(Exhaustive, unit=unit)
