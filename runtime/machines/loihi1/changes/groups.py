"""The chip's integers, as :mod:`machines.bounds` asks of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import charged, compiled, saturated
from spikeloom.compiler.targets.loihi1.registers import CURRENT_MAX, MEMBRANE_SHIFT
from spikeloom.runtime.machines.bounds import groups as search
from spikeloom.runtime.machines.bounds.arithmetic import (
    LANES,
    Safe,
    implements,
    step_block,
    surely,
    unknown,
    unsafe,
)
from spikeloom.runtime.machines.bounds.boxes import list_open, wipe
from spikeloom.runtime.machines.changes import Groups
from spikeloom.runtime.machines.loihi1.changes.chip import NEVER, Chip, Known
from spikeloom.runtime.machines.loihi1.changes.kernel import integrate
from spikeloom.runtime.machines.loihi1.changes.safe import safe
from spikeloom.runtime.machines.loihi1.changes.safe import unsafe as unsafe_membranes


def groups(chip: Chip, known: Known, shape: tuple[int, int, int], decision: int, reach: int) -> Groups:
    """Bound what groups of events turn; `shape` are channels and steps in which events may change, and classes."""
    return search.groups(chip, known, safe(chip, known), shape, decision, reach)


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
def _both(total: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        total[first + i] += np.int32(sign * weight[begin + i])


@implements(surely, Chip)
def _surely(chip: Chip, work: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    _both(work.low, chip.synapses.weight, sign, first, begin, length)
    _both(work.high, chip.synapses.weight, sign, first, begin, length)


@implements(step_block, Chip)
def _step_integers(chip: Chip, known: Known, work: Any, t: Any, block: Any, n: Any) -> Any:
    first = np.uint64(block * LANES)
    length = known.events.shape[1]
    if not chip.depth[block] <= t < chip.depth[block] + length:
        wipe(work.low_u, first)
        wipe(work.high_u, first)
        wipe(work.low_v, first)
        wipe(work.high_v, first)
    else:
        _charge(work.low_u, chip.keep_u, known.sums[t], work.low, first)
        _charge(work.high_u, chip.keep_u, known.sums[t], work.high, first)
        integrate(work.low_v, chip.keep_v, work.low_u, chip.bias, first, np.uint64(LANES))
        integrate(work.high_v, chip.keep_v, work.high_u, chip.bias, first, np.uint64(LANES))
        if _code(work.codes, work.low_v, work.high_v, chip.threshold, known.fired[t], first):
            n = list_open(known, work, t, block, n)
        _reset_low(work.low_v, work.codes, first)
        _reset_high(work.high_v, work.codes, chip.threshold, first)
    wipe(work.low, first)
    wipe(work.high, first)
    return n


@implements(unsafe, Chip)
def _unsafe(chip: Chip, known: Known, bounds: Safe, box: Any, t: Any, block: Any) -> Any:
    return unsafe_membranes(chip, known, bounds, box, t, block)


@implements(unknown, Chip)
def _unknown(chip: Chip, known: Known, start: Any, work: Any) -> Any:
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
