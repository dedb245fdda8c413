"""Search for the cores of a network on which a step is expected to be shortest.

The integer network is not changed: which neuron sits where has no influence on any spike. Every number of cores of
every layer is too much to try, so the search is greedy; it is deterministic, and ends when nothing near is better.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.loihi1.layout.chips import chip_tiles
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk
from spikeloom.compiler.targets.loihi1.layout.forecast import Forecast
from spikeloom.compiler.targets.loihi1.layout.partition import chunks_of, cut, cut_layer
from spikeloom.compiler.types import FloatArray, IntArray

SHORTER = 0.9
"""Each time that the search cuts for is this share of the one before."""

STRIDES = (-3, -2, -1, 1, 2, 3)
"""Changes of a layer's cores that are tried around the best layout, counted in useful numbers of cores."""

WORTH = 1e-3
"""Share of a step's time that a core more has to save."""


def tiles_for(forecast: Forecast, cores: int) -> int:
    """Most tiles for which the barrier is as short as for the fewest that hold so many cores."""
    fewest = _fewest_tiles(forecast, cores)
    shortest, most = forecast.time.barrier(fewest), chip_tiles(forecast.needs.target)
    return max(tiles for tiles in range(fewest, most + 1) if forecast.time.barrier(tiles) == shortest)


def _fewest_tiles(forecast: Forecast, cores: int) -> int:
    return -(-cores // forecast.needs.target.limit("mesh.tile_cores"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """Layers cut evenly, each chunk on a core of its own."""

    chunks: list[Chunk]
    step: float  # Expected picoseconds of a step, on as few tiles as can be
    critical: int  # Population that takes longest in most steps
    longest: float  # Mean picoseconds of the slowest core of the slowest layer

    @property
    def score(self) -> float:
        """What is made small."""
        return self.step * (1 + WORTH * len(self.chunks))


_Cut = tuple[list[Chunk], FloatArray, dict[int, IntArray]]
"""Chunks of a layer, picoseconds of the slowest, shape (steps,), and output axons that its sources need."""


def _useful(size: int, most: int) -> list[int]:
    """Numbers of chunks, up to `most`, whose largest is smaller than with fewer chunks.

    Examples
    --------
    >>> _useful(20, 12)
    [1, 2, 3, 4, 5, 7, 10]
    """
    return sorted({parts for largest in range(1, size + 1) if (parts := -(-size // largest)) <= most})


class _Search:
    """Cuts that were tried, layer by layer: a layer's depends on nothing but the output axons that it needs."""

    def __init__(self, forecast: Forecast) -> None:
        self.forecast, self.needs = forecast, forecast.needs
        self.most = self.needs.target.limit("chip.cores")
        self.useful = [_useful(population.size, self.most) for population in self.needs.network.populations]
        self._cuts: dict[tuple[int, int, bytes], _Cut | None] = {}

    def _cut(self, population: int, least: int) -> _Cut | None:
        """Cut a layer into at least so many chunks; None if it needs more."""
        key = population, least, self.needs.out_axons[population].tobytes()
        if key not in self._cuts:
            self._cuts[key] = None
            try:
                chunks, _ = cut_layer(self.needs, population, least)
            except OptionError:
                chunks = []
            if chunks:
                slowest = np.max([np.maximum(*self.forecast.core((chunk,))) for chunk in chunks], axis=0)
                self._cuts[key] = chunks, slowest, self.needs.source_axons(chunks)
        return self._cuts[key]

    def attempt(self, least: dict[int, int]) -> Trial | None:
        """Judge the cut into so many chunks, or None if there is no such cut."""
        self.needs.forget()
        chunks: list[Chunk] = []
        times = {}
        for population in sorted(least, reverse=True):
            found = self._cut(population, least[population])
            if found is None:
                return None
            chunks += found[0]
            times[population] = found[1]
            self.needs.charge(found[2])
        if len(chunks) > self.most:
            return None
        every = np.array([times[population] for population in sorted(times)])
        barrier = self.forecast.time.barrier(_fewest_tiles(self.forecast, len(chunks)))
        return Trial(
            chunks=sorted(chunks),
            step=float(every.max(axis=0).mean()) + barrier,
            critical=sorted(times)[int(np.argmax(np.bincount(np.argmax(every, axis=0))))],
            longest=float(every.mean(axis=1).max()),
        )

    def _near(self, population: int, count: int, steps: int) -> int | None:
        """Number of chunks some steps away from another, None if there is none."""
        useful = self.useful[population]
        at = bisect_left(useful, count) + steps
        return useful[at] if 0 <= at < len(useful) else None

    def shrink(self) -> list[Trial]:
        """Fewest cores with which no layer takes longer than some time, for shorter and shorter times."""
        trials = []
        trial = self.attempt(chunks_of(cut(self.needs, {})))
        while trial is not None and trial.longest > 0:
            trials.append(trial)
            allowed = trial.longest * SHORTER
            counts = chunks_of(trial.chunks)
            self.needs.forget()
            for population in sorted(counts, reverse=True):
                while (found := self._cut(population, counts[population])) is None or found[1].mean() > allowed:
                    more = self._near(population, counts[population], 1)
                    if more is None:
                        return trials
                    counts[population] = more
                self.needs.charge(found[2])
            trial = self.attempt(counts)
        return trials

    def polish(self, trial: Trial) -> Trial:
        """Change the cores of one layer, or of the critical one and another, as long as that helps."""
        while True:
            before, counts, slow = trial, chunks_of(trial.chunks), trial.critical
            changes = [{a: i} for a in counts for i in STRIDES]
            changes += [{slow: i, a: j} for a in counts if a != slow for i in STRIDES for j in STRIDES]
            for change in changes:
                near = {a: self._near(a, counts[a], steps) for a, steps in change.items()}
                moved = {a: count for a, count in near.items() if count is not None}
                other = self.attempt(counts | moved) if len(moved) == len(change) else None
                if other is not None and other.score < trial.score:
                    trial = other
            if trial is before:
                return trial


def fastest(forecast: Forecast) -> Trial | None:
    """The shortest expected step that a greedy search finds, None if there is no room for any cut.

    The fewest cores for ever shorter times are cut; the best of these cuts is then changed as long as that helps.
    Layers share no core: on no network tried did a merged core leave a step as short.
    """
    search = _Search(forecast)
    trials = search.shrink()
    return search.polish(min(trials, key=lambda trial: trial.score)) if trials else None
