"""Machine code of the engine: one recording, all its ticks; :mod:`truenorth.engine` makes the arrays.

A tick visits the axons that have a spike. *Steady* neurons, the first ones, cannot leave their register in a
tick that they begin at their cap or below, so they are computed all at once, and what an axon brings them is
added in rows of neighbours. All but those that are reset by their threshold provably stay below their cap;
where one of these does not, the run is broken off. The other neurons are computed one by one.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_TO
from spikeloom.compiler.types import BoolArray, EventArray, IntArray

Int32 = npt.NDArray[np.int32]

PARAMETERS = (
    "leak",
    "leak_reversal",
    "threshold",
    "reset_mode",
    "reset",
    "negative_threshold",
    "negative_saturates",
)
LEAK, REVERSAL, THRESHOLD, RESET_MODE, RESET, NEGATIVE, SATURATES, AXON, DELAY, VOTES_FROM = range(10)
"""Columns of the parameters of a neuron: those of the netlist, the axon that its spikes reach (-1 for none),
the ticks until then, and the tick from which on they count as votes (-1 for never)."""

HALF, LOWER = 32, 2**32 - 1
"""Positive and negative weights are added up in one number: in its upper half, and as magnitudes in its lower."""

WORD = 8
"""Spikes of steady neurons that are looked at together."""

BROKEN_OFF = -1


class Wiring(NamedTuple):
    """What does not change while a recording runs."""

    offsets: IntArray  # (offsets,) int64; ticks of a data step in which channels are fed
    feed_bounds: (
        IntArray  # (offsets, channels + 1) int64; rows of `feed_axon` that a channel feeds at an offset
    )
    feed_axon: Int32  # (feeds,) int32
    clocks: IntArray  # (clocks, 3) int64; axon, period, phase
    segment_bounds: IntArray  # (axons + 1,) int64; segments of each axon
    # (segments, 3) int64; first steady neuron, the one after the last, and where in `row` the weights for
    # them begin
    segments: IntArray
    row: Int32  # (…) int32; weights of segments, zero where nothing is joined
    # (7, steady) int32; leak, threshold, reset, the negative threshold below zero, what a membrane below
    # that becomes, 1 for a reset by the threshold, and the cap
    steady: Int32
    axon_synapses: IntArray  # (axons + 1,) int64; crossing points with all other neurons
    synapse_neuron: Int32  # (synapses,) int32
    synapse_weight: IntArray  # (synapses,) int64; in halves
    parameters: Int32  # (neurons, 10) int32
    initial: Int32  # (neurons,) int32


class State(NamedTuple):
    """What changes: membranes, arrivals, and spikes on their way by the slot of their tick."""

    membrane: Int32
    steady_sum: Int32
    steady_spike: EventArray
    arrived: IntArray
    due: Int32
    dues: IntArray
    flagged: BoolArray


class Tallies(NamedTuple):
    """Counts of a recording, and its traces, empty where they are not wanted."""

    axons: IntArray
    spikes: IntArray
    votes: IntArray
    overflows: IntArray
    raster: BoolArray
    membranes: Int32


@compiled
def leaked(v: Any, leak: Any, reversal: Any) -> Any:
    """Membrane with its leak, which with reversal takes the membrane's sign and stops at zero."""
    if not reversal:
        return v + leak
    if v == 0:
        return v
    return min(v - leak, 0) if v < 0 else max(v + leak, 0)


@compiled
def after(v: Any, spiked: Any, threshold: Any, mode: Any, reset: Any, below: Any, saturates: Any) -> Any:
    """Membrane after the resets."""
    if spiked:
        if mode == RESET_TO:
            return reset
        return v - threshold if mode == RESET_LINEAR else v
    if saturates:
        return max(v, -below)
    if v < -below:
        if mode == RESET_TO:
            return -reset
        return v + below if mode == RESET_LINEAR else v
    return v


@compiled
def _queue(state: Any, slot: Any, axon: Any) -> Any:
    """Let an axon have a spike in the tick of a slot; 1 where it has one already."""
    if state.flagged[slot, axon]:
        return 1
    state.flagged[slot, axon] = True
    state.due[slot, state.dues[slot]] = axon
    state.dues[slot] += 1
    return 0


@compiled
def _inject(events: Any, bin_ticks: Any, tick: Any, slot: Any, wiring: Any, state: Any) -> Any:
    """Events and clocks of this tick; returns the merged spikes."""
    merged = 0
    for k in range(len(wiring.offsets)):
        since = tick - wiring.offsets[k]
        if since < 0 or since % bin_ticks != 0 or since // bin_ticks >= len(events):
            continue
        for channel in np.flatnonzero(events[since // bin_ticks]):
            for row in range(wiring.feed_bounds[k, channel], wiring.feed_bounds[k, channel + 1]):
                merged += _queue(state, slot, wiring.feed_axon[row])
    for k in range(len(wiring.clocks)):
        axon, period, phase = wiring.clocks[k]
        if tick >= phase and (tick - phase) % period == 0:
            merged += _queue(state, slot, axon)
    return merged


@compiled
def _add(total: Any, term: Any) -> None:
    for i in range(len(total)):
        total[i] += term[i]


@compiled
def _integrate(slot: Any, wiring: Any, state: Any, axons: Any) -> None:
    """Visit the crossing points of all axons with a spike."""
    for k in range(state.dues[slot]):
        axon = state.due[slot, k]
        state.flagged[slot, axon] = False
        axons[axon] += 1
        for s in range(wiring.segment_bounds[axon], wiring.segment_bounds[axon + 1]):
            first = wiring.segments[s, 0]
            end = wiring.segments[s, 1]
            at = wiring.segments[s, 2]
            _add(state.steady_sum[first:end], wiring.row[at : at + end - first])
        for s in range(wiring.axon_synapses[axon], wiring.axon_synapses[axon + 1]):
            state.arrived[wiring.synapse_neuron[s]] += wiring.synapse_weight[s]
    state.dues[slot] = 0


@compiled
def _update(n: Any, low: Any, high: Any, wiring: Any, state: Any, tallies: Any) -> Any:
    """A tick of a neuron that is not steady: whether it spiked."""
    p = wiring.parameters
    leak = np.int64(p[n, LEAK])
    threshold = np.int64(p[n, THRESHOLD])
    below = np.int64(p[n, NEGATIVE])
    before = np.int64(state.membrane[n])
    positive = state.arrived[n] >> HALF
    negative = state.arrived[n] & LOWER
    state.arrived[n] = 0
    summed = min(max(before + positive - negative, low), high)
    wanted = leaked(summed, leak, p[n, REVERSAL])
    v = min(max(wanted, low), high)
    spiked = v >= threshold
    left = after(v, spiked, threshold, p[n, RESET_MODE], np.int64(p[n, RESET]), below, p[n, SATURATES])
    v = min(max(left, low), high)
    state.membrane[n] = v
    if before + positive > high or before - negative < low or wanted < low or wanted > high or left != v:
        tallies.overflows[n] += 1
    return spiked


@compiled
def _update_steady(
    membrane: Any, sums: Any, spikes: Any,
    leak: Any, threshold: Any, reset: Any, lowest: Any, under: Any, linear: Any, cap: Any,
) -> Any:  # fmt: skip
    """A tick of all steady neurons: whether one ends above its cap; 1-D arrays, so that the loop is vectorised."""
    above = np.int32(0)
    for n in range(len(sums)):
        v = np.int32(membrane[n] + sums[n] + leak[n])
        sums[n] = 0
        spiked = v >= threshold[n]
        spikes[n] = spiked
        high = np.int32(reset[n] + linear[n] * (v - threshold[n]))
        low = under[n] if v < lowest[n] else v
        left = high if spiked else low
        membrane[n] = left
        above |= np.int32(left > cap[n])
    return above


@compiled
def _send(
    n: Any, tick: Any, ticks: Any, window: Any, slots: Any, wiring: Any, state: Any, tallies: Any
) -> Any:
    """Count a spike and lead it on; 1 where it merges with another before the last tick."""
    tallies.spikes[n] += 1
    if len(tallies.raster):
        tallies.raster[tick, n] = True
    first = wiring.parameters[n, VOTES_FROM]
    tallies.votes[n] += 0 <= first <= tick < first + window
    if wiring.parameters[n, AXON] < 0:
        return 0
    later = tick + wiring.parameters[n, DELAY]
    merged = _queue(state, later & (slots - 1), wiring.parameters[n, AXON])
    return merged * (later < ticks)


@compiled
def _send_steady(
    steady: Any, tick: Any, ticks: Any, window: Any, slots: Any, wiring: Any, state: Any, tallies: Any
) -> Any:
    """Lead on all spikes of steady neurons; returns those that merge."""
    merged = 0
    words = state.steady_spike.view(np.uint64)
    for word in range(len(words)):
        if words[word]:
            for n in range(WORD * word, min(WORD * word + WORD, steady)):
                if state.steady_spike[n]:
                    merged += _send(n, tick, ticks, window, slots, wiring, state, tallies)
    return merged


@compiled_and_cached
def run(
    events: Any, bin_ticks: int, ticks: int, low: int, high: int, slots: int, wiring: Any, tallies: Any
) -> int:
    """Run one recording; fills the tallies and returns the merged spikes, or ``BROKEN_OFF``.

    `events` is (steps, channels); `slots` is a power of two above every delay: spikes that are due in a tick
    wait in the slot of its lowest bits.
    """
    neurons = len(wiring.initial)
    axons = len(tallies.axons)
    window = len(events) * bin_ticks
    w = wiring.steady
    steady = w.shape[1]
    merged = 0
    state = State(
        wiring.initial.copy(),
        np.zeros(steady, np.int32),
        np.zeros((steady + WORD - 1) // WORD * WORD, np.uint8),
        np.zeros(neurons, np.int64),
        np.empty((slots, axons), np.int32),
        np.zeros(slots, np.int64),
        np.zeros((slots, axons), np.bool_),
    )
    for tick in range(ticks):
        slot = tick & (slots - 1)
        merged += _inject(events, bin_ticks, tick, slot, wiring, state)
        _integrate(slot, wiring, state, tallies.axons)
        membrane = state.membrane[:steady]
        sums = state.steady_sum
        spikes = state.steady_spike[:steady]
        if _update_steady(membrane, sums, spikes, w[0], w[1], w[2], w[3], w[4], w[5], w[6]):
            return BROKEN_OFF
        merged += _send_steady(steady, tick, ticks, window, slots, wiring, state, tallies)
        for n in range(steady, neurons):
            if _update(n, low, high, wiring, state, tallies):
                merged += _send(n, tick, ticks, window, slots, wiring, state, tallies)
        if len(tallies.membranes):
            tallies.membranes[tick] = state.membrane
    return merged
