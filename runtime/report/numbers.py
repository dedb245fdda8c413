"""Numbers as people read them."""

from __future__ import annotations

from spikeloom.runtime.report.intervals import wilson


def percent(right: int, total: int) -> str:
    """Accuracy with its Wilson interval.

    Examples
    --------
    >>> percent(127, 144)
    '88.19 % (127 of 144; 95 % interval 81.9 … 92.5)'
    """
    low, high = wilson(right, total)
    return f"{100 * right / total:.2f} % ({right} of {total}; 95 % interval {100 * low:.1f} … {100 * high:.1f})"


def si(value: float, unit: str) -> str:
    """Three digits with an SI prefix.

    Examples
    --------
    >>> si(0.000321, "J"), si(0.0, "J"), si(2.5e-9, "J"), si(9.999e-4, "J")
    ('321 µJ', '0 J', '2.5 nJ', '1 mJ')
    """
    for factor, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p")):
        if abs(value) >= 0.9995 * factor:  # what three digits round up to the next prefix
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"


def counted(value: float) -> str:
    """A large number in few letters.

    Examples
    --------
    >>> counted(950.0), counted(2000.0), counted(1.75e6)
    ('950', '2k', '1.75M')
    """
    for factor, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g}{letter}"
    return f"{value:.3g}"
