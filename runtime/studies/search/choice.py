"""Which of many candidates no other one beats, and which one to take."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.runtime.studies.search.budgets import Budget, excess

Candidate = TypeVar("Candidate")

NEAR = 1e-9
"""Shares closer than this are equal."""


def front(gains: Sequence[float], costs: Sequence[float]) -> list[bool]:
    """Which points no other one beats: at least as much gain for at most the cost, and better in one of them."""
    order = sorted(range(len(gains)), key=lambda i: (costs[i], -gains[i]))
    on = [False] * len(gains)
    best = float("-inf")
    best_cost = float("nan")
    for i in order:
        on[i] = gains[i] > best or (gains[i] == best and costs[i] == best_cost)
        if gains[i] > best:
            best = gains[i]
            best_cost = costs[i]
    return on


def lead(best: FloatArray, other: FloatArray) -> tuple[float, float]:
    """What one has ahead of another, recording by recording, and the standard error of that; NaN is not compared.

    >>> lead(np.array([1.0, 1.0, 1.0, 0.0]), np.array([1.0, 1.0, 0.0, 1.0]))
    (0.0, 0.408248290463863)
    """
    ahead = best - other
    ahead = ahead[~np.isnan(ahead)]
    if not len(ahead):
        return 0.0, 0.0
    error = ahead.std(ddof=1) / np.sqrt(len(ahead)) if len(ahead) > 1 else 0.0
    return float(ahead.mean()), float(error)


def is_worse(best: FloatArray, other: FloatArray) -> bool:
    """Whether one is shown to be worse than another: by more than a standard error of the difference."""
    ahead, error = lead(best, other)
    return ahead > error + NEAR


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection(Generic[Candidate]):
    """Candidates that fit the budgets, the best of them, and those that are not worse than it.

    Where nothing fits, the best and the only one `allowed` is the one that misses by the smallest factor.
    """

    fitting: tuple[Candidate, ...]
    best: Candidate
    allowed: tuple[Candidate, ...]


def choose(
    candidates: Sequence[Candidate],
    values: Callable[[Candidate], Mapping[str, float]],
    worse: Callable[[Candidate, Candidate], bool],
    budgets: Sequence[Budget] = (),
) -> Selection[Candidate]:
    """Find the candidates of which the cheapest is to be taken.

    `values` are what budgets limit, ``energy`` and ``accuracy`` among them; `worse` says of the best and
    another one whether that is shown to be worse. Where an accuracy is wanted, all that reach it are good
    enough.
    """

    def miss(each: Candidate) -> float:
        return max((excess(values(each), budget) for budget in budgets), default=0.0)

    fitting = tuple(each for each in candidates if miss(each) <= 1 + NEAR)
    allowed = fitting or (min(candidates, key=lambda each: (miss(each), values(each)["energy"])),)
    best = min(allowed, key=lambda each: (-values(each)["accuracy"], values(each)["energy"]))
    if not any(budget.what == "accuracy" for budget in budgets):
        allowed = tuple(each for each in allowed if not worse(best, each))
    return Selection(fitting=fitting, best=best, allowed=allowed)
