"""``--budget``: what a user can spend or must reach, and the point that fits it best."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.studies.chart.points import NEAR, against, best_of, cost_of, time_of

Json = dict[str, Any]

UNITS = {
    "energy": {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6, "µJ": 1e-6, "μJ": 1e-6, "nJ": 1e-9, "pJ": 1e-12},
    "latency": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9},
    "accuracy": {"": 0.01, "%": 0.01},
}
"""What can be limited, and its units; both letters for micro are in use."""

SHOWN = {"energy": "as in 0.1mJ", "latency": "as in 5ms", "accuracy": "in per cent, as in 88"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """One limit.

    Parameters
    ----------
    what : {"energy", "latency", "accuracy"}
        Of a mean inference: energy in joules or chip time in seconds at most, or expected share right at least.
    limit : float
    words : str
        As typed.
    """

    what: str
    limit: float
    words: str


def parse_budgets(asked: Sequence[str]) -> tuple[Budget, ...]:
    """Read the words of every ``--budget``.

    Raises
    ------
    OptionError
        If one cannot be understood, or one thing is limited twice.

    Examples
    --------
    >>> [(each.what, each.limit) for each in parse_budgets(["latency=5ms", "accuracy=88"])]
    [('latency', 0.005), ('accuracy', 0.88)]
    """
    found: dict[str, Budget] = {}
    for words in asked:
        what, equals, value = (part.strip() for part in words.partition("="))
        if not equals or what not in UNITS:
            raise OptionError(
                f"--budget {words}: is none of {', '.join(UNITS)}; write for example energy=0.1mJ or accuracy=88"
            )
        if what in found:
            raise OptionError(f"--budget {words}: {what} is limited twice; give it once")
        number = re.fullmatch(r"([0-9]+\.?[0-9]*|\.[0-9]+)(?:e([+-]?[0-9]{1,2}))?\s*([^0-9.\s]*)", value)
        unit = None if number is None else UNITS[what].get(number[3])
        if number is None or unit is None:
            raise OptionError(
                f"--budget {words}: {value or 'nothing'} is no {what}; write it {SHOWN[what]} "
                f"({', '.join(u for u in UNITS[what] if u.isascii() and u)})"
            )
        limit = float(f"{number[1]}e{number[2] or 0}") * unit
        if limit <= 0 or (what == "accuracy" and limit > 1):
            raise OptionError(f"--budget {words}: allowed is {'0 to 100' if what == 'accuracy' else 'more than 0'}")
        found[what] = Budget(what=what, limit=limit, words=words)
    return tuple(found.values())


def pick(points: Sequence[Json], budgets: Sequence[Budget], *, energy: str, time: str | None) -> Json | None:
    """The point for a user, chosen by training figures; None without a budget.

    Where an accuracy is wanted, the cheapest point that fits; else the one that is expected to be right most often. If
    nothing fits, the point that misses by the smallest factor.

    Raises
    ------
    OptionError
        If time is limited and nothing is timed.

    Returns
    -------
    dict
        ``fits``, ``point``, ``misses`` (what it misses, with what it has) and ``given_up``, beside the best.
    """
    if not budgets:
        return None
    if time is None and any(budget.what == "latency" for budget in budgets):
        raise OptionError("--budget latency: the chip has no time table, nothing is timed; leave it away")
    fitting = [point for point in points if all(_excess(point, b, energy, time) <= 1 + NEAR for b in budgets)]
    if not fitting:
        nearest = min(points, key=lambda p: (max(_excess(p, b, energy, time) for b in budgets), cost_of(energy)(p)))
        missed = [b for b in budgets if _excess(nearest, b, energy, time) > 1 + NEAR]
        chosen, misses = (
            nearest,
            {b.what: {"limit": b.limit, "found": _found(nearest, b, energy, time)} for b in missed},
        )
    elif any(budget.what == "accuracy" for budget in budgets):
        chosen, misses = min(fitting, key=cost_of(energy)), {}
    else:
        chosen, misses = best_of(fitting, energy), {}
    best = best_of(points, energy)
    return {
        "budgets": [budget.words for budget in budgets],
        "fits": bool(fitting),
        "fitting": len(fitting),
        "point": chosen["number"],
        "misses": misses,
        "best": best["number"],
        "given_up": against(chosen, best),
    }


def _found(point: Mapping[str, Any], budget: Budget, energy: str, time: str | None) -> float:
    if budget.what == "accuracy":
        return float(point["expected"])
    if budget.what == "energy":
        return cost_of(energy)(dict(point))
    assert time is not None, "checked before"
    return time_of(time)(dict(point))


def _excess(point: Mapping[str, Any], budget: Budget, energy: str, time: str | None) -> float:
    """Factor by which a point misses a budget; at most 1 where it fits."""
    found = _found(point, budget, energy, time)
    if budget.what == "accuracy":
        return budget.limit / found if found > 0 else float("inf")
    return found / budget.limit
