"""The dynamic program of :mod:`proofs.bounds`, compiled with numba."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached

NEVER = -(1 << 40)
"""Votes of what cannot be."""


@compiled
def _leave(enter: Any, late: Any, worst: Any, lost: Any, level: Any, t: Any, n: Any, before: Any) -> None:
    """Let a group have been at a step, which makes `n` events in all: votes until the next one, wherever it is."""
    steps = len(enter)
    reach = len(lost)
    for r in range(1, reach):
        if t + r < steps:
            enter[t + r, level[r], n] = max(enter[t + r, level[r], n], before + lost[r - 1])
    if t + reach < steps:
        late[t + reach, n] = max(late[t + reach, n], before + lost[reach - 1])
    worst[n] = max(worst[n], before + lost[reach - 1])


@compiled_and_cached
def most_lost(lost: Any, apart: Any, most: int) -> Any:
    """Most votes that so many changed events turn against a decision, (most + 1,).

    `lost` (spacings, 2, steps, reach) are those of one class, see :class:`machines.changes.Groups`. `enter` holds
    them where a group is at a step, its own not counted yet, by how far the one before it is away; `late`
    those of which the one before is as far away as any spacing.
    """
    levels, _, steps, reach = lost.shape
    enter = np.full((steps, levels, most + 1), NEVER)
    late = np.full((steps, most + 1), NEVER)
    worst = np.zeros(most + 1, np.int64)
    level = np.searchsorted(apart, np.arange(reach), side="right") - 1
    for t in range(steps):
        late[t, 0] = 0
        for n in range(most + 1):
            late[t, n] = max(late[t, n], late[max(t - 1, 0), n])
            enter[t, levels - 1, n] = max(enter[t, levels - 1, n], late[t, n])
        for k in range(levels):
            for events in range(1, 3):
                for n in range(most + 1 - events):
                    if enter[t, k, n] > NEVER // 2:
                        ours = lost[k, events - 1, t]
                        _leave(enter, late, worst, ours, level, t, n + events, enter[t, k, n])
    for n in range(1, most + 1):
        worst[n] = max(worst[n], worst[n - 1])
    return worst
