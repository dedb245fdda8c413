"""How many votes a group of changed events turns at most, by the bounds of :mod:`bounds.boxes`."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import clear, compiled, compiled_and_cached, copy, require_below
from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.bounds.arithmetic import FAR, LANES, KnownRun, Layout, step_block, unsafe
from spikeloom.runtime.machines.bounds.boxes import (
    Base,
    Work,
    any_of,
    arrive,
    box_of,
    copy_state,
    hull_of,
    past_of,
    watch,
)
from spikeloom.runtime.machines.changes import Groups, Past

HORIZON = 512
"""Steps after a group for which its run is followed; of the rest every vote counts as turned."""


def groups(
    chip: Layout, known: KnownRun, bounds: Any, shape: tuple[int, int, int], decision: int, reach: int
) -> Groups:
    """Bound what groups of events turn; `bounds` are what :func:`arithmetic.unsafe` takes.

    `shape` are channels and steps in which events may change, and classes.
    """
    channels, steps, classes = shape
    places = len(chip.bias)
    sources = places + 2 * len(known.events)
    blocks = np.zeros((3, len(chip.depth)), np.uint8)
    registers = np.zeros((14, places), chip.bias.dtype)
    lists = np.zeros((6, sources), np.int64)
    codes = np.zeros(places, np.uint8)
    base = Base._make([*registers[:4], *lists[:2], blocks[0]])
    hull = Base._make([*registers[4:8], *lists[2:4], blocks[1]])
    arrived = np.zeros(2, np.int64)
    work = Work._make([*registers[8:], *lists[4:], codes, arrived, blocks[2], np.zeros(classes, np.int64)])
    lag = lag_of(chip, known)
    left = _left(chip, known, classes)
    lost = np.full((steps, reach, classes), -FAR, np.int32)
    _bound(chip, known, bounds, left, channels, decision, lag, base, work, lost)

    def after(past: Past, step: int) -> AnyArray:
        require_below("step", np.array([step, step - past.steps * past.single]), steps)
        most = np.full((2, reach, classes), -FAR, np.int32)
        _bound_after(chip, known, bounds, left, channels, decision, lag, past, step, base, hull, work, most)
        return most

    return Groups(lag, lost, after)


def lag_of(chip: Any, known: Any) -> int:
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


def _left(chip: Any, known: Any, classes: int) -> IntArray:
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


@compiled
def _count(chip: Any, known: Any, t: Any, decision: Any, work: Any, n: Any) -> Any:
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
def _advance(chip: Any, known: Any, bounds: Any, work: Any, t: Any) -> Any:
    """One step of all blocks that are simulated; which of them need not be any more; how many spikes differ, or may."""
    n = 0
    clear_above = True  # nothing comes from layers before that is not known
    layer_clear = True
    for block in range(len(chip.depth)):
        if block and chip.layer[block] != chip.layer[block - 1]:
            clear_above = layer_clear and n == 0
            layer_clear = clear_above
        if work.live[block]:
            n = step_block(chip, known, work, t, block, n)
            if (clear_above and chip.ordered) and not unsafe(
                chip, known, bounds, box_of(work), t + 1, block
            ):
                work.live[block] = 0
            else:
                layer_clear = False
    return n


@compiled
def _over(chip: Any, known: Any, bounds: Any, work: Any, t: Any) -> Any:
    """Whether every block is safe."""
    for block in range(len(chip.depth)):
        if work.live[block] and (chip.ordered or unsafe(chip, known, bounds, box_of(work), t, block)):
            return False
    return True


@compiled
def _follow(
    chip: Any,
    known: Any,
    bounds: Any,
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
    steps = len(known.fired)
    reach = len(lost)
    gone = 0
    clear(work.turned)
    clear(work.low)
    clear(work.high)
    arrive(chip, work, n)
    for block in range(len(chip.depth)):
        first = np.uint64(block * LANES)
        reached = any_of(work.low, first) or any_of(work.high, first)
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
        arrive(chip, work, n)
    if not over and t < steps:
        gone += left[0, t, decision]
        for label in range(len(work.turned)):
            work.turned[label] += left[1, t, label]
    _note(lost, work.turned, gone, r - 1, reach)
    return over or t == steps


@compiled
def _change_any(known: Any, channels: Any, t: Any, n: Any, base: Any, work: Any) -> Any:
    """A run from bounds before a step in which any of its events may change."""
    copy_state(base, work, n)
    for source in range(channels):
        work.listed[n + source] = source
        work.kind[n + source] = -2 if known.events[source, t] else 2
    return n + channels


@compiled_and_cached
def _bound(
    chip: Any,
    known: Any,
    bounds: Any,
    left: Any,
    channels: Any,
    decision: Any,
    lag: Any,
    base: Any,
    work: Any,
    lost: Any,
) -> None:
    for t in range(len(lost)):
        n = past_of(chip, known, t, t, base, work)
        watch(chip, known, bounds, t, base)
        n = _change_any(known, channels, t, n, base, work)
        _follow(chip, known, bounds, left, t, n, decision, lag, base, work, lost[t])


@compiled_and_cached
def _bound_after(
    chip: Any,
    known: Any,
    bounds: Any,
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
        n = past_of(chip, known, t - past.steps, t - past.steps, base, work)
        n = hull_of(chip, known, t - past.steps, t, channels, n, base, work, hull)
    else:
        n = past_of(chip, known, t - past.steps + 1, t, base, work)
    watch(chip, known, bounds, t, base)
    m = _change_any(known, channels, t, n, base, work)
    if not _follow(chip, known, bounds, left, t, m, decision, lag, base, work, lost[1]):
        copy(lost[1].ravel(), lost[0].ravel())  # one event alone can do no more than all
        return
    for source in range(channels):
        copy_state(base, work, n)
        work.listed[n] = source
        work.kind[n] = -1 if known.events[source, t] else 1
        _follow(chip, known, bounds, left, t, n + 1, decision, lag, base, work, lost[0])
