"""A layer of neurons driven by its events: what :mod:`interpret` means, as machine code and without a dense product.

A spike adds the weights that it has, source by source, those of the layer itself after all others. A step
costs as much as the spikes that arrive in it, and a pass over the neurons.
"""

import gc
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numba
import numpy as np
import numpy.typing as npt
from numba.core import event as numba_event
from scipy import sparse

from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import AnyArray, BoolArray, IntArray

Function = Callable[..., Any]

DENORMAL = 1e-30
"""Membranes and currents below this are flushed to zero; beside a threshold they are nothing."""

SHARE_BITS = 12
"""Layers of whole numbers keep shares of so many binary digits."""

GAP = 16
"""Targets this near are joined in one run, with weights of zero in between: a vector costs no more than a weight."""


class Synapses(NamedTuple):
    """Weights by source: bounds of each source's runs of neighbouring targets; of each run the first target and weight.

    Shapes: (sources + 1,), (runs,), (runs + 1,) and (synapses,).
    """

    run: IntArray
    target: IntArray
    offset: IntArray
    weight: AnyArray


class Raster(NamedTuple):
    """Who spiked in each step of recordings that follow each other: sources, and their bounds, (all steps + 1,)."""

    source: npt.NDArray[np.int32]
    bounds: IntArray


def by_source(weights: Sequence[Sparse], dtype: npt.DTypeLike) -> Synapses:
    """Synapses of one population (rows) from the neurons of several (columns), which are numbered one after another."""
    stacked = weights[0] if len(weights) == 1 else sparse.hstack(weights, format="csr")
    columns = sparse.csc_array(stacked)
    source = np.repeat(np.arange(columns.shape[1]), np.diff(columns.indptr))
    distance = np.diff(columns.indices, prepend=0)
    begins = (distance < 1) | (distance > GAP) | (np.diff(source, prepend=-1) != 0)
    at = np.cumsum(np.where(begins, 1, distance)) - 1
    weight = np.zeros(at[-1] + 1 if len(at) else 0, dtype)
    weight[at] = columns.data
    first = np.flatnonzero(begins)
    run = np.searchsorted(first, columns.indptr)
    return Synapses(run, columns.indices[first].astype(np.int64), np.append(at[first], len(weight)), weight)


def no_synapses(dtype: npt.DTypeLike) -> Synapses:
    """Synapses of a population that has no source."""
    none = np.zeros(0, np.int64)
    return Synapses(none, none, none, np.zeros(0, dtype))


class _Notice(numba_event.Listener):
    """Says once on a terminal that machine code is being compiled, which takes seconds."""

    said = False
    depth = 0
    collects = True

    def on_start(self, _event: Any) -> None:
        """The compilation of a function, or of one that it calls, begins."""
        if not self.depth:
            self.collects = gc.isenabled()
            gc.disable()  # the compiler makes so many objects that a tenth of its time would go into it
        self.depth += 1
        if not self.said and sys.stderr.isatty():
            sys.stderr.write("\r\x1b[Kcompiling the simulator's machine code, once after an installation\n")
        self.said = True

    def on_end(self, _event: Any) -> None:
        """It has ended, or failed."""
        self.depth -= 1
        if not self.depth and self.collects:
            gc.enable()


_events: Any = numba_event  # without types
_events.register("numba:compile", _Notice())  # no cache has a function

_KERNEL: Any = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
_PART: Any = {**_KERNEL, "no_cpython_wrapper": True}
"""Nothing is called from C, and a part of a kernel not from Python either."""


def compiled(function: Function) -> Function:
    """Compile a part of a kernel; it is cached with the whole."""
    return cast(Function, numba.njit(**_PART)(function))


def inlined(function: Function) -> Function:
    """Put a part of a kernel in place of each call, before anything is optimised: loops around it are vectorised."""
    return cast(Function, numba.njit(**_PART, inline="always")(function))


def compiled_and_cached(function: Function) -> Function:
    """Compile and keep the machine code on disk, if there is any place for it."""
    try:
        return cast(Function, numba.njit(**_KERNEL, cache=True)(function))
    except RuntimeError:  # neither the folder of this file nor the user's cache folder can be written
        return cast(Function, numba.njit(**_KERNEL)(function))


def require_below(what: str, indices: AnyArray, bound: int) -> None:
    """Refuse indices outside 0..bound-1 with an IndexError: machine code reads whatever lies there instead."""
    if indices.size and not 0 <= (low := int(indices.min())) <= (high := int(indices.max())) < bound:
        raise IndexError(f"{what} {low if low < 0 else high}: allowed are 0..{bound - 1}")


# Each step is a function of its own on one-dimensional arrays: only so does the compiler vectorise the
# loops.


@compiled
def _add(total: Any, first: Any, weight: Any, begin: Any, length: Any) -> None:
    # unsigned, so that no index may count from the end: only then is the loop vectorised
    for i in range(np.uint64(length)):
        total[np.uint64(first) + i] += weight[np.uint64(begin) + i]


@compiled
def _add_four(total: Any, first: Any, weight: Any, a: Any, b: Any, c: Any, d: Any, length: Any) -> None:
    # in the order of four calls of `_add`; sums are read and written once, and four rows are fetched together
    for i in range(np.uint64(length)):
        at = np.uint64(first) + i
        two = total[at] + weight[np.uint64(a) + i] + weight[np.uint64(b) + i]
        total[at] = two + weight[np.uint64(c) + i] + weight[np.uint64(d) + i]


@compiled
def _dense(synapses: Any) -> Any:
    """Whether every source has one run, of the same targets."""
    run, target, offset, _ = synapses
    if len(target) == 0 or len(target) != len(run) - 1:
        return False
    for source in range(len(target)):
        length = offset[source + 1] - offset[source]
        if run[source] != source or target[source] != target[0] or length != offset[1]:
            return False
    return True


@compiled
def _arrive(total: Any, synapses: Any, dense: Any, source: Any, begin: Any, end: Any) -> None:
    """Add the weights of some sources to the sums of their targets."""
    run, target, offset, weight = synapses  # an array taken out of a tuple costs as much as some synapses
    single = begin
    if dense:
        while single + 4 <= end:
            a, b, c, d = source[single], source[single + 1], source[single + 2], source[single + 3]
            _add_four(total, target[0], weight, offset[a], offset[b], offset[c], offset[d], offset[1])
            single += 4
    for event in range(single, end):
        for r in range(run[source[event]], run[source[event] + 1]):
            _add(total, target[r], weight, offset[r], offset[r + 1] - offset[r])


@compiled
def list_fired(fired: Any, listed: Any) -> Any:
    """List who fired, and say how many."""
    n = 0
    for neuron in range(len(fired)):
        if fired[neuron]:
            listed[n] = neuron
            n += 1
    return n


@compiled
def add(values: Any, more: Any) -> None:
    """Add to each value its part of `more`."""
    for i in range(len(values)):
        values[i] += more[i]


@compiled
def copy(values: Any, out: Any) -> None:
    """As ``out[:] = values``, which takes seconds to compile: it can refuse shapes with a message that it composes."""
    for i in range(len(values)):
        out[i] = values[i]


@compiled
def clear(values: Any) -> None:
    """As ``values[:] = 0``, which takes longer to compile."""
    for i in range(len(values)):
        values[i] = 0


@compiled
def _ones(word: Any) -> Any:
    # the compiler knows this sum of ever wider fields as one instruction
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled_and_cached
def coincidences(times: Any, together: Any) -> None:
    """Fill in how often each two inputs spike together, from steps at a bit each: uint64, (inputs, words)."""
    for i in range(len(times)):
        for j in range(i + 1):
            count = np.uint64(0)
            for k in range(times.shape[1]):
                count += _ones(times[i, k] & times[j, k])
            together[i, j] = together[j, i] = count


@compiled
def keep(values: Any, factor: Any) -> None:
    """Let values decay."""
    for i in range(len(values)):
        values[i] *= factor


@compiled
def flush(values: Any, least: Any) -> None:
    """Set what is nearly zero to zero: decay ends in denormals, which cost a hundred times a normal operation."""
    zero = values.dtype.type(0)
    for i in range(len(values)):
        values[i] = zero if abs(values[i]) < least else values[i]


def raster_of(spikes: BoolArray) -> Raster:
    """List spikes (recordings, steps, sources)."""
    rows = np.ascontiguousarray(spikes).view(np.uint8).reshape(-1, spikes.shape[2])
    source = np.empty(np.count_nonzero(rows) + 1, np.int32)
    bounds = np.zeros(len(rows) + 1, np.int64)
    _list_rows(rows, source, bounds)
    return Raster(source[:-1], bounds)


@compiled_and_cached
def _list_rows(rows: Any, source: Any, bounds: Any) -> None:
    """List the spikes of each row; there is a place more than there are spikes, so that no spike is asked for."""
    n = 0
    for row in range(len(rows)):
        fired = rows[row]
        for place in range(len(fired)):
            source[n] = place
            n += fired[place]
        bounds[row + 1] = n


@compiled
def _compare(fired: Any, wanted: Any, moved: Any) -> None:
    # eight neurons at a time, as most do what is wanted of them
    for byte in range(len(wanted)):
        ours = (fired[byte] * np.uint64(0x0102040810204080)) >> np.uint64(56)  # of each byte its lowest bit
        theirs = np.uint64(wanted[byte])
        if ours != theirs:
            for k in range(min(8, moved.shape[1] - 8 * byte)):
                bit = np.uint64(1) << np.uint64(k)
                if (ours ^ theirs) & bit:
                    moved[0, 8 * byte + k] += 1
                    moved[1, 8 * byte + k] += 1 if ours & bit else -1


@compiled
def integrate_float(membrane: Any, current: Any, bias: Any, beta: Any, theta: Any, fired: Any) -> None:
    """Let a step's currents into the membranes, of which those that fired before start from zero."""
    zero = membrane.dtype.type(0)
    for i in range(len(bias)):
        u = (zero if membrane[i] > theta else membrane[i] * beta) + (current[i] + bias[i])
        membrane[i] = u
        fired[i] = u > theta


@inlined
def decayed(value: Any, keep: Any) -> Any:
    """``value * keep / 4096`` rounded toward zero, in the type of the value: no product is wider."""
    # every result is cast: otherwise it is 64 bits wide, and half as many fit a vector
    kind = type(value)
    magnitude = kind(abs(value))
    high = kind(kind(magnitude >> SHARE_BITS) * keep)
    low = kind(kind(kind(magnitude & kind(2**SHARE_BITS - 1)) * keep) >> SHARE_BITS)
    kept = kind(high + low)
    return kind(-kept) if value < kind(0) else kept


@inlined
def charged(current: Any, keep: Any, arrived: Any) -> Any:
    """A current after a step: what is kept of it, and what arrived."""
    return type(current)(decayed(current, keep) + arrived)


@inlined
def integrated(kept: Any, current: Any, bias: Any) -> Any:
    """A membrane after a step, before it saturates: what is kept of it, the current and the bias."""
    kind = type(kept)
    return kind(kind(kept + current) + bias)


@inlined
def saturated(membrane: Any, limit: Any) -> Any:
    """A membrane that passes its limit nowhere."""
    return type(membrane)(min(max(membrane, type(membrane)(-limit)), limit))


@compiled_and_cached
def decay(values: Any, keep: Any) -> None:
    """Let whole numbers (rows, neurons) decay, each neuron's by its own share (neurons,) of 4096."""
    for row in range(len(values)):
        for i in range(len(keep)):
            values[row, i] = decayed(values[row, i], keep[i])


@compiled
def _integrate_integer(
    membrane: Any, current: Any, sums: Any, bias: Any, registers: Any, fired: Any
) -> None:
    threshold, keep_u, keep_v, limit = registers
    zero = membrane.dtype.type(0)
    for i in range(len(bias)):
        arrived = membrane.dtype.type(sums[i])
        if keep_u:
            arrived = charged(current[i], keep_u, arrived)
            current[i] = arrived
        kept = zero if membrane[i] > threshold[i] else decayed(membrane[i], keep_v)
        v = saturated(integrated(kept, arrived, bias[i]), limit)
        membrane[i] = v
        fired[i] = v > threshold[i]


@compiled_and_cached
def run_layer(
    raster: Any,
    synapses: Any,
    own: Any,
    bias: Any,
    registers: Any,
    state: Any,
    before: Any,
    fired: Any,
    membranes: Any,
    wanted: Any,
    words: Any,
    moved: Any,
) -> None:
    """Run the recordings of a raster in the number type of `bias`, each from rest.

    `registers` are the alpha, beta and theta of floats. Of whole numbers they are the thresholds, the shares
    that current and membrane keep in 1/4096, and what no membrane passes. Their number says which: a neuron
    with other registers needs another number of them. `state` (3, neurons) and `before`
    (neurons,) int32 are for its own use: making them here would take compilation.

    `fired` (recordings, steps, neurons) uint8 is filled, and `membranes`, likewise and before the reset,
    unless it is empty. Unless `wanted`, the same at a bit a neuron, is empty, `moved` (2, neurons) int32
    counts in which entries a neuron differs from it, and the spikes that it has more. `fired` then has one
    recording of two steps, with silent neurons up to a multiple of eight, and `words` (2, bytes) uint64 is the
    same memory, eight neurons a word.
    """
    recordings, steps = (wanted if len(wanted) else fired).shape[:2]
    kept, last, _ = fired.shape
    membrane = state[0]
    current = state[1]
    sums = state[2]
    dense = _dense(synapses)
    own_dense = _dense(own)
    for recording in range(recordings):
        clear(membrane)
        clear(current)
        for t in range(steps):
            # how many registers there are is known when this is compiled: only one branch is
            if len(registers) == 3:
                arriving = current
                keep(current, registers[0])
            else:
                arriving = sums
                clear(sums)
            at = recording * steps + t
            now = fired[recording % kept, t % last]
            earlier = fired[recording % kept, (t - 1) % last]
            _arrive(arriving, synapses, dense, raster.source, raster.bounds[at], raster.bounds[at + 1])
            if len(own.run) and t:  # a plain 0 is a type of its own: all would be compiled once more
                _arrive(arriving, own, own_dense, before, np.int64(0), list_fired(earlier, before))
            if len(registers) == 3:
                integrate_float(membrane, current, bias, registers[1], registers[2], now)
            else:
                _integrate_integer(membrane, current, sums, bias, registers, now)
            if len(membranes):
                copy(membrane, membranes[recording, t])
            if len(wanted):
                _compare(words[t % last], wanted[recording, t], moved)
            if len(registers) == 3 and t % 16 == 15:
                flush(membrane, membrane.dtype.type(DENORMAL))
                flush(current, current.dtype.type(DENORMAL))
