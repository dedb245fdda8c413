"""Registers from which a run spikes as the known one to its end, if the input is the known one.

Membranes are monotone in what they were between two resets, so such membranes are an interval for each
compartment and step. It is found backwards: one that spikes is safe, what follows is a reset; another must
stay silent, and be safe in the next step. A current that lasts must be the known one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached
from spikeloom.compiler.targets.loihi1.registers import DECAY_ONE, MEMBRANE_MAX
from spikeloom.runtime.machines.bounds.arithmetic import FAR, LANES, Safe
from spikeloom.runtime.machines.loihi1.changes.chip import Chip, Known


def safe(chip: Chip, known: Known) -> Safe:
    """Safe membranes of a known run."""
    steps, places = known.fired.shape
    bounds = Safe(*np.zeros((2, steps + 1, places), np.int32))
    bounds.low[steps], bounds.high[steps] = -FAR, FAR
    _backwards(chip, known, bounds)
    return bounds


@compiled_and_cached
def _backwards(chip: Chip, known: Known, bounds: Safe) -> None:
    length = known.events.shape[1]
    for t in range(len(known.fired) - 1, -1, -1):
        for i in range(len(chip.bias)):
            depth = chip.depth[i // LANES]
            fired = known.fired[t, i] != 0
            least = chip.threshold[i] + 1 if fired else bounds.low[t + 1, i]
            most = FAR if fired else min(chip.threshold[i], bounds.high[t + 1, i])
            arrived = np.int64(known.current[t + 1, i]) + chip.bias[i]
            inside = depth <= t < depth + length
            ends_below = inside and least > -MEMBRANE_MAX
            ends_above = inside and most < MEMBRANE_MAX
            bounds.low[t, i] = -_reached(arrived - least, chip.keep_v[i]) if ends_below else -FAR
            bounds.high[t, i] = _reached(most - arrived, chip.keep_v[i]) if ends_above else FAR


@compiled
def _reached(most: Any, keep: Any) -> Any:
    """Largest membrane of which no more than `most` is kept, within FAR."""
    product = most * DECAY_ONE + (DECAY_ONE - 1 if most >= 0 else 0)  # decay rounds toward zero
    if keep == 0:
        return FAR if product > 0 else -FAR
    return min(max(product // keep, -FAR), FAR)


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
