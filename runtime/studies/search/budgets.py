"""The words of ``--budget``: limits of a mean inference."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from spikeloom.compiler.errors import OptionError

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}

_SHARE = {"": 0.01, "%": 0.01}
_NUMBER = {"": 1.0}

LIMITED = {
    "energy": (
        {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6, "µJ": 1e-6, "μJ": 1e-6, "nJ": 1e-9, "pJ": 1e-12},
        "as in 0.1mJ",
    ),
    "time": (_SECONDS, "as in 5ms"),
    "accuracy": (_SHARE, "in per cent, as in 88"),
    "certified": (_SHARE, "in per cent, as in 90"),
    "operations": (_NUMBER, "as in 25000"),
    "cores": (_NUMBER, "as in 1"),
}
"""What can be limited, its units and how it is written; both letters for micro are in use."""

SHARES = ("accuracy", "certified")
"""Those of which there is to be as much at least."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """One limit of a mean inference, as typed: joules or seconds on the chip at most, or share at least.

    Of operations and cores their number at most.
    """

    what: str
    limit: float
    words: str


def parse_budgets(
    given: Sequence[str], limits: Collection[str] = ("energy", "time", "accuracy", "certified")
) -> tuple[Budget, ...]:
    """Read the words of every ``--budget``; an OptionError says which is none of what has `limits`."""
    budgets: dict[str, Budget] = {}
    for words in given:
        what, equals, value = (part.strip() for part in words.partition("="))
        if not equals or what not in limits:
            raise OptionError(
                f"--budget {words}: is none of {', '.join(limits)}; write for example energy=0.1mJ or accuracy=88"
            )
        if what in budgets:
            raise OptionError(f"--budget {words}: {what} is limited twice; give it once")
        number = re.fullmatch(r"([0-9]+\.?[0-9]*|\.[0-9]+)(?:e([+-]?[0-9]{1,2}))?\s*([^0-9.\s]*)", value)
        units, example = LIMITED[what]
        unit = None if number is None else units.get(number[3])
        if number is None or unit is None:
            names = ", ".join(u for u in units if u and u.isascii())
            raise OptionError(
                f"--budget {words}: {value or 'nothing'} is no {what}; write it {example}"
                + (f" ({names})" if names else "")
            )
        limit = float(f"{number[1]}e{number[2] or 0}") * unit
        if limit <= 0 or (units is _SHARE and not 0.01 <= limit <= 1):  # 0.9 is meant as a share
            allowed = "1 to 100 per cent" if units is _SHARE else "more than 0"
            raise OptionError(f"--budget {words}: allowed is {allowed}")
        budgets[what] = Budget(what=what, limit=limit, words=words)
    return tuple(budgets.values())


def excess(values: Mapping[str, float], budget: Budget) -> float:
    """Factor by which values, by what is limited, miss a budget; at most 1 where they fit."""
    if budget.what not in values:
        raise OptionError(f"--budget {budget.words}: the chip has no time table, nothing is timed; omit it")
    value = values[budget.what]
    if budget.what in SHARES:
        return budget.limit / value if value else float("inf")
    return value / budget.limit
