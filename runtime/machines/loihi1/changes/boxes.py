"""What groups of changed events can turn when little is known of the past: interval arithmetic on the chip's integers.

A *group* is all that changes in one step. Of the past only this is known: the groups before it are at least
so many steps ago, or the last of them was one event, so many steps ago. From there on the events are those of the
known recording, and of runs with one event each the widest bounds are taken. Each place has a least and a
largest membrane and current; a spike is sure, impossible or open; open spikes widen the sums that they
reach. Decay is monotone, so that bounds stay bounds. A run is over once every membrane is :mod:`changes.safe`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spikeloom.compiler.layer_kernel import (
    charged,
    clear,
    compiled,
    compiled_and_cached,
    copy,
    require_below,
    saturated,
)
from spikeloom.compiler.targets.loihi1.registers import CURRENT_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.changes import Groups, Past
from spikeloom.runtime.machines.loihi1.changes.chip import LANES, NEVER, Chip, Known
from spikeloom.runtime.machines.loihi1.changes.kernel import integrate
from spikeloom.runtime.machines.loihi1.changes.safe import FAR, Safe, safe, unsafe

HORIZON = 512
"""Steps after a group for which its run is followed; of the rest every vote counts as turned."""


def groups(chip: Chip, known: Known, shape: tuple[int, int, int], decision: int, reach: int) -> Groups:
    """Bound what groups of events turn; `shape` are channels and steps in which events may change, and classes."""
    channels, steps, classes = shape
    places = len(chip.bias)
    sources = places + 2 * len(known.events)
    blocks = np.zeros((3, len(chip.depth)), np.uint8)
    registers = np.zeros((14, places), np.int32)
    lists = np.zeros((6, sources), np.int64)
    codes = np.zeros(places, np.uint8)
    base = _Base._make([*registers[:4], *lists[:2], blocks[0]])
    hull = _Base._make([*registers[4:8], *lists[2:4], blocks[1]])
    work = _Work._make([*registers[8:], *lists[4:], codes, blocks[2], np.zeros(classes, np.int64)])
    lag = lag_of(chip, known)
    bounds = safe(chip, known)
    left = _left(chip, known, classes)
    lost = np.full((steps, reach, classes), -FAR, np.int32)
    _bound(chip, known, bounds, left, channels, decision, lag, base, work, lost)

    def after(past: Past, step: int) -> AnyArray:
        require_below("step", np.array([step, step - past.steps * past.single]), steps)
        found = np.full((2, reach, classes), -FAR, np.int32)
        _bound_after(chip, known, bounds, left, channels, decision, lag, past, step, base, hull, work, found)
        return found

    return Groups(lag, lost, after)


class _Base(NamedTuple):
    """Bounds before a step, and spikes that are open then."""

    # low_u, high_u, low_v, high_v: (places,) int32
    low_u: AnyArray
    high_u: AnyArray
    low_v: AnyArray
    high_v: AnyArray
    listed: IntArray
    kind: IntArray
    live: AnyArray  # (blocks,) uint8; in which a membrane is not safe


class _Work(NamedTuple):
    """A run with a group."""

    low_u: AnyArray
    high_u: AnyArray
    low_v: AnyArray
    high_v: AnyArray
    # low, high: (places,) int32; what sums have more than the known ones, all zero between two steps
    low: AnyArray
    high: AnyArray
    # listed, kind: int64; sources whose spikes differ for sure (1 and -1), or may (2 and -2), by coming or going
    listed: IntArray
    kind: IntArray
    codes: AnyArray  # (places,) uint8; 3 for a sure spike, 2 for an open one
    live: AnyArray  # (blocks,) uint8; that are simulated
    turned: IntArray  # (classes,) int64; votes gained


def lag_of(chip: Chip, known: Known) -> int:
    """Least number of synapses on a path from an input to a compartment that votes, minus one."""
    begins, target, offset, _ = chip.synapses
    channels = len(known.events)
    lag = 0
    reached = np.arange(len(begins) - 1) < channels
    while lag < len(known.fired) and not np.any(chip.label[reached[channels:]] >= 0):
        lag += 1
        for source in np.flatnonzero(reached):
            for r in range(begins[source], begins[source + 1]):
                reached[channels + target[r] : channels + target[r] + offset[r + 1] - offset[r]] = True
    return max(lag - 1, 0)


def _left(chip: Chip, known: Known, classes: int) -> IntArray:
    """Votes that can still go, and come, from each step on, (2, steps + 1, classes)."""
    steps = len(known.fired)
    left = np.zeros((2, steps + 1, classes), np.int64)
    voters = np.flatnonzero(chip.label >= 0)
    depth = np.repeat(chip.depth, LANES)[voters]
    for t in range(steps - 1, -1, -1):
        left[:, t] = left[:, t + 1]
        inside = (depth <= t) & (t < depth + known.events.shape[1])
        fired = known.fired[t, voters] != 0
        np.add.at(left[0, t], chip.label[voters[fired & inside]], 1)
        np.add.at(left[1, t], chip.label[voters[~fired & inside]], 1)
    return left


# Each loop is a function of its own that writes one array: only so does the compiler vectorise it.


@compiled
def _charge(current: Any, keep: Any, sums: Any, more: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        arrived = np.int32(np.int32(sums[i] + more[i]) << np.int32(MEMBRANE_SHIFT))
        current[i] = saturated(charged(current[i], keep[i], arrived), np.int32(CURRENT_MAX))


@compiled
def _code(codes: Any, low: Any, high: Any, threshold: Any, fired: Any, first: Any) -> Any:
    different = np.uint8(0)
    for i in range(first, first + np.uint64(LANES)):
        sure = np.uint8(low[i] > threshold[i])
        may = np.uint8(high[i] > threshold[i])
        codes[i] = np.uint8(sure + np.uint8(may << np.uint8(1)))
        different |= np.uint8(np.uint8(sure ^ fired[i]) | np.uint8(may ^ fired[i]))
    return different


@compiled
def _reset_low(low: Any, codes: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        v = min(low[i], np.int32(0)) if codes[i] == np.uint8(2) else low[i]
        low[i] = np.int32(0) if codes[i] == np.uint8(3) else v


@compiled
def _reset_high(high: Any, codes: Any, threshold: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        v = max(threshold[i], np.int32(0)) if codes[i] == np.uint8(2) else high[i]
        high[i] = np.int32(0) if codes[i] == np.uint8(3) else v


@compiled
def _any(values: Any, first: Any) -> Any:
    found = np.int32(0)
    for i in range(first, first + np.uint64(LANES)):
        found |= values[i]
    return found != 0


@compiled
def _wipe(values: Any, first: Any) -> None:
    for i in range(first, first + np.uint64(LANES)):
        values[i] = 0


@compiled
def _least_of(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += min(np.int32(sign * weight[begin + i]), np.int32(0))


@compiled
def _most_of(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += max(np.int32(sign * weight[begin + i]), np.int32(0))


@compiled
def _both(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += np.int32(sign * weight[begin + i])


@compiled
def _arrive(chip: Chip, work: Any, n: Any) -> None:
    """Let spikes arrive that differ, or may."""
    begins, target, offset, weight = chip.synapses
    for k in range(n):
        source = work.listed[k]
        sure = abs(work.kind[k]) == 1
        sign = np.int32(1) if work.kind[k] > 0 else np.int32(-1)
        for r in range(begins[source], begins[source + 1]):
            first = np.uint64(target[r])
            begin = np.uint64(offset[r])
            length = np.uint64(offset[r + 1] - offset[r])
            if sure:
                _both(work.low, weight, sign, first, begin, length)
                _both(work.high, weight, sign, first, begin, length)
            else:
                _least_of(work.low, weight, sign, first, begin, length)
                _most_of(work.high, weight, sign, first, begin, length)


@compiled
def _step(chip: Chip, known: Known, work: Any, t: Any, block: Any, n: Any) -> Any:
    """One step of a block; lists what spikes otherwise, or may, after `n` others."""
    first = np.uint64(block * LANES)
    channels, length = known.events.shape
    if not chip.depth[block] <= t < chip.depth[block] + length:
        _wipe(work.low_u, first)
        _wipe(work.high_u, first)
        _wipe(work.low_v, first)
        _wipe(work.high_v, first)
    else:
        _charge(work.low_u, chip.keep_u, known.sums[t], work.low, first)
        _charge(work.high_u, chip.keep_u, known.sums[t], work.high, first)
        integrate(work.low_v, chip.keep_v, work.low_u, chip.bias, first, np.uint64(LANES))
        integrate(work.high_v, chip.keep_v, work.high_u, chip.bias, first, np.uint64(LANES))
        if _code(work.codes, work.low_v, work.high_v, chip.threshold, known.fired[t], first):
            for c in range(block * LANES, (block + 1) * LANES):
                fired = known.fired[t, c]
                if work.codes[c] != 3 * fired:
                    work.listed[n] = channels + c
                    size = 2 if work.codes[c] == 2 else 1
                    work.kind[n] = -size if fired else size
                    n += 1
        _reset_low(work.low_v, work.codes, first)
        _reset_high(work.high_v, work.codes, chip.threshold, first)
    _wipe(work.low, first)
    _wipe(work.high, first)
    return n


@compiled
def _box(of: Any) -> Any:
    return of.low_u, of.high_u, of.low_v, of.high_v


@compiled
def _unknown(chip: Chip, known: Known, start: Any, work: Any) -> Any:
    """Bounds of registers before a step, whatever was before; lists those that may have fired otherwise than known."""
    channels, length = known.events.shape
    n = 0
    most = np.int32(CURRENT_MAX)
    for c in range(len(chip.bias)):
        depth = chip.depth[c // LANES]
        inside = chip.threshold[c] != NEVER and depth < start <= depth + length  # else all are zero
        lasts = inside and chip.keep_u[c] != 0
        work.low_u[c] = -most if lasts else np.int32(0)
        work.high_u[c] = most if lasts else np.int32(0)
        work.low_v[c] = chip.lowest[c] if inside else np.int32(0)
        work.high_v[c] = max(chip.threshold[c], np.int32(0)) if inside else np.int32(0)
        work.listed[n] = channels + c
        work.kind[n] = -2 if known.fired[start - 1, c] else 2
        n += inside
    return n


@compiled
def _copy_state(source: Any, target: Any, n: Any) -> None:
    copy(source.low_u, target.low_u)
    copy(source.high_u, target.high_u)
    copy(source.low_v, target.low_v)
    copy(source.high_v, target.high_v)
    copy(source.listed[:n], target.listed[:n])
    copy(source.kind[:n], target.kind[:n])


@compiled
def _past(chip: Chip, known: Known, start: Any, t: Any, base: Any, work: Any) -> Any:
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
        n = _unknown(chip, known, start, work)
        for s in range(start, t):
            _arrive(chip, work, n)
            n = 0
            for block in range(len(chip.depth)):
                n = _step(chip, known, work, s, block, n)
        _copy_state(work, base, n)
    return n


@compiled
def _watch(chip: Chip, known: Known, bounds: Safe, t: Any, base: Any) -> None:
    """Blocks in which a membrane is not safe before a step."""
    for block in range(len(chip.depth)):
        base.live[block] = unsafe(chip, known, bounds, _box(base), t, block)


@compiled
def _count(chip: Chip, known: Known, t: Any, decision: Any, work: Any, n: Any) -> Any:
    """Votes that other classes gain, and that the decision loses, at worst, in a step."""
    lost = np.int64(0)
    channels = len(known.events)
    for k in range(n):
        c = work.listed[k] - channels
        label = chip.label[c]
        fired = known.fired[t, c]
        if label >= 0:
            if label == decision:
                lost += np.int64(fired) - np.int64(work.codes[c] == 3)
            else:
                work.turned[label] += np.int64(work.codes[c] >= 2) - np.int64(fired)
    return lost


@compiled
def _note(lost: Any, turned: Any, gone: Any, first: Any, last: Any) -> None:
    for r in range(max(first, 0), last):
        for label in range(len(turned)):
            lost[r, label] = max(lost[r, label], turned[label] + gone)


@compiled
def _advance(chip: Chip, known: Known, bounds: Safe, work: Any, t: Any) -> Any:
    """One step of all blocks that are simulated; which of them need not be any more; how many spikes differ, or may."""
    n = 0
    clear_above = True  # nothing comes from layers before that is not known
    layer_clear = True
    for block in range(len(chip.depth)):
        if block and chip.layer[block] != chip.layer[block - 1]:
            clear_above = layer_clear and n == 0
            layer_clear = clear_above
        if work.live[block]:
            n = _step(chip, known, work, t, block, n)
            if (clear_above and chip.ordered) and not unsafe(chip, known, bounds, _box(work), t + 1, block):
                work.live[block] = 0
            else:
                layer_clear = False
    return n


@compiled
def _over(chip: Chip, known: Known, bounds: Safe, work: Any, t: Any) -> Any:
    """Whether every block is safe."""
    for block in range(len(chip.depth)):
        if work.live[block] and (chip.ordered or unsafe(chip, known, bounds, _box(work), t, block)):
            return False
    return True


@compiled
def _follow(
    chip: Chip,
    known: Known,
    bounds: Safe,
    left: Any,
    start: Any,
    n: Any,
    decision: Any,
    lag: Any,
    base: Any,
    work: Any,
    lost: Any,
) -> Any:
    """Run on from a step, whose sums have what its group adds; notes votes that are lost; whether the run ended."""
    steps = len(known.sums)
    reach = len(lost)
    gone = 0
    clear(work.turned)
    clear(work.low)
    clear(work.high)
    _arrive(chip, work, n)
    for block in range(len(chip.depth)):
        first = np.uint64(block * LANES)
        reached = _any(work.low, first) or _any(work.high, first)
        work.live[block] = base.live[block] or reached or not chip.outer[block]
    t = start
    over = False
    while True:
        n = _advance(chip, known, bounds, work, t)
        if t >= start + lag:
            gone += _count(chip, known, t, decision, work, n)
        t += 1
        over = n == 0 and _over(chip, known, bounds, work, t)
        r = min(t - start - lag, reach)  # a next group so many steps later cannot alter what was until now
        if over or t == steps or t == start + HORIZON:
            break
        _note(lost, work.turned, gone, r - 1, r)
        _arrive(chip, work, n)
    if not over and t < steps:
        gone += left[0, t, decision]
        for label in range(len(work.turned)):
            work.turned[label] += left[1, t, label]
    _note(lost, work.turned, gone, r - 1, reach)
    return over or t == steps


@compiled
def _hull(
    chip: Chip, known: Known, start: Any, t: Any, channels: Any, n: Any, base: Any, work: Any, hull: Any
) -> Any:
    """Bounds before step `t` of all runs in which one event of step `start` changes; spikes that are open then.

    `base` are the bounds before `start`, and from here on those before `t`.
    """
    clear(hull.kind)
    count = 0
    for source in range(channels):
        clear(work.low)
        clear(work.high)
        _copy_state(base, work, n)
        work.listed[n] = source
        work.kind[n] = -1 if known.events[source, start] else 1
        m = n + 1
        for s in range(start, t):
            _arrive(chip, work, m)
            m = 0
            for block in range(len(chip.depth)):
                m = _step(chip, known, work, s, block, m)
        if source == 0:
            _copy_state(work, hull, 0)
        _lower(work.low_u, hull.low_u)
        _raise(work.high_u, hull.high_u)
        _lower(work.low_v, hull.low_v)
        _raise(work.high_v, hull.high_v)
        for k in range(m):
            if hull.kind[work.listed[k]] == 0:
                hull.kind[work.listed[k]] = -2 if work.kind[k] < 0 else 2
                hull.listed[count] = work.listed[k]
                count += 1
    _copy_state(hull, base, 0)
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


@compiled
def _change_any(known: Known, channels: Any, t: Any, n: Any, base: Any, work: Any) -> Any:
    """A run from bounds before a step in which any of its events may change."""
    _copy_state(base, work, n)
    for source in range(channels):
        work.listed[n + source] = source
        work.kind[n + source] = -2 if known.events[source, t] else 2
    return n + channels


@compiled_and_cached
def _bound(
    chip: Chip,
    known: Known,
    bounds: Safe,
    left: Any,
    channels: Any,
    decision: Any,
    lag: Any,
    base: Any,
    work: Any,
    lost: Any,
) -> None:
    for t in range(len(lost)):
        n = _past(chip, known, t, t, base, work)
        _watch(chip, known, bounds, t, base)
        n = _change_any(known, channels, t, n, base, work)
        _follow(chip, known, bounds, left, t, n, decision, lag, base, work, lost[t])


@compiled_and_cached
def _bound_after(
    chip: Chip,
    known: Known,
    bounds: Safe,
    left: Any,
    channels: Any,
    decision: Any,
    lag: Any,
    past: Any,
    t: Any,
    base: Any,
    hull: Any,
    work: Any,
    lost: Any,
) -> None:
    if past.single:
        n = _past(chip, known, t - past.steps, t - past.steps, base, work)
        n = _hull(chip, known, t - past.steps, t, channels, n, base, work, hull)
    else:
        n = _past(chip, known, t - past.steps + 1, t, base, work)
    _watch(chip, known, bounds, t, base)
    m = _change_any(known, channels, t, n, base, work)
    if not _follow(chip, known, bounds, left, t, m, decision, lag, base, work, lost[1]):
        copy(lost[1].ravel(), lost[0].ravel())  # one event alone can do no more than all
        return
    for source in range(channels):
        _copy_state(base, work, n)
        work.listed[n] = source
        work.kind[n] = -1 if known.events[source, t] else 1
        _follow(chip, known, bounds, left, t, n + 1, decision, lag, base, work, lost[0])
