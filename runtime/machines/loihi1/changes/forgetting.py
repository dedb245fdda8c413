"""How soon a run is the known one again, whatever its registers were: interval arithmetic on the chip's integers.

At some step nothing is known but what no register exceeds. From then on the events are those of the known
recording. Each place has a least and a largest membrane and current; a spike is sure, impossible or open;
open spikes widen the sums that they reach. Decay is monotone, so that bounds stay bounds. Where all of them
meet, the run is the known one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import (
    charged,
    clear,
    compiled,
    compiled_and_cached,
    decayed,
    integrated,
    saturated,
)
from spikeloom.compiler.targets.loihi1.registers import CURRENT_MAX, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.runtime.machines.changes import Forgetting
from spikeloom.runtime.machines.loihi1.changes.kernel import LANES, NEVER, Chip, Known


def forgetting(chip: Chip, known: Known, classes: int) -> Forgetting:
    """Bound the runs that are unknown before each step."""
    steps, places = known.fired.shape
    ends = np.full((2, steps + 1), steps)
    moved = np.zeros((2, steps + 1, steps, classes), np.int16)
    _forget(chip, known, *np.zeros((6, places), np.int32), np.zeros(places + 1, np.int64), *ends, *moved)
    return Forgetting(_lag(chip, known), *ends, *moved)


def _lag(chip: Chip, known: Known) -> int:
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


@compiled
def _widen(low: Any, high: Any, weight: Any, sign: Any, first: Any, begin: Any, length: Any) -> None:
    for i in range(length):
        low[first + i] += min(np.int32(sign * weight[begin + i]), np.int32(0))
    for i in range(length):
        high[first + i] += max(np.int32(sign * weight[begin + i]), np.int32(0))


@compiled
def _after(chip: Chip, c: Any, total: Any, current: Any, membrane: Any) -> Any:
    """Current and membrane at one end of what is possible; in 64 bits, since not both ends have to be."""
    u = charged(np.int64(current), chip.keep_u[c], np.int64(total) << MEMBRANE_SHIFT)
    u = saturated(u, np.int64(CURRENT_MAX))  # no run has more, whatever its input
    v = integrated(decayed(np.int64(membrane), chip.keep_v[c]), u, chip.bias[c])
    return np.int32(u), np.int32(saturated(v, np.int64(MEMBRANE_MAX)))


@compiled
def _unknown(chip: Chip, start: Any, length: Any, bounds: Any, listed: Any) -> Any:
    """Bounds of registers before a step; lists those that may have fired in the step before."""
    low_u, high_u, low_v, high_v = bounds
    n = 0
    most = np.int32(CURRENT_MAX)
    for c in range(len(chip.bias)):
        depth = chip.depth[c // LANES]
        inside = chip.threshold[c] != NEVER and depth < start <= depth + length  # else all are zero
        lasts = inside and chip.keep_u[c] != 0
        low_u[c], high_u[c] = (-most, most) if lasts else (np.int32(0), np.int32(0))
        low_v[c] = chip.lowest[c] if inside else np.int32(0)
        high_v[c] = max(chip.threshold[c], np.int32(0)) if inside else np.int32(0)
        listed[n] = c
        n += inside
    return n


@compiled
def _narrow(chip: Chip, known: Known, t: Any, c: Any, bounds: Any, sums: Any) -> Any:
    """Let a compartment integrate between its bounds; says whether its spike is open."""
    low_u, high_u, low_v, high_v = bounds
    total = known.sums[t, c]
    threshold = chip.threshold[c]
    low_u[c], v = _after(chip, c, total + sums[0][c], low_u[c], low_v[c])
    high_u[c], top = _after(chip, c, total + sums[1][c], high_u[c], high_v[c])
    is_open = v <= threshold < top
    fires = v > threshold
    low_v[c] = np.int32(0) if fires else (min(v, np.int32(0)) if is_open else v)
    high_v[c] = np.int32(0) if fires else (max(threshold, np.int32(0)) if is_open else top)
    return is_open


@compiled_and_cached
def _forget(
    chip: Chip,
    known: Known,
    low_u: Any,
    high_u: Any,
    low_v: Any,
    high_v: Any,
    low: Any,
    high: Any,
    listed: Any,
    quiet: Any,
    back: Any,
    gone: Any,
    come: Any,
) -> None:
    channels, length = known.events.shape
    begins, target, offset, weight = chip.synapses
    steps, places = known.fired.shape
    bounds = (low_u, high_u, low_v, high_v)
    sums = (low, high)
    for start in range(steps - 1, -1, -1):
        n = _unknown(chip, start, length, bounds, listed)
        last = start  # after the last step with an open spike
        # a run that starts later has no open spikes here, so this one has none
        for t in range(start, steps if quiet[start + 1] == steps else quiet[start + 1] + 1):
            clear(low)
            clear(high)
            for k in range(n):
                c = listed[k]
                sign = np.int32(-1) if t and known.fired[t - 1, c] else np.int32(1)
                for r in range(begins[channels + c], begins[channels + c + 1]):
                    size = np.uint64(offset[r + 1] - offset[r])
                    _widen(low, high, weight, sign, np.uint64(target[r]), np.uint64(offset[r]), size)
            n = 0
            apart = False
            for c in range(places):
                depth = chip.depth[c // LANES]
                if not depth <= t < depth + length:
                    low_u[c] = high_u[c] = low_v[c] = high_v[c] = 0
                elif _narrow(chip, known, t, c, bounds, sums):
                    listed[n] = c
                    n += 1
                    if chip.label[c] >= 0:
                        (gone if known.fired[t, c] else come)[start, t, chip.label[c]] += 1
                apart |= low_v[c] != high_v[c] or low_u[c] != high_u[c]
            if n:
                last = t + 1
            elif not apart:
                back[start] = t + 1
                break
        quiet[start] = last
        back[start] = min(back[start], back[start + 1])
