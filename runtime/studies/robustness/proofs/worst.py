"""The dynamic program of :mod:`proofs.bounds`, compiled with numba."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached

NEVER = -(1 << 40)
"""Votes of what cannot be."""


@compiled
def _begin(cluster: Any, exact: Any, begun: Any, t: int, last: int) -> None:
    """Begin clusters at a step: the second event changes before the effects of the first have ended.

    `begun` (steps + 1,) are the most votes that first events turn, by where they end, at `last` at the
    latest.
    """
    worst = NEVER
    for second in range(last - 1, t - 1, -1):
        worst = max(worst, begun[second + 1])
        begun[second + 1] = NEVER
        for n in range(exact.shape[1] - 2):
            cluster[second, n + 2] = max(cluster[second, n + 2], exact[t, n] + worst)


@compiled
def _go_on(cluster: Any, opened: Any, quiet: Any, t: int, lag: int) -> int:
    """Let a further event change before clusters whose last one changed at `t` are over; votes that they turn."""
    steps = len(opened)
    most = cluster.shape[1] - 1
    lost = 0
    for later in range(t + 1, steps):
        if later < quiet:
            lost += opened[later - 1 + lag] if later - 1 + lag < steps else 0
            for n in range(most):
                cluster[later, n + 1] = max(cluster[later, n + 1], cluster[t, n] + lost)
    lost = 0
    for s in range(min(t + lag, steps), steps):
        lost += opened[s]
    return lost


@compiled_and_cached
def most_lost(
    first: Any,
    end: Any,
    cost: Any,
    alone: Any,
    partly: Any,
    quiet: Any,
    back: Any,
    opened: Any,
    lag: int,
    most: int,
) -> Any:
    """Most votes that so many changed events can turn against a decision, (most + 1,).

    `exact` holds them by step where the chip is in the known state, `still` where only its spikes are
    known, `cluster` where the last event changed in that step and what it can alter is not counted yet.
    """
    steps = len(back) - 1
    exact, still, cluster = np.full((3, steps + 1, most + 1), NEVER)
    begun = np.full(steps + 1, NEVER)
    exact[0, 0] = 0
    for t in range(steps):
        last = t
        for e in range(first[t], first[t + 1]):
            begun[end[e]] = max(begun[end[e]], partly[e])
            last = max(last, end[e])
            for n in range(most + 1 - cost[e]):
                exact[end[e], n + cost[e]] = max(exact[end[e], n + cost[e]], exact[t, n] + alone[e])
        _begin(cluster, exact, begun, t, last)
        for n in range(most):
            cluster[t, n + 1] = max(cluster[t, n + 1], still[t, n])
        for n in range(most):  # further ones in the same step
            cluster[t, n + 1] = max(cluster[t, n + 1], cluster[t, n])
        lost = _go_on(cluster, opened[t + 1], quiet[t + 1], t, lag)
        at_rest = max(quiet[t + 1], t + 1)
        as_known = max(back[t + 1], t + 1)
        for n in range(most + 1):
            still[at_rest, n] = max(still[at_rest, n], cluster[t, n] + lost)
            exact[as_known, n] = max(exact[as_known, n], cluster[t, n] + lost)
            exact[t + 1, n] = max(exact[t + 1, n], exact[t, n])
            still[t + 1, n] = max(still[t + 1, n], still[t, n])
    worst = np.zeros(most + 1, np.int64)
    for n in range(most + 1):
        worst[n] = max(exact[steps, n], still[steps, n], worst[max(n - 1, 0)])
    return worst
