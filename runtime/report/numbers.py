"""Numbers as people read them, and their intervals: sixty test samples deserve to say how little they know.

Closed formulas, which tests hold against :mod:`scipy.stats`: to load that takes as long as many a command.
"""

import math
import statistics
from collections.abc import Iterable, Sequence


def percent(right: int, total: int) -> str:
    """Accuracy with its Wilson interval.

    >>> percent(127, 144)
    '88.19 % (127 of 144; 95 % interval 81.9 … 92.5)'
    """
    low, high = wilson(right, total)
    return (
        f"{100 * right / total:.2f} % ({right} of {total}; 95 % interval {100 * low:.1f} … {100 * high:.1f})"
    )


def si(value: float, unit: str) -> str:
    """Three digits with an SI prefix.

    >>> si(0.000321, "J"), si(0.0, "J"), si(2.5e-9, "J"), si(9.999e-4, "J")
    ('321 µJ', '0 J', '2.5 nJ', '1 mJ')
    """
    for factor, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p")):
        if abs(value) >= 0.9995 * factor:  # what three digits round up to the next prefix
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def dominant(static_j: Iterable[float], dynamic_j: Iterable[float]) -> str:
    """Which term of a decision is the larger at the pace of a sensor, by any source; joules.

    >>> dominant([0.1, 0.3], [0.001, 0.002]), dominant([0.1], [0.0])  # doctest: +NORMALIZE_WHITESPACE
    ("at the sensor's pace static power dominates: 100 mJ to 300 mJ, 50 times the dynamic energy or more",
     "at the sensor's pace static power dominates: 100 mJ to 100 mJ")
    """
    least, *_, most = sorted([*static_j] * 2)
    high = max(dynamic_j)
    static = f"{si(least, 'J')} to {si(most, 'J')}"
    if least <= high:
        return f"at the sensor's pace dynamic energy is {si(high, 'J')}, static {static}"
    more = f"{static}, {least / high:,.0f} times the dynamic energy or more" if high else static
    return f"at the sensor's pace static power dominates: {more}"


def counted(value: float) -> str:
    """A large number in few letters.

    >>> counted(950.0), counted(2000.0), counted(1.75e6)
    ('950', '2k', '1.75M')
    """
    for factor, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g}{letter}"
    return f"{value:.3g}"


NORMAL = 1.959963984540054
"""Standard deviations within which 95 % of a normal variable lie."""


def wilson(successes: float, trials: int) -> tuple[float, float]:
    """Wilson score interval of a proportion, 95 %.

    References
    ----------
    .. [1] E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22, 1927.

    >>> [round(100 * bound, 1) for bound in wilson(127, 144)]
    [81.9, 92.5]
    >>> wilson(0, 0)
    (0.0, 1.0)
    """
    if not trials:
        return 0.0, 1.0
    share = successes / trials
    z = NORMAL
    centre = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # at the ends centre and spread are equal up to rounding; the interval ends there exactly
    low = (centre - spread) / scale if successes else 0.0
    return low, (centre + spread) / scale if successes < trials else 1.0


def of_mean(values: Sequence[float]) -> tuple[float, float]:
    """Student's 95 % confidence interval of the mean of at least two values.

    References
    ----------
    .. [1] Student, "The probable error of a mean", Biometrika 6, 1908.

    >>> [round(bound, 3) for bound in of_mean([1.0, 2.0, 3.0])]
    [-0.484, 4.484]
    """
    from scipy.special import stdtrit  # a tenth of a second that other commands need not wait

    error = statistics.stdev(values) / math.sqrt(len(values))
    reach = float(stdtrit(len(values) - 1, 0.975)) * error
    mean = statistics.fmean(values)
    return mean - reach, mean + reach
