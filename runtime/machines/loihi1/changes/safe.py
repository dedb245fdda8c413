"""Registers from which a run spikes as the known one to its end, if the input is the known one.

Membranes are monotone in what they were between two resets, so such membranes are an interval for each
compartment and step. It is found backwards: one that spikes is safe, what follows is a reset; another must
stay silent, and be safe in the next step. A current that lasts must be the known one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spikeloom.compiler.layer_kernel import compiled
from spikeloom.compiler.targets.loihi1.registers import DECAY_ONE, MEMBRANE_MAX
from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.loihi1.changes.chip import LANES, Chip, Known

FAR = 1 << 30
"""Beyond every membrane."""


class Safe(NamedTuple):
    """Membranes before each step, (steps + 1, places) int32, from which every later spike is the known one."""

    low: AnyArray
    high: AnyArray


def safe(chip: Chip, known: Known) -> Safe:
    """Safe membranes of a known run."""
    steps, places = known.fired.shape
    bounds = Safe(*np.zeros((2, steps + 1, places), np.int32))
    length = known.events.shape[1]
    low, high = np.full(places, -FAR, np.int64), np.full(places, FAR, np.int64)
    depth = np.repeat(chip.depth, LANES)
    keep = chip.keep_v.astype(np.int64)
    bounds.low[steps], bounds.high[steps] = low, high
    for t in range(steps - 1, -1, -1):
        fired = known.fired[t] != 0
        arrived = known.current[t + 1].astype(np.int64) + chip.bias
        least = np.where(fired, chip.threshold.astype(np.int64) + 1, low)
        most = np.where(fired, FAR, np.minimum(chip.threshold, high))
        low = np.where(least <= -MEMBRANE_MAX, -FAR, -_reached(arrived - least, keep))
        high = np.where(most >= MEMBRANE_MAX, FAR, _reached(most - arrived, keep))
        inside = (depth <= t) & (t < depth + length)
        low, high = np.where(inside, low, -FAR), np.where(inside, high, FAR)
        bounds.low[t], bounds.high[t] = low, high
    return bounds


def _reached(most: IntArray, keep: IntArray) -> IntArray:
    """Largest membrane of which no more than `most` is kept, within FAR."""
    keeps = np.maximum(keep, 1)
    above = ((most + 1) * DECAY_ONE - 1) // keeps  # of what is not negative
    below = -((-most * DECAY_ONE + keeps - 1) // keeps)  # of what is: its magnitude is at least so much
    nothing = np.where(most >= 0, FAR, -FAR)
    return np.clip(np.where(keep == 0, nothing, np.where(most >= 0, above, below)), -FAR, FAR)


@compiled
def _outside(low: Any, high: Any, least: Any, most: Any, first: Any) -> Any:
    outside = np.uint8(0)
    for i in range(first, first + np.uint64(LANES)):
        outside |= np.uint8(np.uint8(low[i] < least[i]) | np.uint8(high[i] > most[i]))
    return outside


@compiled
def _other(low: Any, high: Any, keep: Any, known: Any, first: Any) -> Any:
    other = np.uint8(0)
    for i in range(first, first + np.uint64(LANES)):
        apart = np.uint8(np.uint8(low[i] != known[i]) | np.uint8(high[i] != known[i]))
        other |= np.uint8(np.uint8(keep[i] != np.int32(0)) & apart)
    return other


@compiled
def unsafe(chip: Chip, known: Known, bounds: Safe, box: Any, t: Any, block: Any) -> Any:
    """Whether a block may spike otherwise than the known run from step `t` on.

    `box` are the least and largest current and membrane of each place before that step.
    """
    low_u, high_u, low_v, high_v = box
    first = np.uint64(block * LANES)
    outside = _outside(low_v, high_v, bounds.low[t], bounds.high[t], first)
    return outside != 0 or _other(low_u, high_u, chip.keep_u, known.current[t], first) != 0
