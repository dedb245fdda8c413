"""The chip step of :mod:`loihi1.spec`, compiled with numba; :mod:`loihi1.engine` prepares what it reads.

*Rows.* The synapses of a source are a few dense segments of positions, zeros included: delivering a spike is a
handful of vector additions. Sources with the same segments have the same "shape"; four such neighbours are delivered
at once.

*Packing.* A row entry is ``weight << shift | 1`` for a synapse, so that one addition also counts arrivals: the low
bits of an accumulator say whether any synapse reached the compartment, which the count of neuron updates needs.

*Runs.* The compartments of a layer that follow each other and share decays are one vector loop.

*Decay in 32 bits.* With ``m = 4096 a + b``, ``floor(m f / 4096) = a f + floor(b f / 4096)``; for ``m < 2**23`` and
``f <= 4096`` nothing exceeds 2**24.

*Specialisations.* Without `negative` weights no register can overflow, net weights add up and nothing is checked; with
them positive and negative weights add up apart and every step is checked. Sums are kept in 64 bits where all synapses
at once would not fit into 32.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import njit

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.types import IntArray

AnyArray = npt.NDArray[Any]
Function = TypeVar("Function", bound=Callable[..., Any])

FOLDED_SHIFT = 1
"""Shift of the accumulator that the checked kernel hands to the sweep."""


class Tables(NamedTuple):
    """A netlist as the kernel reads it; nothing in here changes."""

    # shape, base: (sources,) int64; shape of each source's row, and where its entries begin in `weight`
    shape: IntArray
    base: IntArray
    first: IntArray  # (shapes + 1,) int64; bounds of each shape in the segment arrays
    # start, stop, offset: (segments,) int64; positions of a segment, and where its entries begin within a row
    start: IntArray
    stop: IntArray
    offset: IntArray
    # (entries,) int32 or int64; packed net weights; where registers are checked, packed positive weights
    weight: AnyArray
    shift: np.int32  # Bits that count arrivals
    run_start: IntArray  # (runs + 1,) int64; bounds of the runs in positions
    # run_layer, run_depth: (runs,) int64; layer of a run and its depth
    run_layer: IntArray
    run_depth: IntArray
    # keep_u, keep_v: (runs,) int32; what current and membrane keep in a step, in 1/4096
    keep_u: AnyArray
    keep_v: AnyArray
    # threshold, bias: (padded positions,) int32; in membrane units
    threshold: AnyArray
    bias: AnyArray
    compartment: IntArray  # (positions,) int64; compartment id of each position


class State(NamedTuple):
    """Registers of a chip between two steps, and what was counted so far; changed in place by :func:`advance`."""

    clock: IntArray  # (2,) int64; next chip step; number of compartments that spiked in the last one
    fired: IntArray  # Sources that spiked in the last step, ``clock[1]`` of them
    # current, membrane: (padded positions,) int32; the two registers of each position, after any reset
    current: AnyArray
    membrane: AnyArray
    # total, positive, negative, flags, worked, active: Scratch of one step; `flags` and `worked` tell who spiked and
    # who had work to do
    total: AnyArray
    positive: AnyArray
    negative: AnyArray
    flags: AnyArray
    worked: AnyArray
    active: IntArray
    # inputs, spikes, updates, saturations: See :class:`trace.Counts`
    inputs: IntArray
    spikes: IntArray
    updates: IntArray
    saturations: IntArray


def compiled(function: Function) -> Function:
    """Compile a part of the kernel; it is cached with the whole."""
    return cast(Function, njit(nogil=True)(function))


def compiled_and_cached(function: Function) -> Function:
    """Compile and keep the machine code on disk, if there is any place for it."""
    try:
        return cast(Function, njit(nogil=True, cache=True)(function))
    except RuntimeError:  # neither the folder of this file nor the user's cache folder can be written
        return cast(Function, njit(nogil=True)(function))


@compiled
def _kept(x: Any, factor: Any) -> Any:
    """``x * factor / 4096`` rounded toward zero; all int32."""
    magnitude = np.int32(abs(x))
    high = np.int32(np.int32(magnitude >> DECAY_BITS) * factor)
    low = np.int32(np.int32(np.int32(magnitude & (2**DECAY_BITS - 1)) * factor) >> DECAY_BITS)
    kept = np.int32(high + low)
    return np.int32(-kept) if x < 0 else kept


@compiled
def _is_open(tables: Tables, run: int, step: int, length: int) -> Any:
    """Whether a run integrates in this chip step."""
    return 0 <= step - tables.run_depth[run] < length


@compiled
def _list_sources(state: State, events: AnyArray, t: int, length: int) -> int:
    """List the channels with an event in column `t` and the compartments that spiked one step ago."""
    n = 0
    if state.clock[0] < length and t < events.shape[1]:
        for channel in range(events.shape[0]):
            state.active[n] = channel
            n += events[channel, t]
            state.inputs[channel] += events[channel, t]
    for k in range(state.clock[1]):
        state.active[n] = state.fired[k]
        n += 1
    return n


@compiled
def _deliver(tables: Tables, weight: AnyArray, sources: AnyArray, total: AnyArray) -> None:
    """Add the rows of all sources to the accumulators."""
    k = 0
    while k < sources.size:
        shape = tables.shape[sources[k]]
        row = weight[tables.base[sources[k]] :]
        if (
            k + 3 < sources.size
            and tables.shape[sources[k + 1]] == shape
            and tables.shape[sources[k + 2]] == shape
            and tables.shape[sources[k + 3]] == shape
        ):
            row1 = weight[tables.base[sources[k + 1]] :]
            row2 = weight[tables.base[sources[k + 2]] :]
            row3 = weight[tables.base[sources[k + 3]] :]
            for g in range(tables.first[shape], tables.first[shape + 1]):
                part = total[tables.start[g] : tables.stop[g]]
                begin = tables.offset[g]
                end = begin + part.size
                a, b, c, d = row[begin:end], row1[begin:end], row2[begin:end], row3[begin:end]
                for i in range(part.size):
                    part[i] += a[i] + b[i] + c[i] + d[i]
            k += 4
        else:
            for g in range(tables.first[shape], tables.first[shape + 1]):
                part = total[tables.start[g] : tables.stop[g]]
                a = row[tables.offset[g] : tables.offset[g] + part.size]
                for i in range(part.size):
                    part[i] += a[i]
            k += 1


@compiled
def _fold(positive: AnyArray, negative: AnyArray, shift: Any, current: AnyArray, keep_u: Any, total: AnyArray) -> bool:
    """Turn the two sums of a run into one packed accumulator; return whether a register overflows."""
    overflow = False
    for i in range(total.size):
        p = positive[i] >> shift
        n = negative[i] >> shift
        u = _kept(current[i], keep_u) + ((p - n) << MEMBRANE_SHIFT)
        overflow |= (max(p, n) << MEMBRANE_SHIFT > ACCUMULATOR_MAX) | (abs(u) > CURRENT_MAX)
        arrivals = (positive[i] | negative[i]) & ((1 << shift) - 1)
        total[i] = ((p - n) << FOLDED_SHIFT) | (arrivals != 0)
    return overflow


@compiled
def _deliver_checked(tables: Tables, negative: AnyArray, state: State, n: int, step: int, length: int) -> bool:
    """Deliver the active sources; return whether a register overflows, and leave the sums in place if so."""
    _deliver(tables, tables.weight, state.active[:n], state.positive)
    _deliver(tables, negative, state.active[:n], state.negative)
    overflow = False
    for r in range(tables.run_layer.size):
        if _is_open(tables, r, step, length):
            run = slice(tables.run_start[r], tables.run_start[r + 1])
            overflow |= _fold(
                state.positive[run],
                state.negative[run],
                tables.shift,
                state.current[run],
                tables.keep_u[r],
                state.total[run],
            )
    if not overflow:
        state.positive[:] = 0
        state.negative[:] = 0
    return overflow


@compiled
def _find_overflow(tables: Tables, state: State, step: int, length: int) -> tuple[int, int, int]:
    """Lowest compartment that overflows: its id, its register (0 sum, 1 current) and the value."""
    found, register, value = tables.compartment.size, 0, 0
    for r in range(tables.run_layer.size):
        if _is_open(tables, r, step, length):
            for i in range(tables.run_start[r], tables.run_start[r + 1]):
                p = (state.positive[i] >> tables.shift) << MEMBRANE_SHIFT
                n = (state.negative[i] >> tables.shift) << MEMBRANE_SHIFT
                u = _kept(state.current[i], tables.keep_u[r]) + p - n
                if tables.compartment[i] < found:
                    if p > ACCUMULATOR_MAX:
                        found, register, value = tables.compartment[i], 0, p
                    elif n > ACCUMULATOR_MAX:
                        found, register, value = tables.compartment[i], 0, -n
                    elif abs(u) > CURRENT_MAX:
                        found, register, value = tables.compartment[i], 1, u
    return found, register, value


@compiled
def _sweep(
    total: AnyArray,
    shift: Any,
    current: AnyArray,
    membrane: AnyArray,
    bias: AnyArray,
    threshold: AnyArray,
    keep_u: Any,
    keep_v: Any,
    flags: AnyArray,
    worked: AnyArray,
) -> tuple[Any, Any]:
    """Let a run integrate; membranes are left before reset. All is int32: wider numbers would halve the speed."""
    arrivals = np.int32((1 << shift) - 1)
    updates = np.int32(0)
    saturations = np.int32(0)
    for i in range(total.size):
        packed, u, v, b = total[i], current[i], membrane[i], bias[i]
        total[i] = 0
        works = np.int32(u | v | b | np.int32(packed & arrivals)) != 0
        worked[i] = np.uint8(works)
        updates = np.int32(updates + (np.int32(1) if works else np.int32(0)))
        # gather input, decay current, add
        u = np.int32(_kept(u, keep_u) + np.int32(np.int32(packed >> shift) << MEMBRANE_SHIFT))
        # decay membrane, add bias
        v = np.int32(np.int32(_kept(v, keep_v) + u) + b)
        # saturate
        compared = np.int32(min(max(v, np.int32(-MEMBRANE_MAX)), np.int32(MEMBRANE_MAX)))
        saturations = np.int32(saturations + (np.int32(1) if compared != v else np.int32(0)))
        # compare
        flags[i] = np.uint8(compared > threshold[i])
        current[i] = u
        membrane[i] = compared
    return updates, saturations


@compiled
def _integrate(tables: Tables, state: State, shift: Any, step: int, length: int) -> None:
    """Let all runs integrate whose window is open; hold the others at rest."""
    for r in range(tables.run_layer.size):
        run = slice(tables.run_start[r], tables.run_start[r + 1])
        if _is_open(tables, r, step, length):
            updates, saturations = _sweep(
                state.total[run],
                shift,
                state.current[run],
                state.membrane[run],
                tables.bias[run],
                tables.threshold[run],
                tables.keep_u[r],
                tables.keep_v[r],
                state.flags[run],
                state.worked[run],
            )
            state.updates[tables.run_layer[r]] += updates
            state.saturations[tables.run_layer[r]] += saturations
        else:
            state.total[run] = 0
            state.current[run] = 0
            state.membrane[run] = 0
            state.flags[run] = 0
            state.worked[run] = 0


@compiled
def _reset_and_count(tables: Tables, state: State, n_inputs: int, spikes: AnyArray, t: int) -> None:
    """Reset the membranes of the compartments that spiked, count and list them for the next step."""
    fired = 0
    words = state.flags.view(np.uint64)
    for w in range(words.size):
        if words[w]:  # most groups of eight flags are empty
            for i in range(8 * w, 8 * w + 8):
                state.fired[fired] = n_inputs + i
                fired += state.flags[i]
    for k in range(fired):
        i = state.fired[k] - n_inputs
        state.membrane[i] = 0
        state.spikes[tables.compartment[i]] += 1
        if spikes.shape[0]:
            spikes[t, tables.compartment[i]] = True
    state.clock[0] += 1
    state.clock[1] = fired


@compiled_and_cached
def chip_steps(
    tables: Tables,
    negative: AnyArray | None,
    state: State,
    events: AnyArray,
    steps: int,
    length: int,
    spikes: AnyArray,
    membranes: AnyArray,
    updated: AnyArray,
) -> tuple[int, int, int, int]:
    """Run chip steps; column 0 of `events`, 0 or 1, belongs to the first of them.

    `spikes`, `membranes` and `updated` have one row per step, or none where they are not wanted. Returns chip step,
    compartment, register and value of the first overflow; the chip step is -1 if there is none.
    """
    for t in range(steps):
        step = state.clock[0]
        n = _list_sources(state, events, t, length)
        if negative is None:
            _deliver(tables, tables.weight, state.active[:n], state.total)
            _integrate(tables, state, tables.shift, step, length)
        else:
            if _deliver_checked(tables, negative, state, n, step, length):
                found, register, value = _find_overflow(tables, state, step, length)
                return step, found, register, value
            _integrate(tables, state, np.int32(FOLDED_SHIFT), step, length)
        if membranes.shape[0]:
            for i in range(tables.compartment.size):
                membranes[t, tables.compartment[i]] = state.membrane[i]
        if updated.shape[0]:
            for i in range(tables.compartment.size):
                updated[t, tables.compartment[i]] = state.worked[i] != 0
        _reset_and_count(tables, state, events.shape[0], spikes, t)
    return -1, 0, 0, 0
