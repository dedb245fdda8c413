"""The dynamic program of :mod:`proofs.bounds`, compiled with numba."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached

NEVER = -(1 << 40)
"""Votes of what cannot be."""


@compiled
def _leave(
    enter: Any, came: Any, late: Any, ours: Any, follows: Any, votes: Any, entry: Any, t: Any, n: Any
) -> None:
    """Let a group have been at a step, which makes `n` events in all: votes until the next one, wherever it is.

    `entry` says by which way the group was entered.
    """
    steps = len(enter)
    reach = len(ours)
    for r in range(1, reach):
        if t + r < steps and votes + ours[r - 1] > enter[t + r, follows[r], n]:
            enter[t + r, follows[r], n] = votes + ours[r - 1]
            came[t + r, follows[r], n] = entry
    after = min(t + reach, steps)
    if votes + ours[reach - 1] > late[after, n, 0]:
        late[after, n, 0] = votes + ours[reach - 1]
        late[after, n, 1] = entry


@compiled
def _chain(came: Any, late: Any, steps: Any, n: Any) -> Any:
    """The worst chain of `n` events, last group first."""
    chain = np.zeros((n, 2), np.int64)
    entry = late[steps, n, 1]
    count = 0
    while entry >= 0:
        events = entry % 2 + 1
        past = entry // 2 % came.shape[1]
        t = entry // 2 // came.shape[1]
        chain[count, 0] = past
        chain[count, 1] = t
        count += 1
        n -= events
        entry = came[t, past, n]
    return chain[:count]


@compiled_and_cached
def fewest(lost: Any, follows: Any, last: int, most: int, gap: int) -> Any:
    """Fewest events, up to `most`, that may turn so many votes, and how, (groups, 2); else most + 1 and none.

    `lost` (pasts, 2, steps, reach) are the votes of one class, see :class:`machines.changes.Groups`, `follows` (2,
    reach) what is known of a group by the events of the one before it and its distance, `last` if that is farther.
    A group is of one event, or of any number, which counts as two. A chain is what is known of the past of each group,
    and its step. Groups are numbered 2 * (step * pasts + past) + events - 1. `enter` holds the most votes turned where
    a group is at a step, its own not counted yet; `came` the number of the group before it, -1 for none; `late` both
    where that is as far away as any.
    """
    pasts, _, steps, _ = lost.shape
    enter = np.full((steps, pasts, most + 1), NEVER)
    came = np.full((steps, pasts, most + 1), -1)
    late = np.full((steps + 1, most + 1, 2), NEVER)
    late[0, 0, 0] = 0
    late[0, 0, 1] = -1
    for t in range(steps + 1):
        for n in range(most + 1):
            if t > 0 and late[t - 1, n, 0] >= late[t, n, 0]:
                late[t, n] = late[t - 1, n]
            if t < steps and late[t, n, 0] > enter[t, last, n]:
                enter[t, last, n] = late[t, n, 0]
                came[t, last, n] = late[t, n, 1]
        for past in range(pasts if t < steps else 0):
            for events in range(1, 3):
                for n in range(most + 1 - events):
                    votes = enter[t, past, n]
                    entry = 2 * (t * pasts + past) + events - 1
                    if votes > NEVER // 2:
                        ours = lost[past, events - 1, t]
                        _leave(enter, came, late, ours, follows[events - 1], votes, entry, t, n + events)
    for n in range(1, most + 1):
        if late[steps, n, 0] >= gap:
            return n, _chain(came, late, steps, n)
    return most + 1, np.zeros((0, 2), np.int64)
