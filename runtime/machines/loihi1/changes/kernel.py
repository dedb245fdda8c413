"""Runs that differ from a known one by a few events: only what a change reaches is simulated, with numba.

The known run is kept: the registers before each step and the sums within it. Of a changed run only *blocks*
of 64 compartments are held in which some register differs, and a step looks at these and at those that a
changed event or spike reaches. Where none is left the rest of the run is the known one. All of it is exact,
in the integers of :mod:`loihi1.spec`; no register may overflow, whatever the input.
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
    decayed,
    integrated,
    list_fired,
    require_below,
    saturated,
)
from spikeloom.compiler.targets.loihi1.registers import MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.bounds.arithmetic import LANES, Safe
from spikeloom.runtime.machines.changes import Changes, Effects
from spikeloom.runtime.machines.loihi1.changes.chip import Chip, Known
from spikeloom.runtime.machines.loihi1.changes.safe import safe, unsafe


class _Run(NamedTuple):
    """A run that goes on."""

    # delta, current, membrane: (places,) int32; what sums have more than the known ones, all zero between
    # two steps; registers, valid in blocks that are held
    delta: AnyArray
    current: AnyArray
    membrane: AnyArray
    other: AnyArray  # (places,) uint8; whose spikes differ
    # held, looked: (blocks,) uint8; whose registers differ, and what a step looks at
    held: AnyArray
    looked: AnyArray
    # moved, sign: int64; sources whose events differ, and whether these come (1) or go (-1)
    moved: IntArray
    sign: IntArray


def known_run(chip: Chip, events: AnyArray) -> Known:
    """Run a recording (channels, T) and keep what changed runs need."""
    places = len(chip.bias)
    steps = events.shape[1] + int(chip.depth.max())
    require_below("channels", np.array(len(events)), len(chip.synapses.run) - places)
    registers = np.zeros((2, steps + 1, places), np.int32)
    sums = np.zeros((steps, places), np.int32)
    fired = np.zeros((steps, places), np.uint8)
    known = Known(np.ascontiguousarray(events).view(np.uint8), sums, registers[0], registers[1], fired)
    _record(chip, known, _run_of(chip, known))
    return known


def effects(chip: Chip, known: Known, classes: int, changes: Changes) -> Effects:
    """What changes of the known recording bring about."""
    count = len(changes.bounds) - 1
    come, gone = np.zeros((2, count, classes), np.int64)
    made = Effects(come, gone, np.zeros(count, np.int64))
    channel, step = np.ascontiguousarray(changes.cells.T, np.int64)
    require_below("channel", channel, known.events.shape[0])
    require_below("step", step, known.events.shape[1])
    _run(chip, known, safe(chip, known), _run_of(chip, known), channel, step, changes.bounds, *made)
    return made


def _run_of(chip: Chip, known: Known) -> _Run:
    places = len(chip.bias)
    blocks = len(chip.depth)
    delta, current, membrane = np.zeros((3, places), np.int32)
    differing, looked = np.zeros((2, blocks), np.uint8)
    moved, sign = np.ones((2, places + len(known.events) + 1), np.int64)
    return _Run(delta, current, membrane, np.zeros(places, np.uint8), differing, looked, moved, sign)


# Each loop is a function of its own that writes one array: only so does the compiler vectorise it.


@compiled
def _charge(current: Any, keep: Any, sums: Any, delta: Any, first: Any, places: Any) -> None:
    for i in range(first, first + places):
        arrived = np.int32(np.int32(sums[i] + delta[i]) << np.int32(MEMBRANE_SHIFT))
        current[i] = charged(current[i], keep[i], arrived)


@compiled
def integrate(membrane: Any, keep: Any, current: Any, bias: Any, first: Any, places: Any) -> None:
    """Let membranes of some places decay and take in currents and biases."""
    for i in range(first, first + places):
        v = integrated(decayed(membrane[i], keep[i]), current[i], bias[i])
        membrane[i] = saturated(v, np.int32(MEMBRANE_MAX))


@compiled
def _compare(other: Any, membrane: Any, threshold: Any, fired: Any, first: Any, places: Any) -> Any:
    different = np.uint8(0)
    for i in range(first, first + places):
        differs = np.uint8(np.uint8(membrane[i] > threshold[i]) ^ fired[i])
        other[i] = differs
        different |= differs
    return different


@compiled
def _reset(membrane: Any, threshold: Any, first: Any, places: Any) -> None:
    for i in range(first, first + places):
        membrane[i] = np.int32(0) if membrane[i] > threshold[i] else membrane[i]


@compiled
def _differ(ours: Any, theirs: Any, first: Any, places: Any) -> Any:
    different = np.int32(0)
    for i in range(first, first + places):
        different |= ours[i] ^ theirs[i]
    return different


@compiled
def _add(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += sign * weight[begin + i]


@compiled
def _arrive(chip: Chip, run: Any, moved: Any) -> None:
    """Let changed sources arrive; marks the blocks that they reach."""
    begins, target, offset, weight = chip.synapses
    for k in range(moved):
        source = run.moved[k]
        sign = np.int32(run.sign[k])
        for r in range(begins[source], begins[source + 1]):
            first = target[r]
            begin = offset[r]
            length = offset[r + 1] - offset[r]
            _add(run.delta, weight, sign, np.uint64(first), np.uint64(begin), np.uint64(length))
            for block in range(first // LANES, (first + length - 1) // LANES + 1):
                run.looked[block] = 1


@compiled
def _step(chip: Chip, run: Any, sums: Any, first: Any, places: Any) -> None:
    """Charge and integrate some places; the sums of `run` are used up."""
    _charge(run.current, chip.keep_u, sums, run.delta, first, places)
    clear(run.delta[first : first + places])
    integrate(run.membrane, chip.keep_v, run.current, chip.bias, first, places)


@compiled_and_cached
def _record(chip: Chip, known: Known, run: Any) -> None:
    channels, length = known.events.shape
    for t in range(len(known.sums)):
        events = list_fired(known.events[:, t], run.moved) if t < length else 0
        fired = list_fired(known.fired[t - 1], run.moved[events:]) if t else 0
        run.moved[events : events + fired] += channels
        _arrive(chip, run, events + fired)
        copy(run.delta, known.sums[t])
        clear(run.delta)
        for block in range(len(chip.depth)):
            first = np.uint64(block * LANES)
            places = np.uint64(LANES)
            if chip.depth[block] <= t < chip.depth[block] + length:
                _step(chip, run, known.sums[t], first, places)
                _compare(run.other, run.membrane, chip.threshold, known.fired[t], first, places)
                copy(run.other[first : first + places], known.fired[t, first : first + places])
                _reset(run.membrane, chip.threshold, first, places)
        copy(run.current, known.current[t + 1])
        copy(run.membrane, known.membrane[t + 1])


@compiled
def _span(chip: Chip, known: Known, run: Any, t: Any, begin: Any) -> Any:
    """End of the neighbouring blocks from `begin` on that are looked at together; their registers are held."""
    block = begin
    while block < len(chip.depth) and run.looked[block] and chip.depth[block] == chip.depth[begin]:
        if not run.held[block]:
            first = block * LANES
            copy(known.current[t, first : first + LANES], run.current[first : first + LANES])
            copy(known.membrane[t, first : first + LANES], run.membrane[first : first + LANES])
        block += 1
    return block


@compiled
def _part(
    chip: Chip, known: Known, run: Any, t: Any, moved: Any, span: Any, come: Any, gone: Any
) -> tuple[Any, Any]:
    """One step of some blocks; how many sources now differ, and whether a register does."""
    begin, end = span
    first = np.uint64(begin * LANES)
    places = np.uint64((end - begin) * LANES)
    channels, length = known.events.shape
    if not chip.depth[begin] <= t < chip.depth[begin] + length:
        clear(run.delta[first : first + places])
        clear(run.held[begin:end])
        return moved, False
    _step(chip, run, known.sums[t], first, places)
    if _compare(run.other, run.membrane, chip.threshold, known.fired[t], first, places):
        for c in range(begin * LANES, end * LANES):
            if run.other[c]:  # its spike differs, and votes
                run.moved[moved] = channels + c
                run.sign[moved] = 1 - 2 * np.int64(known.fired[t, c])
                moved += 1
                if chip.label[c] >= 0:
                    (gone if known.fired[t, c] else come)[chip.label[c]] += 1
    _reset(run.membrane, chip.threshold, first, places)
    any_held = False
    for block in range(begin, end):
        at = np.uint64(block * LANES)
        places = np.uint64(LANES)
        differs = _differ(run.membrane, known.membrane[t + 1], at, places)
        run.held[block] = (differs | _differ(run.current, known.current[t + 1], at, places)) != 0
        any_held |= run.held[block] != 0
    return moved, any_held


@compiled
def _settle(chip: Chip, known: Known, bounds: Safe, run: Any, t: Any, moved: Any) -> Any:
    """Let go of blocks that spike as in the known run from step `t` on; whether any is left."""
    registers = run.current, run.current, run.membrane, run.membrane
    unsafe_ones = run.looked
    first = len(chip.depth)  # layer from which a spike still may differ: later ones must wait
    if moved:
        first = chip.layer[(run.moved[0] - len(known.events)) // LANES]
    for block in range(len(chip.depth)):
        waits = chip.layer[block] > first
        unsafe_ones[block] = run.held[block] and (waits or unsafe(chip, known, bounds, registers, t, block))
        if unsafe_ones[block]:
            first = min(first, chip.layer[block])
    if not chip.ordered and first < len(chip.depth):
        return True
    any_held = False
    for block in range(len(chip.depth)):
        run.held[block] = unsafe_ones[block]
        any_held |= run.held[block] != 0
    return any_held


@compiled_and_cached
def _run(
    chip: Chip,
    known: Known,
    bounds_: Safe,
    run: Any,
    channel: Any,
    step: Any,
    bounds: Any,
    come: Any,
    gone: Any,
    end: Any,
) -> None:
    steps = len(known.sums)
    blocks = len(chip.depth)
    looked = run.looked
    for k in range(len(end)):
        flip = bounds[k]
        last = bounds[k + 1]
        moved = 0
        any_held = False
        t = np.int64(0)
        clear(run.held)
        while True:
            if any_held and flip == last:
                any_held = _settle(chip, known, bounds_, run, t, moved)
            if moved == 0 and not any_held:
                end[k] = t
                if flip == last:
                    break
                t = step[flip]
            if t >= steps:
                end[k] = steps
                break
            while flip < last and step[flip] == t:
                run.moved[moved] = channel[flip]
                run.sign[moved] = 1 - 2 * np.int64(known.events[channel[flip], t])
                moved += 1
                flip += 1
            copy(run.held, run.looked)
            _arrive(chip, run, moved)
            moved = 0
            any_held = False
            block = 0
            while block < blocks:
                after = block + 1
                if looked[block]:
                    after = _span(chip, known, run, t, block)
                    moved, differs = _part(chip, known, run, t, moved, (block, after), come[k], gone[k])
                    any_held |= differs
                block = after
            t += 1
