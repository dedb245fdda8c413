"""Machine code of the engine: one recording, all its ticks; :mod:`runtime.truenorth.engine` makes the arrays.

Work follows events: a tick visits the axons that have a spike and the neurons that are reached or awake. A neuron
sleeps while a tick without arrivals would change nothing about it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from compiler.fixedpoint import IntArray
from compiler.truenorth.netlist import RESET_LINEAR, RESET_TO
from runtime.kernel import compiled, compiled_and_cached
from runtime.truenorth.trace import MIX_1, MIX_2, STEP_NEURON, STEP_TICK

Int32 = npt.NDArray[np.int32]

(
    LEAK,
    REVERSAL,
    THRESHOLD,
    MASK_BITS,
    RESET_MODE,
    RESET,
    NEGATIVE,
    SATURATES,
    REST,
    WIRE_AXON,
    WIRE_DELAY,
    VOTES_FROM,
) = range(12)
"""Columns of the parameters of a neuron. ``REST`` is a membrane that stays as it is without arrivals, or ``NO_REST``;
``VOTES_FROM`` the tick from which on its spikes count, -1 for never; ``WIRE_AXON`` -1 where it has no target."""

NO_REST = -(2**31)

HALF, LOWER = 32, 2**32 - 1
"""Positive and negative weights are added up in one number: in its upper half, and as magnitudes in its lower."""

_STEP_NEURON, _STEP_TICK = np.uint64(STEP_NEURON), np.uint64(STEP_TICK)
_MIX_1, _MIX_2 = np.uint64(MIX_1), np.uint64(MIX_2)
_30, _27, _31, _64, _ONE = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(64), np.uint64(1)


class Wiring(NamedTuple):
    """What does not change while a recording runs.

    Parameters
    ----------
    offsets : (offsets,) int64
        Ticks of a data step in which channels are fed.
    feed_bounds : (offsets, channels + 1) int64
        Rows of `feed_axon` that a channel feeds at an offset.
    feed_axon : (feeds,) int32
        Axons that are fed and that something else may reach, too.
    burst_bounds : (offsets, channels + 1) int64
        Rows of the next two, likewise.
    burst_neuron : (bursts,) int32
        Neurons that a channel reaches through axons that nothing else reaches.
    burst_weight : (bursts,) int64
        What that adds, in halves.
    clocks : (clocks, 3) int64
        Axon, period, phase.
    axon_synapses : (axons + 1,) int64
    synapse_neuron : (synapses,) int32
        Neuron id of each crossing point.
    synapse_weight : (synapses,) int64
        In halves.
    parameters : (neurons, 12) int32
    instant : (neurons,) int32
        The leak, below zero, of neurons that start each tick at zero and spike where they do not end it below zero;
        0 for all others.
    initial : (neurons,) int32
    """

    offsets: IntArray
    feed_bounds: IntArray
    feed_axon: Int32
    burst_bounds: IntArray
    burst_neuron: Int32
    burst_weight: IntArray
    clocks: IntArray
    axon_synapses: IntArray
    synapse_neuron: Int32
    synapse_weight: IntArray
    parameters: Int32
    instant: Int32
    initial: Int32


class State(NamedTuple):
    """What changes: membranes, arrivals, who works this tick, and spikes on their way by the slot of their tick."""

    membrane: Int32
    arrived: IntArray
    listed: npt.NDArray[np.bool_]
    work: Int32
    due: Int32
    dues: IntArray
    flagged: npt.NDArray[np.bool_]


class Tallies(NamedTuple):
    """Counts of a recording, and its traces, empty where they are not wanted."""

    fed: IntArray
    axons: IntArray
    spikes: IntArray
    votes: IntArray
    overflows: IntArray
    raster: npt.NDArray[np.bool_]
    membranes: Int32


@compiled
def draw(seed: Any, neuron: Any, tick: Any, bits: Any) -> Any:
    """As :func:`runtime.truenorth.trace.random_bits`, of at least one bit."""
    x = seed + (np.uint64(neuron) + _ONE) * _STEP_NEURON + (np.uint64(tick) + _ONE) * _STEP_TICK
    x = (x ^ (x >> _30)) * _MIX_1
    x = (x ^ (x >> _27)) * _MIX_2
    return np.int64((x ^ (x >> _31)) >> (_64 - np.uint64(bits)))


@compiled
def leaked(v: Any, leak: Any, reversal: Any) -> Any:
    """Membrane with its leak, which with reversal takes the membrane's sign and stops at zero."""
    if not reversal:
        return v + leak
    if v == 0:
        return v
    return min(v - leak, 0) if v < 0 else max(v + leak, 0)


@compiled
def after(v: Any, spiked: Any, threshold: Any, random: Any, mode: Any, reset: Any, below: Any, saturates: Any) -> Any:
    """Membrane after the resets; the threshold holds the random number already."""
    if spiked:
        if mode == RESET_TO:
            return reset
        return v - threshold if mode == RESET_LINEAR else v
    if saturates:
        return max(v, -below)
    if v < -(below + random):
        if mode == RESET_TO:
            return -reset
        return v + below + random if mode == RESET_LINEAR else v
    return v


@compiled
def _reach(state: Any, n: Any, weight: Any, working: Any) -> Any:
    """Let a weight arrive at a neuron, which works then; returns the neurons that do."""
    state.arrived[n] += weight
    if not state.listed[n]:
        state.listed[n] = True
        state.work[working] = n
        return working + 1
    return working


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
def _inject(events: Any, bin_ticks: Any, tick: Any, slot: Any, wiring: Any, state: Any, fed: Any, working: Any) -> Any:
    """Events and clocks of this tick; returns the neurons that work, and the merged spikes."""
    merged = 0
    for k in range(len(wiring.offsets)):
        since = tick - wiring.offsets[k]
        if since < 0 or since % bin_ticks != 0 or since // bin_ticks >= len(events):
            continue
        for channel in np.flatnonzero(events[since // bin_ticks]):
            fed[k, channel] += 1
            for s in range(wiring.burst_bounds[k, channel], wiring.burst_bounds[k, channel + 1]):
                working = _reach(state, wiring.burst_neuron[s], wiring.burst_weight[s], working)
            for row in range(wiring.feed_bounds[k, channel], wiring.feed_bounds[k, channel + 1]):
                merged += _queue(state, slot, wiring.feed_axon[row])
    for k in range(len(wiring.clocks)):
        axon, period, phase = wiring.clocks[k]
        if tick >= phase and (tick - phase) % period == 0:
            merged += _queue(state, slot, axon)
    return working, merged


@compiled
def _integrate(slot: Any, wiring: Any, state: Any, axons: Any, working: Any) -> Any:
    """Visit the crossing points of all axons with a spike; returns the neurons that work."""
    for k in range(state.dues[slot]):
        axon = state.due[slot, k]
        state.flagged[slot, axon] = False
        axons[axon] += 1
        for s in range(wiring.axon_synapses[axon], wiring.axon_synapses[axon + 1]):
            working = _reach(state, wiring.synapse_neuron[s], wiring.synapse_weight[s], working)
    state.dues[slot] = 0
    return working


@compiled
def _update(n: Any, tick: Any, seed: Any, low: Any, high: Any, sums: Any, wiring: Any, state: Any, tallies: Any) -> Any:
    """A tick of a neuron that remembers: whether it spiked, and whether it may sleep."""
    p = wiring.parameters
    leak, threshold, below = np.int64(p[n, LEAK]), np.int64(p[n, THRESHOLD]), np.int64(p[n, NEGATIVE])
    random = draw(seed, n, tick, p[n, MASK_BITS]) if p[n, MASK_BITS] else np.int64(0)
    before, positive, negative = np.int64(state.membrane[n]), sums >> HALF, sums & LOWER
    summed = min(max(before + positive - negative, low), high)
    wanted = leaked(summed, leak, p[n, REVERSAL])
    v = min(max(wanted, low), high)
    spiked = v >= threshold + random
    left = after(v, spiked, threshold + random, random, p[n, RESET_MODE], np.int64(p[n, RESET]), below, p[n, SATURATES])
    v = min(max(left, low), high)
    state.membrane[n] = v
    if before + positive > high or before - negative < low or wanted < low or wanted > high or left != v:
        tallies.overflows[n] += 1
    sleeps = v == p[n, REST] or (leak == 0 and -below <= v < threshold)
    return spiked, sleeps and p[n, MASK_BITS] == 0


@compiled_and_cached
def run(
    events: Any, bin_ticks: int, ticks: int, seed: Any, low: int, high: int, slots: int, wiring: Any, tallies: Any
) -> int:
    """Run one recording; fills the tallies and returns the merged spikes.

    `events` is (steps, channels); `slots` is a power of two above every delay: spikes that are due in a tick wait in
    the slot of its lowest bits.
    """
    neurons, axons, window = len(wiring.initial), len(tallies.axons), len(events) * bin_ticks
    state = State(
        wiring.initial.copy(),
        np.zeros(neurons, np.int64),
        np.ones(neurons, np.bool_),
        np.arange(neurons).astype(np.int32),
        np.empty((slots, axons), np.int32),
        np.zeros(slots, np.int64),
        np.zeros((slots, axons), np.bool_),
    )
    working, merged = neurons, 0  # all are awake at first
    for tick in range(ticks):
        slot = tick & (slots - 1)
        working, more = _inject(events, bin_ticks, tick, slot, wiring, state, tallies.fed, working)
        merged += more
        working = _integrate(slot, wiring, state, tallies.axons, working)
        awake = 0
        for k in range(working):
            n = state.work[k]
            sums = state.arrived[n]
            state.arrived[n] = 0
            if wiring.instant[n]:
                spiked, sleeps = (sums >> HALF) - (sums & LOWER) + wiring.instant[n] >= 0, True
            else:
                spiked, sleeps = _update(n, tick, seed, low, high, sums, wiring, state, tallies)
            if sleeps:
                state.listed[n] = False
            else:
                state.work[awake] = n  # never ahead of k
                awake += 1
            if spiked:
                tallies.spikes[n] += 1
                if len(tallies.raster):
                    tallies.raster[tick, n] = True
                first = wiring.parameters[n, VOTES_FROM]
                tallies.votes[n] += 0 <= first <= tick < first + window
                if wiring.parameters[n, WIRE_AXON] >= 0:
                    later = tick + wiring.parameters[n, WIRE_DELAY]
                    twice = _queue(state, later & (slots - 1), wiring.parameters[n, WIRE_AXON])
                    merged += twice * (later < ticks)
        working = awake
        if len(tallies.membranes):
            tallies.membranes[tick] = state.membrane
    return merged
