"""Choose how many cores each layer gets: few cores, or short steps, whose length spikes of the float model foretell.

The integer network is not changed: which neuron sits where has no influence on any spike. A layer on more cores is
swept and fed in parallel, but each of its spikes, and each spike that it receives, is sent to more of them.

Time is that of the simple model: a step lasts as long as the core that takes longest to sweep its neurons and send, or
to receive, then the barrier (SANA-FE [1]_). Here every compartment is taken to have work in every step, as those with a
bias have; neurons fire as the float model's do on calibration recordings, step by step, since the longest of several
fluctuating times is longer than the longest of their means.

The layout of the shortest expected step is searched greedily, since every number of cores of every layer is too much to
try; the search is deterministic, and ends when nothing near is better.

References
----------
.. [1] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025.
"""

from bisect import bisect_left
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import CapacityError, OptionError
from spikeloom.compiler.ir import INPUT, IntegerNetwork, depths
from spikeloom.compiler.passes.calibrate import Calibration, Spikes, fewer
from spikeloom.compiler.targets.base import PICOSECONDS, Target, TimeTable
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, Core, Cores, Needs, choose_dense
from spikeloom.compiler.targets.loihi1.layout.partition import arrange, chunks_of, cut, cut_layer, partition
from spikeloom.compiler.targets.loihi1.layout.place import Placement, core_traffic, place_on_chips
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

SAMPLES = 1000
"""Chip steps that are looked at, evenly spaced over the calibration recordings."""

SHORTER = 0.9
"""Each time that the search cuts for is this share of the one before."""

STRIDES = (-3, -2, -1, 1, 2, 3)
"""Changes of a layer's cores that are tried around the best layout, counted in useful numbers of cores."""

WORTH = 1e-3
"""Share of a step's time that a core more has to save."""

Activity = tuple[sparse.csc_array, ...]
"""Spikes of each population in some chip steps, (steps, neurons) of 0 and 1; last, at ``INPUT``, the input events."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What a layout is expected to take on the calibration recordings, on average over their chip steps."""

    step_ns: float  # Length of a step, barrier included
    critical_core: int  # Core that takes longest in most steps
    critical_share: float  # In what share of them
    receiving: bool  # Whether receiving takes it longer than sweeping and sending, on average
    time_table: str  # Name of the table


def sample(network: IntegerNetwork, calibration: Calibration, identity: tuple[IntArray, ...]) -> Activity:
    """Spikes of the chip steps that calibration recordings take, each layer as late as it is on the chip.

    `identity` says for each population which of the calibration's neurons the `network` holds.
    """
    calibration = fewer(calibration)
    late = depths(network)
    samples, length = calibration.events.shape[:2]
    every = samples * (length + max(late))
    chosen = np.linspace(0, every - 1, min(every, SAMPLES)).round().astype(np.int64)
    recording, step = np.divmod(chosen, length + max(late))

    def seen(values: Spikes | BoolArray, depth: int, ids: IntArray | slice = slice(None)) -> sparse.csc_array:
        at = step - depth
        runs = (0 <= at) & (at < length)
        return sparse.csc_array((values[recording, np.where(runs, at, 0)][:, ids] & runs[:, None]).astype(np.float64))

    layers = zip(calibration.spikes, late, identity, strict=True)
    return (*(seen(*layer) for layer in layers), seen(calibration.events, 0))


class Forecast:
    """Times of cores that hold given chunks; what was found for one is kept for others that hold it."""

    def __init__(self, needs: Needs, activity: Activity, time: TimeTable) -> None:
        self.needs = needs
        self.activity = activity
        self.time = time
        self.steps = int(activity[INPUT].shape[0])
        self._receiving: dict[tuple[Chunk, int, bool], FloatArray] = {}

    def receiving(self, chunk: Chunk, base: int, *, lean: bool) -> FloatArray:
        """Picoseconds in which a chunk at `base` receives, shape (steps,)."""
        key = (chunk, base, lean)
        if key not in self._receiving:
            taken = np.zeros(self.steps)
            ps = np.array([self.time.picoseconds(f"synaptic_operation_{form}") for form in ("sparse", "dense")])
            for lists in self.needs.lists(chunk):
                projection = self.needs.network.projections[lists.projection]
                dense, _ = choose_dense(lists, projection, base, chunk.size, lean=lean, target=self.needs.target)
                entries = np.where(dense, lists.last - lists.first + 1, lists.nonzero)
                source = self.activity[projection.pre]
                if len(lists.source) < source.shape[1]:
                    source = source[:, lists.source]
                taken += source @ (self.time.picoseconds("axon_in") + entries * ps[dense]).astype(np.float64)
            self._receiving[key] = taken
        return self._receiving[key]

    def sweeping(self, chunk: Chunk) -> FloatArray:
        """Picoseconds in which a chunk is swept and sends, shape (steps,); the output axons are those charged."""
        axons = self.needs.out_axons[chunk.population][chunk.first : chunk.last]
        neuron = self.time.picoseconds("neuron_access") + self.time.picoseconds("neuron_update")
        fires = (self.time.picoseconds("spike") + axons * self.time.picoseconds("axon_out")).astype(np.float64)
        spikes = self.activity[chunk.population]
        bounds = spikes.indptr[chunk.first : chunk.last + 1]
        step = spikes.indices[bounds[0] : bounds[-1]]
        sent = np.bincount(step, np.repeat(fires, np.diff(bounds)), self.steps)
        return np.asarray(sent, np.float64) + chunk.size * neuron

    def core(self, chunks: Core) -> tuple[FloatArray, FloatArray]:
        """Sweeping and receiving of a core, each (steps,) picoseconds."""
        lean = self.needs.lean(chunks)
        sweeps, receives = np.zeros((2, self.steps))
        base = 0
        for chunk in chunks:
            sweeps += self.sweeping(chunk)
            receives += self.receiving(chunk, base, lean=lean)
            base += chunk.size
        return sweeps, receives

    def expect(self, cores: Cores, tiles: int) -> Expectation:
        """Time of a step of a layout on so many tiles."""
        self.needs.forget()
        self.needs.charge(self.needs.source_axons(chunk for core in cores for chunk in core))
        sweeps, receives = map(np.array, zip(*(self.core(core) for core in cores), strict=True))
        busy = np.maximum(sweeps, receives)
        often = np.bincount(np.argmax(busy, axis=0))
        critical = int(np.argmax(often))
        return Expectation(
            step_ns=float(busy.max(axis=0).mean() + self.time.barrier(tiles)) / PICOSECONDS,
            critical_core=critical,
            critical_share=float(often[critical] / self.steps),
            receiving=bool(receives[critical].mean() > sweeps[critical].mean()),
            time_table=self.time.name,
        )


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
            with suppress(CapacityError, OptionError):
                chunks = cut_layer(self.needs, population, least)
                slowest = np.max([np.maximum(*self.forecast.core((chunk,))) for chunk in chunks], axis=0)
                self._cuts[key] = chunks, slowest, self.needs.source_axons(chunks)
        return self._cuts[key]

    def attempt(self, counts: dict[int, int], allowed: float | None = None) -> Trial | None:
        """Judge the cut into so many chunks, or None if there is no such cut.

        Where a mean time is `allowed`, a layer whose slowest chunk takes longer is cut into more.
        """
        self.needs.forget()
        chunks: list[Chunk] = []
        times = {}
        for population in sorted(counts, reverse=True):
            count = counts[population]
            found = self._cut(population, count)
            while allowed is not None and (found is None or found[1].mean() > allowed):
                more = self._near(population, count, 1)
                if more is None:
                    return None
                count, found = more, self._cut(population, more)
            if found is None:
                return None
            chunks += found[0]
            times[population] = found[1]
            self.needs.charge(found[2])
        if len(chunks) > self.most:
            return None
        every = np.array([times[population] for population in sorted(times)])
        tiles = -(-len(chunks) // self.needs.target.limit("mesh.tile_cores"))
        return Trial(
            chunks=sorted(chunks),
            step=float(every.max(axis=0).mean()) + self.forecast.time.barrier(tiles),
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
            trial = self.attempt(chunks_of(trial.chunks), trial.longest * SHORTER)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Which neuron sits on which core, and which core on which tile."""

    cores: Cores
    placement: Placement
    expected: Expectation | None  # Time of a step, where it can be foretold


def least_cores(
    network: IntegerNetwork, cores_for: Mapping[str, int], target: Target, chips: int = 1
) -> dict[int, int]:
    """Least number of cores by population, from names; OptionError if there is no such layer or not so many cores."""
    names = [population.name for population in network.populations]
    allowed = chips * target.limit("chip.cores")
    owner = f"{target.title} has" if chips == 1 else f"{chips} chips {target.title} have"
    for name, least in cores_for.items():
        option = f"--cores-for {name}={least}"
        if name not in names:
            raise OptionError(f"{option}: no such layer; layers are {', '.join(names)}")
        size = network.populations[names.index(name)].size
        if least > allowed:
            raise OptionError(f"{option}: {owner} {allowed} cores ({target.name}.chip.cores); give {allowed} or fewer")
        if least > size:
            raise OptionError(f"{option}: {name} has {size} neurons on the chip; give {size} or fewer")
    return {names.index(name): least for name, least in cores_for.items()}


def lay_out(
    network: IntegerNetwork,
    target: Target,
    *,
    goal: str = "cores",
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    rates: tuple[FloatArray, ...] | None = None,
    calibration: Calibration | None = None,
    identity: tuple[IntArray, ...] | None = None,
) -> tuple[Layout, Layout]:
    """Choose a layout for a goal, one of ``options.GOALS``, and that of fewest cores; often they are one.

    Layers in `cores_for` get so many cores at least, which hold no other layer. `rates` are spikes per step (neurons,)
    of each population; `identity` says which neurons of the calibration the network holds, all by default.
    CapacityError if a limit cannot be kept, OptionError if the goal cannot be judged or there are not so many cores.
    """
    least = least_cores(network, cores_for or {}, target, chips)
    forecast = None
    if calibration is not None and target.time:
        all_neurons = tuple(np.arange(population.size) for population in network.populations)
        activity = sample(network, calibration, identity or all_neurons)
        forecast = Forecast(Needs(network, target), activity, target.time[0])

    def placed(cores: Cores) -> Layout:
        placement = place_on_chips(core_traffic(network, cores, rates), target)
        expected = None
        if forecast is not None and len(cores) <= target.limit("chip.cores"):
            expected = forecast.expect(cores, len(set(placement.tiles)))
        return Layout(cores=cores, placement=placement, expected=expected)

    usual = placed(partition(network, target, rates, chips=chips))
    if least:
        return placed(partition(network, target, rates, cores_for=least, chips=chips)), usual
    if goal == "cores":
        return usual, usual
    if forecast is None:
        raise OptionError(f"--optimize {goal}: {target.title} has no time table; give another target")
    assert usual.expected is not None, "a forecast tells it on one chip"
    trial = fastest(forecast)
    if trial is None or trial.step >= usual.expected.step_ns * PICOSECONDS:
        return usual, usual
    fast = placed(arrange(forecast.needs, [(chunk,) for chunk in trial.chunks]))
    assert fast.expected is not None, "likewise"
    return (fast if fast.expected.step_ns < usual.expected.step_ns else usual), usual
