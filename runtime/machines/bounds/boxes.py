"""What groups of changed events can turn when little is known of the past: interval arithmetic.

A *group* is all that changes in one step. Of the past only this is known: the groups before it are at least
so many steps ago, or the last of them was one event, so many steps ago. From there on the events are those of the
known recording, and of runs with one event each the widest bounds are taken. Each place has a least and a
largest membrane and current; a spike is sure, impossible or open; open spikes widen the sums that they
reach. Decay is monotone, so that bounds stay bounds. A run is over once every membrane is safe.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spikeloom.compiler.layer_kernel import clear, compiled, copy
from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.bounds.arithmetic import LANES, step_block, surely, unknown, unsafe


class Base(NamedTuple):
    """Bounds before a step, and spikes that are open then."""

    # low_u, high_u, low_v, high_v: (places,), in the numbers of the arithmetic
    low_u: AnyArray
    high_u: AnyArray
    low_v: AnyArray
    high_v: AnyArray
    listed: IntArray
    kind: IntArray
    live: AnyArray  # (blocks,) uint8; in which a membrane is not safe


class Work(NamedTuple):
    """A run with a group."""

    low_u: AnyArray
    high_u: AnyArray
    low_v: AnyArray
    high_v: AnyArray
    # low, high: (places,); what sums have more than the known ones, all zero between two steps
    low: AnyArray
    high: AnyArray
    # listed, kind: int64; sources whose spikes differ for sure (1 and -1), or may (2 and -2), by coming or going
    listed: IntArray
    kind: IntArray
    codes: (
        AnyArray  # (places,) uint8; 3 for a sure spike, 2 for an open one; of a block, while it is stepped
    )
    arrived: (
        IntArray  # (2,) int64; how many spikes arrived last that differ, or may, and how many that differ
    )
    live: AnyArray  # (blocks,) uint8; that are simulated
    turned: IntArray  # (classes,) int64; votes gained


# Each loop is a function of its own that writes one array: only so does the compiler vectorise it.


@compiled
def any_of(values: Any, first: Any) -> Any:
    """Whether a block has a value that is not zero."""
    found = np.uint8(0)
    for i in range(first, first + np.uint64(LANES)):
        found |= np.uint8(values[i] != 0)
    return found != 0


@compiled
def wipe(values: Any, first: Any) -> None:
    """Set a block to zero."""
    for i in range(first, first + np.uint64(LANES)):
        values[i] = 0


@compiled
def _least_of(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    kind = weight.dtype.type  # cast, as a whole number would become one of 64 bits
    for i in range(length):
        total[first + i] += min(kind(sign * weight[begin + i]), kind(0))


@compiled
def _most_of(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    kind = weight.dtype.type
    for i in range(length):
        total[first + i] += max(kind(sign * weight[begin + i]), kind(0))


@compiled
def arrive(chip: Any, work: Any, n: Any) -> None:
    """Let spikes arrive that differ, or may."""
    begins, target, offset, weight = chip.synapses
    work.arrived[0] = n
    work.arrived[1] = 0
    for k in range(n):
        source = work.listed[k]
        sure = abs(work.kind[k]) == 1
        work.arrived[1] += sure
        sign = np.int32(1) if work.kind[k] > 0 else np.int32(-1)
        for r in range(begins[source], begins[source + 1]):
            first = np.uint64(target[r])
            begin = np.uint64(offset[r])
            length = np.uint64(offset[r + 1] - offset[r])
            if sure:
                surely(chip, work, sign, first, begin, length)
            else:
                _least_of(work.low, weight, sign, first, begin, length)
                _most_of(work.high, weight, sign, first, begin, length)


@compiled
def list_open(known: Any, work: Any, t: Any, block: Any, n: Any) -> Any:
    """List what spikes otherwise in a block, or may, by its codes."""
    channels = len(known.events)
    for c in range(block * LANES, (block + 1) * LANES):
        fired = known.fired[t, c]
        if work.codes[c] != 3 * fired:
            work.listed[n] = channels + c
            size = 2 if work.codes[c] == 2 else 1
            work.kind[n] = -size if fired else size
            n += 1
    return n


@compiled
def box_of(of: Any) -> Any:
    """Bounds of currents and membranes, as :func:`arithmetic.unsafe` takes them."""
    return of.low_u, of.high_u, of.low_v, of.high_v


@compiled
def copy_state(source: Any, target: Any, n: Any) -> None:
    """Copy bounds and the first `n` spikes that are open."""
    copy(source.low_u, target.low_u)
    copy(source.high_u, target.high_u)
    copy(source.low_v, target.low_v)
    copy(source.high_v, target.high_v)
    copy(source.listed[:n], target.listed[:n])
    copy(source.kind[:n], target.kind[:n])


@compiled
def past_of(chip: Any, known: Any, start: Any, t: Any, base: Any, work: Any) -> Any:
    """Bounds before step `t` where nothing is known of what was before `start`; spikes that are open then."""
    n = 0
    clear(work.low)
    clear(work.high)
    if start <= 0:
        copy(known.current[t], base.low_u)
        copy(known.current[t], base.high_u)
        copy(known.membrane[t], base.low_v)
        copy(known.membrane[t], base.high_v)
    else:
        n = unknown(chip, known, start, work)
        for s in range(start, t):
            arrive(chip, work, n)
            n = 0
            for block in range(len(chip.depth)):
                n = step_block(chip, known, work, s, block, n)
        copy_state(work, base, n)
    return n


@compiled
def watch(chip: Any, known: Any, bounds: Any, t: Any, base: Any) -> None:
    """Blocks in which a membrane is not safe before a step."""
    for block in range(len(chip.depth)):
        base.live[block] = unsafe(chip, known, bounds, box_of(base), t, block)


@compiled
def hull_of(
    chip: Any, known: Any, start: Any, t: Any, channels: Any, n: Any, base: Any, work: Any, hull: Any
) -> Any:
    """Bounds before step `t` of all runs in which one event of step `start` changes; spikes that are open then.

    `base` are the bounds before `start`, and from here on those before `t`.
    """
    clear(hull.kind)
    count = 0
    for source in range(channels):
        clear(work.low)
        clear(work.high)
        copy_state(base, work, n)
        work.listed[n] = source
        work.kind[n] = -1 if known.events[source, start] else 1
        m = n + 1
        for s in range(start, t):
            arrive(chip, work, m)
            m = 0
            for block in range(len(chip.depth)):
                m = step_block(chip, known, work, s, block, m)
        if source == 0:
            copy_state(work, hull, 0)
        _lower(work.low_u, hull.low_u)
        _raise(work.high_u, hull.high_u)
        _lower(work.low_v, hull.low_v)
        _raise(work.high_v, hull.high_v)
        for k in range(m):
            if hull.kind[work.listed[k]] == 0:
                hull.kind[work.listed[k]] = -2 if work.kind[k] < 0 else 2
                hull.listed[count] = work.listed[k]
                count += 1
    copy_state(hull, base, 0)
    for k in range(count):
        base.listed[k] = hull.listed[k]
        base.kind[k] = hull.kind[hull.listed[k]]
    return count


@compiled
def _lower(values: Any, least: Any) -> None:
    for i in range(len(values)):
        least[i] = min(least[i], values[i])


@compiled
def _raise(values: Any, most: Any) -> None:
    for i in range(len(values)):
        most[i] = max(most[i], values[i])
