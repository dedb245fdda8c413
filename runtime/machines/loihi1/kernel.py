"""The chip step of :mod:`loihi1.spec`, compiled with numba: any network, any number of chip steps at a time.

*Arrivals.* Each compartment has two sums, of positive and of negative weights. A synapse adds ``magnitude << 24 | 1``
to one of them, so that the low bits say whether anything arrived at all, which the count of neuron updates needs.
"""

from typing import Any, NamedTuple

import numpy as np

from spikeloom.compiler.layer_kernel import (
    charged,
    compiled,
    compiled_and_cached,
    copy,
    decayed,
    integrated,
    saturated,
)
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
)
from spikeloom.compiler.types import AnyArray, IntArray

ARRIVAL_BITS = 24
"""Bits of a sum that count synapses."""

SUM_MAX = ACCUMULATOR_MAX >> MEMBRANE_SHIFT
"""Largest synaptic sum that the accumulator holds, in weight units."""


class Tables(NamedTuple):
    """A netlist as the kernel reads it; nothing in here changes."""

    first: IntArray  # (sources + 1,) int64; bounds of each source, channels before compartments, in the synapses
    # sum_of, magnitude: (synapses,) uint32, uint16; the sum that a synapse adds to, and what: that of the
    # positive weights of compartment c is 2 * c, that of the negative ones follows
    sum_of: AnyArray
    magnitude: AnyArray
    begin: AnyArray  # (compartments,) int32; chip step from which the layer of each integrates
    # keep_u, keep_v, threshold, bias: (compartments,) int32; decays in 1/4096, the others in membrane units
    keep_u: AnyArray
    keep_v: AnyArray
    threshold: AnyArray
    bias: AnyArray


class State(NamedTuple):
    """Registers of a chip between two steps, and what was counted so far; changed in place by :func:`chip_steps`."""

    counter: IntArray  # (2,) int64; next chip step; number of compartments that spiked in the last one
    fired: IntArray  # Compartments that spiked in the last step, ``counter[1]`` of them, ascending
    # current, membrane: (compartments,) int32; the two registers, after any reset
    current: AnyArray
    membrane: AnyArray
    # active, sums, worked, flags: Scratch of one step
    active: IntArray
    sums: IntArray
    worked: AnyArray
    flags: AnyArray
    inputs: IntArray  # (channels,) int64; events so far
    # spikes, updates, saturations: (compartments,) int64; counts so far, see :class:`trace.Counts`
    spikes: IntArray
    updates: IntArray
    saturations: IntArray


def tables_of(netlist: Netlist) -> Tables:
    """Lay a netlist out for the kernel."""
    source = netlist.axon_source[netlist.axon_of_synapse()]
    order = np.argsort(source, kind="stable")
    weight = netlist.effective_weight()[order]
    return Tables(
        first=np.searchsorted(source[order], np.arange(netlist.n_inputs + netlist.n_compartments + 1)),
        sum_of=(2 * netlist.synapse_compartment()[order] + (weight < 0)).astype(np.uint32),
        magnitude=np.abs(weight).astype(np.uint16),
        begin=netlist.begins[netlist.layer].astype(np.int32),
        keep_u=netlist.keep_u.astype(np.int32),
        keep_v=netlist.keep_v.astype(np.int32),
        threshold=(netlist.threshold << MEMBRANE_SHIFT).astype(np.int32),
        bias=netlist.bias.astype(np.int32),
    )


def state_of(netlist: Netlist) -> State:
    """State of a chip before the first step: that of a recording, or the blank ones before the first."""
    n = netlist.n_compartments
    channels = netlist.n_inputs
    current, membrane = np.zeros((2, n), np.int32)
    spikes, updates, saturations = np.zeros((3, n), np.int64)
    worked, flags = np.zeros((2, n), np.bool_)
    return State(
        counter=np.array([-netlist.blank, 0]),
        fired=np.zeros(n + 1, np.int64),
        current=current,
        membrane=membrane,
        active=np.zeros(channels + n + 1, np.int64),
        sums=np.zeros(2 * n, np.int64),
        worked=worked,
        flags=flags,
        inputs=np.zeros(channels, np.int64),
        spikes=spikes,
        updates=updates,
        saturations=saturations,
    )


@compiled
def _list_sources(state: State, events: AnyArray, t: int, length: int) -> Any:
    """List the channels with an event in column `t` and the compartments that spiked one step ago."""
    n = 0
    if state.counter[0] < length and t < events.shape[1]:
        for channel in range(events.shape[0]):
            state.active[n] = channel
            n += events[channel, t]
            state.inputs[channel] += events[channel, t]
    fired = state.counter[1]
    state.active[n : n + fired] = events.shape[0] + state.fired[:fired]
    return n + fired


@compiled
def _deliver(tables: Tables, state: State, sources: IntArray) -> None:
    """Let the synapses of the sources arrive."""
    # an array taken out of a tuple costs as much as some synapses: take them out once
    first = tables.first
    sum_of = tables.sum_of
    magnitude = tables.magnitude
    sums = state.sums
    sums[:] = 0
    for source in sources:
        for synapse in range(first[source], first[source + 1]):
            sums[sum_of[synapse]] += (np.int64(magnitude[synapse]) << ARRIVAL_BITS) + 1


@compiled
def _integrate(tables: Tables, state: State, step: int, length: int) -> bool:
    """Let all compartments whose window is open integrate, and say whether a register overflows."""
    begin = tables.begin
    keep_u = tables.keep_u
    keep_v = tables.keep_v
    bias = tables.bias
    threshold = tables.threshold
    current = state.current
    membrane = state.membrane
    sums = state.sums
    flags = state.flags
    worked = state.worked
    saturations = state.saturations
    any_overflow = False
    for c in range(begin.size):
        is_open = (begin[c] <= step) & (step - begin[c] < length)
        arrived = (sums[2 * c] | sums[2 * c + 1]) != 0
        worked[c] = is_open & (arrived | ((current[c] | membrane[c] | bias[c]) != 0))
        # the current decays, and the sums are added
        positive = sums[2 * c] >> ARRIVAL_BITS
        negative = sums[2 * c + 1] >> ARRIVAL_BITS
        u = charged(current[c], keep_u[c], np.int32(np.int32(positive - negative) << MEMBRANE_SHIFT))
        any_overflow |= is_open & ((max(positive, negative) > SUM_MAX) | (abs(u) > CURRENT_MAX))
        # the membrane decays, current and bias are added, it saturates and is compared
        v = integrated(decayed(membrane[c], keep_v[c]), u, bias[c])
        compared = saturated(v, np.int32(MEMBRANE_MAX))
        saturations[c] += is_open & (compared != v)
        flags[c] = is_open & (compared > threshold[c])
        current[c], membrane[c] = (u, compared) if is_open else (np.int32(0), np.int32(0))
    return any_overflow


@compiled
def _first_overflow(state: State, begin: AnyArray, step: int, length: int) -> tuple[Any, int, Any]:
    """Lowest compartment that overflows: its id, its register (0 sum, 1 current) and the value."""
    for c in range(state.current.size):
        if begin[c] <= step and step - begin[c] < length:
            positive = state.sums[2 * c] >> ARRIVAL_BITS
            negative = state.sums[2 * c + 1] >> ARRIVAL_BITS
            if positive > SUM_MAX:
                return c, 0, positive << MEMBRANE_SHIFT
            if negative > SUM_MAX:
                return c, 0, -(negative << MEMBRANE_SHIFT)
            if abs(state.current[c]) > CURRENT_MAX:
                return c, 1, np.int64(state.current[c])
    return -1, 0, np.int64(0)


@compiled
def _reset_and_count(state: State) -> None:
    """Reset the membranes of the compartments that spiked, count and list them for the next step."""
    fired = 0
    listed = state.fired
    flags = state.flags
    worked = state.worked
    updates = state.updates
    for c in range(flags.size):
        updates[c] += worked[c]
        listed[fired] = c
        fired += flags[c]
    for k in range(fired):
        state.membrane[listed[k]] = 0
        state.spikes[listed[k]] += 1
    state.counter[0] += 1
    state.counter[1] = fired


@compiled_and_cached
def chip_steps(
    tables: Tables,
    state: State,
    events: AnyArray,
    steps: int,
    length: int,
    spikes: AnyArray,
    membranes: AnyArray,
    updated: AnyArray,
) -> tuple[int, int, int, int]:
    """Run chip steps; column 0 of `events`, 0 or 1, belongs to the first of them.

    `spikes`, `membranes` and `updated` have one row per step, or none where they are not wanted. Returns
    chip step, compartment, register and value of the first overflow; the compartment is -1 if there is none.
    """
    for t in range(steps):
        step = state.counter[0]
        n = _list_sources(state, events, t, length)
        _deliver(tables, state, state.active[:n])
        if _integrate(tables, state, step, length):
            compartment, register, value = _first_overflow(state, tables.begin, step, length)
            return step, compartment, register, value
        if spikes.shape[0]:
            copy(state.flags, spikes[t])
        if membranes.shape[0]:
            copy(state.membrane, membranes[t])
        if updated.shape[0]:
            copy(state.worked, updated[t])
        _reset_and_count(state)
    return -1, -1, 0, 0
