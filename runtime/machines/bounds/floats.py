"""The float model beside its known run, for the bounds of :mod:`bounds.boxes`: what changed events do to its decision.

Registers are held as what they differ by from the known run's, in float64, and bounds are widened in each step by what
both runs may round: n float32 summed in any order are off by less than n / 2**24 of the sum of their magnitudes. A
neuron that nothing has reached is not widened: it adds the same numbers in the same order. Layers lag as on the chip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.interpret import Simulation, float_simulation
from spikeloom.compiler.ir import INPUT, Network, added_up, depths
from spikeloom.compiler.layer_kernel import Synapses, by_source, compiled
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.bounds.arithmetic import (
    LANES,
    Safe,
    implements,
    step_block,
    surely,
    unknown,
    unsafe,
)
from spikeloom.runtime.machines.bounds.boxes import list_open, wipe
from spikeloom.runtime.machines.bounds.groups import groups
from spikeloom.runtime.machines.changes import Groups
from spikeloom.runtime.machines.votes import readout_counts

ROUNDING = 1.01 * 2.0**-23
"""Share of a float32 result by which it may differ in two runs; the hundredth covers what float64 rounds here."""

BLUR = 1e-12
"""Share of a weight by which it is widened: where two cancel, the sum is still a rounded one, and no zero."""

FLUSHED = 1e-29
"""More than a register loses where it is nearly zero."""

LARGEST = float(np.finfo(np.float32).max)


class Floats(NamedTuple):
    """A float model as the kernel reads it, laid out as :class:`arithmetic.Layout` says; (places,) are float64."""

    synapses: Synapses
    layer: IntArray  # (blocks,) int64
    depth: IntArray  # (blocks,) int64
    outer: AnyArray  # (blocks,) bool
    ordered: bool
    alpha: FloatArray
    beta: FloatArray
    threshold: FloatArray  # Infinite where there is no neuron
    bias: FloatArray
    # current, membrane: what none exceeds in magnitude
    current: FloatArray
    membrane: FloatArray
    lasting: FloatArray  # What a current adds up to in a membrane without decay, as a multiple
    widest: FloatArray  # Magnitude of the largest weight
    total: FloatArray  # Magnitudes of all weights together
    sources: FloatArray  # Number of weights
    rounding: FloatArray  # What two runs may round otherwise in a step, beside their sums
    label: AnyArray  # (places,) int32


class Known(NamedTuple):
    """A run, of `steps` chip steps."""

    events: AnyArray  # (channels, T) uint8, 0 or 1
    sums: FloatArray  # (steps, places); magnitudes of weights that arrive
    # current, membrane: (steps + 1, places); zero, as registers are held as differences
    current: FloatArray
    membrane: FloatArray
    compared: FloatArray  # (steps, places); membranes before the reset
    fired: AnyArray  # (steps, places) uint8
    active: FloatArray  # (steps, blocks); spikes that arrive in a layer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloatNetwork:
    """A float network ready for bounds, of recordings up to a length."""

    network: Network
    steps: int  # Of the longest recording
    simulation: Simulation
    floats: Floats
    magnitude: sparse.csr_array  # (places, sources); of weights
    feeds: AnyArray  # (blocks, sources) bool; whether a source's spikes arrive in a layer
    place: tuple[IntArray, ...]  # Of each population's neurons

    def known_run(self, channels: EventArray) -> Known:
        """Run a recording (channels, T) and keep what changed runs need."""
        length = channels.shape[1]
        assert length <= self.steps, "laid out for shorter recordings"
        places = len(self.floats.bias)
        depth = depths(self.network)
        steps = length + max(depth)
        activity = self.simulation.run(np.ascontiguousarray(channels.T[None] != 0), membranes=True)
        compared = np.zeros((steps, places))
        fired = np.zeros((steps, places), np.uint8)
        for index, place in enumerate(self.place):
            inside = slice(depth[index], depth[index] + length)
            fired[inside, place] = activity.spikes[index][0]
            compared[inside, place] = activity.membranes[index][0]
        before = np.zeros((steps, len(channels) + places), np.uint8)
        before[:length, : len(channels)] = channels.T != 0
        before[1:, len(channels) :] = fired[:-1]
        arriving = sparse.csr_array(before.T.astype(np.float64))
        none = np.zeros((steps + 1, places))
        return Known(
            events=np.ascontiguousarray(channels != 0).view(np.uint8),
            sums=np.ascontiguousarray((self.magnitude @ arriving).toarray().T),
            current=none,
            membrane=none,
            compared=compared,
            fired=fired,
            active=np.ascontiguousarray((self.feeds @ arriving).T),
        )

    def votes(self, runs: EventArray, *, classes: int) -> IntArray:
        """Votes (recordings, classes) of recordings (recordings, channels, T)."""
        events = np.ascontiguousarray(runs.transpose(0, 2, 1) != 0)
        spikes = self.simulation.run(events).spikes[self.network.readout.population]
        return readout_counts(self.network.readout, classes, spikes)

    def groups(
        self, channels: EventArray, shape: tuple[int, int, int], reach: int
    ) -> tuple[IntArray, Groups]:
        """Votes (classes,) of a recording, and what groups of changed events turn: see :func:`groups.groups`."""
        known = self.known_run(channels)
        votes = self.votes(channels[None], classes=shape[2])[0]
        bounds = safe(self.floats, known)
        return votes, groups(self.floats, known, bounds, shape, int(votes.argmax()), reach)


def laid_out(network: Network, steps: int) -> FloatNetwork:
    """Lay a network out for recordings of up to so many steps.

    Raises OptionError for a network whose layers receive from layers that do not come just before them, or whose
    registers might overflow.
    """
    depth = np.array(depths(network))
    for each in network.projections:
        before = -1 if each.pre == INPUT else depth[each.pre]
        if each.pre != each.post and before + 1 != depth[each.post]:
            name = network.populations[each.post].name
            raise OptionError(
                f"--checkpoint: {name} receives from layers of several depths, for which there are no bounds; omit it"
            )
    blocks = np.array([-(-population.size // LANES) for population in network.populations])
    first = LANES * (np.cumsum(blocks) - blocks)
    both = zip(first.tolist(), network.populations, strict=True)
    place = tuple(start + np.arange(population.size) for start, population in both)
    layer = np.repeat(np.arange(len(blocks)), blocks)
    weight, feeds = _wiring(network, place, LANES * len(layer))
    magnitude = abs(weight)
    registers = _registers(network, place, magnitude, steps)
    within = [each for each in network.projections if each.pre != INPUT]
    return FloatNetwork(
        network=network,
        steps=steps,
        simulation=float_simulation(network, np.float32),
        floats=Floats(
            synapses=by_source([weight], np.float64),
            layer=layer,
            depth=depth[layer],
            outer=~np.isin(layer, [each.post for each in within]),
            ordered=all(each.pre < each.post for each in within),
            **registers,
        ),
        magnitude=magnitude,
        feeds=feeds[layer].astype(np.float64),
        place=place,
    )


def _wiring(
    network: Network, place: tuple[IntArray, ...], places: int
) -> tuple[sparse.csr_array, BoolArray]:
    """Weights in float32's values, (places, sources), and whether a source's spikes arrive in a layer."""
    inputs = network.input.size
    parts = []
    feeds = np.zeros((len(place), inputs + places), np.bool_)
    for post in range(len(place)):
        into = ((each.pre, each.weight) for each in network.projections if each.post == post)
        for pre, weight in added_up(into).items():
            source = np.arange(inputs) if pre == INPUT else inputs + place[pre]
            entries = weight.tocoo()
            with np.errstate(over="ignore"):  # what is infinite is refused with all that might become so
                stored = entries.data.astype(np.float32)
            parts.append((stored, place[post][entries.row], source[entries.col]))
            feeds[post, source] = True
    data, row, column = (np.concatenate(each) for each in zip(*parts, strict=True))
    shape = places, inputs + places
    return sparse.csr_array((data.astype(np.float64), (row, column)), shape=shape), feeds


def _registers(
    network: Network, place: tuple[IntArray, ...], magnitude: sparse.csr_array, steps: int
) -> dict[str, AnyArray]:
    """What :class:`Floats` holds of each place, from the magnitudes of weights."""
    places, inputs = magnitude.shape
    alpha, beta, bias = np.zeros((3, places))
    threshold = np.full(places, np.inf)
    for population, at in zip(network.populations, place, strict=True):
        alpha[at] = np.float32(population.alpha)
        beta[at] = np.float32(population.beta)
        bias[at] = population.bias.astype(np.float32)
        threshold[at] = np.float32(population.theta)
    label = np.full(places, -1, np.int32)
    label[place[network.readout.population]] = network.readout.label
    total = magnitude.sum(axis=1)
    lasting = 1 / np.maximum(1 - alpha, 1e-9)
    rounded = 1 + 2.0**-22 * (inputs + steps)
    current = rounded * total * np.minimum(lasting, steps)
    sinking = (current + abs(bias)) * np.minimum(1 / np.maximum(1 - beta, 1e-9), steps)
    membrane = rounded * (np.where(np.isfinite(threshold), abs(threshold), 0) + sinking)
    operations = (1 + alpha) * current + 2 * membrane + abs(bias)
    if not np.all(2 * operations < LARGEST):  # NaN, too
        raise OptionError(
            "--checkpoint: sums of the network may exceed float32, for which there are no bounds; omit it"
        )
    return {
        "alpha": alpha,
        "beta": beta,
        "threshold": threshold,
        "bias": bias,
        "current": current,
        "membrane": membrane,
        "rounding": FLUSHED + ROUNDING * operations,
        "lasting": lasting,
        "widest": magnitude.max(axis=1).toarray().ravel(),
        "total": total,
        "sources": np.diff(magnitude.indptr).astype(np.float64),
        "label": label,
    }


def safe(floats: Floats, known: Known) -> Safe:
    """Differences of membranes before each step, (steps + 1, places), from which every later spike is the known one.

    Of a current that lasts it is assumed that membranes do not decay and that no reset clears them: a difference is
    safe if it is in all later steps, together with all that the current still adds and all that both runs round.
    """
    steps, places = known.fired.shape
    length = known.events.shape[1]
    bounds = Safe(np.full((steps + 1, places), -np.inf), np.full((steps + 1, places), np.inf))
    lasts = floats.alpha != 0
    kept = np.where(lasts, 1, floats.beta)
    depth = np.repeat(floats.depth, LANES)
    for t in range(steps - 1, -1, -1):
        gap = floats.threshold - known.compared[t]
        fired = known.fired[t] != 0
        after = bounds.low[t + 1], bounds.high[t + 1]
        least = np.where(fired, np.where(lasts, np.maximum(gap, after[0]), gap), after[0])
        most = np.where(fired, np.where(lasts, after[1], np.inf), np.minimum(gap, after[1]))
        arrived = floats.alpha * floats.current + known.sums[t]
        slack = floats.lasting * (floats.rounding + ROUNDING * np.repeat(known.active[t], LANES) * arrived)
        inside = (depth <= t) & (t < depth + length) & (kept > 0)  # else what is stored is lost in this step
        for bound, end, sign in ((bounds.low, least, -1), (bounds.high, most, 1)):
            room = sign * end - slack
            with np.errstate(divide="ignore", invalid="ignore"):
                bound[t] = sign * np.where(inside, np.where(room < 0, -np.inf, room / kept), np.inf)
    return bounds


# Each loop is a function of its own that writes one array: only so does the compiler vectorise it.


@compiled
def _widen(total: Any, weight: Any, sign: Any, blur: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += sign * weight[begin + i] + blur * abs(weight[begin + i])


@implements(surely, Floats)
def _surely(floats: Floats, work: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    weight = floats.synapses.weight
    _widen(work.low, weight, np.float64(sign), -BLUR, first, begin, length)
    _widen(work.high, weight, np.float64(sign), BLUR, first, begin, length)


@compiled
def _reached(codes: Any, low: Any, high: Any, alpha: Any, box: Any, first: Any) -> None:
    """Mark neurons that may not compute the known numbers in a step, where their codes will be."""
    low_u, high_u, low_v, high_v = box
    for i in range(first, first + np.uint64(LANES)):
        arrives = np.uint8(low[i] != 0) | np.uint8(high[i] != 0)
        lasts = np.uint8(alpha[i] * low_u[i] != 0) | np.uint8(alpha[i] * high_u[i] != 0)
        stored = np.uint8(low_v[i] != 0) | np.uint8(high_v[i] != 0)
        codes[i] = arrives | lasts | stored


@compiled
def _loosen(
    floats: Floats, low: Any, high: Any, reached: Any, sums: Any, active: Any, arrived: Any, first: Any
) -> None:
    """Widen the sums of neurons that are reached by what the known run and this one may round otherwise."""
    spikes = np.float64(arrived[0]) + active
    sure = np.float64(arrived[1])
    for i in range(first, first + np.uint64(LANES)):
        magnitude = min(sums[i] + (high[i] - low[i]) + sure * floats.widest[i], floats.total[i])
        added = min(spikes, floats.sources[i])
        slack = floats.rounding[i] + ROUNDING * added * (floats.alpha[i] * floats.current[i] + magnitude)
        low[i] -= reached[i] * slack
        high[i] += reached[i] * slack


@compiled
def _charge(current: Any, alpha: Any, more: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        current[i] = alpha[i] * current[i] + more[i]


@compiled
def _integrate(membrane: Any, beta: Any, current: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        membrane[i] = beta[i] * membrane[i] + current[i]


@compiled
def _code(codes: Any, low: Any, high: Any, compared: Any, threshold: Any, fired: Any, first: Any) -> Any:
    different = np.uint8(0)
    for i in range(first, first + np.uint64(LANES)):
        sure = np.uint8(compared[i] + low[i] > threshold[i])
        may = np.uint8(compared[i] + high[i] > threshold[i])
        codes[i] = np.uint8(sure + np.uint8(may << np.uint8(1)))
        different |= np.uint8(np.uint8(sure ^ fired[i]) | np.uint8(may ^ fired[i]))
    return different


@compiled
def _reset(
    membrane: Any, codes: Any, compared: Any, threshold: Any, fired: Any, up: Any, first: Any
) -> None:
    """Differences after the reset: of what is least, or, where `up`, most."""
    for i in range(first, first + np.uint64(LANES)):
        v = compared[i] + membrane[i]
        if codes[i] == np.uint8(2):
            v = max(min(v, threshold[i]), 0.0) if up else min(v, 0.0)
        stored = 0.0 if codes[i] == np.uint8(3) else v
        membrane[i] = stored - (0.0 if fired[i] else compared[i])


@implements(step_block, Floats)
def _step(floats: Floats, known: Known, work: Any, t: Any, block: Any, n: Any) -> Any:
    first = np.uint64(block * LANES)
    if not floats.depth[block] <= t < floats.depth[block] + known.events.shape[1]:
        wipe(work.low_u, first)
        wipe(work.high_u, first)
        wipe(work.low_v, first)
        wipe(work.high_v, first)
    else:
        box = work.low_u, work.high_u, work.low_v, work.high_v
        _reached(work.codes, work.low, work.high, floats.alpha, box, first)
        sums, active = known.sums[t], known.active[t, block]
        _loosen(floats, work.low, work.high, work.codes, sums, active, work.arrived, first)
        _charge(work.low_u, floats.alpha, work.low, first)
        _charge(work.high_u, floats.alpha, work.high, first)
        _integrate(work.low_v, floats.beta, work.low_u, first)
        _integrate(work.high_v, floats.beta, work.high_u, first)
        of_step = known.compared[t], floats.threshold, known.fired[t]
        if _code(work.codes, work.low_v, work.high_v, *of_step, first):
            n = list_open(known, work, t, block, n)
        _reset(work.low_v, work.codes, *of_step, False, first)
        _reset(work.high_v, work.codes, *of_step, True, first)
    wipe(work.low, first)
    wipe(work.high, first)
    return n


@implements(unknown, Floats)
def _unknown(floats: Floats, known: Known, start: Any, work: Any) -> Any:
    channels, length = known.events.shape
    n = 0
    for c in range(len(floats.bias)):
        depth = floats.depth[c // LANES]
        inside = floats.threshold[c] != np.inf and depth < start <= depth + length  # else all are zero
        lasts = inside and floats.alpha[c] != 0
        fired = known.fired[start - 1, c] != 0
        stored = 0.0 if fired else known.compared[start - 1, c]
        work.low_u[c] = -2 * floats.current[c] if lasts else 0.0
        work.high_u[c] = 2 * floats.current[c] if lasts else 0.0
        work.low_v[c] = -floats.membrane[c] - stored if inside else 0.0
        work.high_v[c] = max(floats.threshold[c], 0.0) - stored if inside else 0.0
        work.listed[n] = channels + c
        work.kind[n] = -2 if fired else 2
        n += inside
    return n


@implements(unsafe, Floats)
def _unsafe(floats: Floats, _known: Known, bounds: Safe, box: Any, t: Any, block: Any) -> Any:
    low_u, high_u, low_v, high_v = box
    for i in range(block * LANES, (block + 1) * LANES):
        later = floats.alpha[i] * max(abs(low_u[i]), abs(high_u[i])) * floats.lasting[i]
        if later != 0 or low_v[i] != 0 or high_v[i] != 0:
            lasts = floats.alpha[i] != 0  # longer than the membrane, which may make up for it now
            least = min(low_v[i], 0.0) if lasts else low_v[i]
            most = max(high_v[i], 0.0) if lasts else high_v[i]
            if least - later < bounds.low[t, i] or most + later > bounds.high[t, i]:
                return True
    return False
