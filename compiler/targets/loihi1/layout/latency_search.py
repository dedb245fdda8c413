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
from spikeloom.compiler.targets.loihi1.layout.forecast import Core, Forecast
from spikeloom.compiler.targets.loihi1.layout.partition import chunks_of, cut, cut_layer, order_on_core
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


def _score(time: float, cores: int) -> float:
    return time * (1 + WORTH * cores)


def _busy(forecast: Forecast, core: Core) -> FloatArray:
    longest: FloatArray = np.maximum(*forecast.core(core))
    return longest


def estimate(forecast: Forecast, cores: list[Core]) -> float:
    """Expected picoseconds of a step, on as few tiles as can be."""
    forecast.charge(tuple(cores))
    busy = [_busy(forecast, order_on_core(forecast.needs, core)) for core in cores]
    return float(np.max(busy, axis=0).mean()) + forecast.time.barrier(_fewest_tiles(forecast, len(cores)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """Layers cut evenly, each chunk on a core of its own."""

    chunks: list[Chunk]
    score: float  # What is made small
    critical: int  # Population that takes longest in most steps
    longest: float  # Mean picoseconds of the slowest core of the slowest layer
    barrier: int  # Picoseconds


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
                slowest = np.max([_busy(self.forecast, (chunk,)) for chunk in chunks], axis=0)
                self._cuts[key] = chunks, slowest, self.needs.source_axons(chunks)
        return self._cuts[key]

    def attempt(self, least: dict[int, int]) -> _Trial | None:
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
        return _Trial(
            chunks=sorted(chunks),
            score=_score(float(every.max(axis=0).mean()) + barrier, len(chunks)),
            critical=sorted(times)[int(np.argmax(np.bincount(np.argmax(every, axis=0))))],
            longest=float(every.mean(axis=1).max()),
            barrier=barrier,
        )

    def _near(self, population: int, count: int, steps: int) -> int | None:
        """Number of chunks some steps away from another, None if there is none."""
        useful = self.useful[population]
        at = bisect_left(useful, count) + steps
        return useful[at] if 0 <= at < len(useful) else None

    def shrink(self) -> list[_Trial]:
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

    def polish(self, trial: _Trial) -> _Trial:
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


def fastest(forecast: Forecast) -> list[Core] | None:
    """Cores of the shortest expected step that a greedy search finds, None if there is no room for any.

    The fewest cores for ever shorter times are cut; the best of these cuts is then changed as long as that helps. The
    best of those with another barrier is kept too. Last, cores are merged where that makes no step longer.
    """
    search = _Search(forecast)
    best: dict[int, _Trial] = {}
    for trial in search.shrink():
        if trial.barrier not in best or trial.score < best[trial.barrier].score:
            best[trial.barrier] = trial
    ranked = sorted(best.values(), key=lambda trial: trial.score)
    found = [_merged(forecast, trial.chunks) for trial in ranked[1:]]
    found += [_merged(forecast, search.polish(trial).chunks) for trial in ranked[:1]]
    return min(found, key=lambda cores: _score(estimate(forecast, cores), len(cores)), default=None)


def _merged(forecast: Forecast, chunks: list[Chunk]) -> list[Core]:
    """Put chunks of different layers on one core, lightest first, where that makes no step longer."""
    needs = forecast.needs
    cores: list[Core] = [(chunk,) for chunk in chunks]
    forecast.charge(tuple(cores))
    loads = {core: forecast.core(core) for core in cores}
    weight = {core: float(np.maximum(*load).mean()) for core, load in loads.items()}
    longest = np.max([np.maximum(*load) for load in loads.values()], axis=0)
    most = longest.mean() * (1 + WORTH)
    waiting = sorted(cores, key=lambda core: weight[core])
    while waiting:
        core = waiting.pop(0)
        for other in sorted((c for c in cores if c != core), key=lambda c: weight[c]):
            if {chunk.population for chunk in core} & {chunk.population for chunk in other}:
                continue
            # a chunk that starts higher on its core may need other lists, so this is looked at again below
            together = np.max([mine + its for mine, its in zip(loads[core], loads[other], strict=True)], axis=0)
            if np.maximum(together, longest).mean() > most:
                break  # the others are heavier
            joint = order_on_core(needs, (*core, *other))
            if needs.excess(joint):
                continue
            load = forecast.core(joint)
            if np.maximum(np.maximum(*load), longest).mean() <= most:
                loads[joint], weight[joint] = load, float(np.maximum(*load).mean())
                longest = np.maximum(longest, np.maximum(*load))
                cores = [*(c for c in cores if c not in (core, other)), joint]
                waiting = sorted([*(c for c in waiting if c != other), joint], key=lambda core: weight[core])
                break
    return cores
