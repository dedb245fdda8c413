"""Machine code of the engine: one recording, all its ticks; see :mod:`runtime.truenorth.engine` for the arrays.

Work follows events: a tick visits the axons that have a spike and the neurons that are reached or awake. A neuron
sleeps while a tick without arrivals would change nothing about it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from compiler.truenorth.netlist import RESET_LINEAR, RESET_TO
from runtime.kernel import compiled, compiled_and_cached
from runtime.truenorth.trace import MIX_1, MIX_2, STEP_NEURON, STEP_TICK

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

_STEP_NEURON, _STEP_TICK = np.uint64(STEP_NEURON), np.uint64(STEP_TICK)
_MIX_1, _MIX_2 = np.uint64(MIX_1), np.uint64(MIX_2)
_30, _27, _31, _64, _ONE = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(64), np.uint64(1)


@compiled
def draw(seed: Any, neuron: Any, tick: Any, bits: Any) -> Any:
    """As :func:`runtime.truenorth.trace.random_bits`, of at least one bit."""
    x = seed + (np.uint64(neuron) + _ONE) * _STEP_NEURON + (np.uint64(tick) + _ONE) * _STEP_TICK
    x = (x ^ (x >> _30)) * _MIX_1
    x = (x ^ (x >> _27)) * _MIX_2
    return np.int64((x ^ (x >> _31)) >> (_64 - np.uint64(bits)))


@compiled
def neuron_tick(p: Any, v: Any, positive: Any, negative: Any, random: Any, low: Any, high: Any) -> Any:
    """As :func:`runtime.truenorth.spec.neuron_tick`: membrane, whether it spiked, whether its register was left."""
    left = v + positive > high or v - negative < low
    v = min(max(v + positive - negative, low), high)
    leak = np.int64(p[LEAK])
    if p[REVERSAL]:
        if v == 0:
            leak = np.int64(0)
        elif v < 0:
            leak = -leak
            if v + leak > 0:
                leak = -v
        elif v + leak < 0:
            leak = -v
    leaked = v + leak
    v = min(max(leaked, low), high)
    left = left or v != leaked
    threshold = p[THRESHOLD] + random
    spiked = v >= threshold
    if spiked:
        if p[RESET_MODE] == RESET_TO:
            v = np.int64(p[RESET])
        elif p[RESET_MODE] == RESET_LINEAR:
            v -= threshold
    elif p[SATURATES]:
        v = max(v, -np.int64(p[NEGATIVE]))
    elif v < -(p[NEGATIVE] + random):
        if p[RESET_MODE] == RESET_TO:
            v = -np.int64(p[RESET])
        elif p[RESET_MODE] == RESET_LINEAR:
            v += p[NEGATIVE] + random
    held = min(max(v, low), high)
    return held, spiked, left or held != v


@compiled
def at_rest(p: Any, v: Any) -> bool:
    """Whether a tick without arrivals leaves a neuron as it is, silent; may say no where it does."""
    if p[MASK_BITS]:
        return False
    return v == p[REST] or (p[LEAK] == 0 and -p[NEGATIVE] <= v < p[THRESHOLD])


@compiled_and_cached
def run(
    events: Any,
    bin_ticks: int,
    ticks: int,
    seed: Any,
    low: int,
    high: int,
    slots: int,
    offsets: Any,
    feed_bounds: Any,
    feed_axon: Any,
    clocks: Any,
    axon_synapses: Any,
    synapse_neuron: Any,
    synapse_weight: Any,
    parameters: Any,
    initial: Any,
    spike_counts: Any,
    votes: Any,
    axon_counts: Any,
    overflows: Any,
    spikes: Any,
    membranes: Any,
) -> int:
    """Run one recording; fills the counts, and the traces where they are not empty; returns the merged spikes.

    `slots` is a power of two above every delay: spikes that are due in a tick wait in the slot of its lowest bits.
    """
    neurons, axons, steps = len(initial), len(axon_counts), events.shape[1]
    membrane = initial.copy()
    positive, negative = np.zeros(neurons, np.int32), np.zeros(neurons, np.int32)
    listed = np.zeros(neurons, np.bool_)
    work, awake = np.empty(neurons, np.int32), np.empty(neurons, np.int32)
    working = 0
    for n in range(neurons):
        if not at_rest(parameters[n], membrane[n]):
            work[working] = n
            working += 1
            listed[n] = True
    due = np.empty((slots, axons), np.int32)
    dues = np.zeros(slots, np.int64)
    flagged = np.zeros((slots, axons), np.bool_)
    merged = 0
    for tick in range(ticks):
        slot = tick & (slots - 1)
        # events and clocks of this tick join the spikes that are due
        for k in range(len(offsets)):
            since = tick - offsets[k]
            if since < 0 or since % bin_ticks != 0 or since // bin_ticks >= steps:
                continue
            for channel in range(events.shape[0]):
                if events[channel, since // bin_ticks] == 0:
                    continue
                for row in range(feed_bounds[k, channel], feed_bounds[k, channel + 1]):
                    axon = feed_axon[row]
                    if flagged[slot, axon]:
                        merged += 1
                    else:
                        flagged[slot, axon] = True
                        due[slot, dues[slot]] = axon
                        dues[slot] += 1
        for k in range(len(clocks)):
            if tick >= clocks[k, 2] and (tick - clocks[k, 2]) % clocks[k, 1] == 0:
                axon = clocks[k, 0]
                if flagged[slot, axon]:
                    merged += 1
                else:
                    flagged[slot, axon] = True
                    due[slot, dues[slot]] = axon
                    dues[slot] += 1
        # integrate
        for k in range(dues[slot]):
            axon = due[slot, k]
            flagged[slot, axon] = False
            axon_counts[axon] += 1
            for s in range(axon_synapses[axon], axon_synapses[axon + 1]):
                n = synapse_neuron[s]
                weight = synapse_weight[s]
                if weight > 0:
                    positive[n] += weight
                else:
                    negative[n] -= weight
                if not listed[n]:
                    listed[n] = True
                    work[working] = n
                    working += 1
        dues[slot] = 0
        # the neurons that have something to do
        waking = 0
        for k in range(working):
            n = work[k]
            p = parameters[n]
            random = np.int64(0)
            if p[MASK_BITS]:
                random = draw(seed, n, tick, p[MASK_BITS])
            v, spiked, left = neuron_tick(p, np.int64(membrane[n]), positive[n], negative[n], random, low, high)
            membrane[n] = v
            positive[n] = 0
            negative[n] = 0
            if left:
                overflows[n] += 1
            if spiked:
                spike_counts[n] += 1
                if len(spikes):
                    spikes[tick, n] = True
                first = p[VOTES_FROM]
                if first >= 0 and first <= tick < first + steps * bin_ticks:
                    votes[n] += 1
                axon = p[WIRE_AXON]
                if axon >= 0:
                    later = (tick + p[WIRE_DELAY]) & (slots - 1)
                    if flagged[later, axon]:
                        merged += tick + p[WIRE_DELAY] < ticks
                    else:
                        flagged[later, axon] = True
                        due[later, dues[later]] = axon
                        dues[later] += 1
            if at_rest(p, v):
                listed[n] = False
            else:
                awake[waking] = n
                waking += 1
        work, awake = awake, work
        working = waking
        if len(membranes):
            membranes[tick] = membrane
    return merged
