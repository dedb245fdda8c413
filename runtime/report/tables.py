"""Numbers and tables as people read them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spikeloom.runtime.report.intervals import wilson


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Align columns: the first to the left, the others to the right.

    Examples
    --------
    >>> print(table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3456"]]))
      layer  spikes
      conv1      12
      fc1      3456
    """
    lines = [list(head), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join(
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


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
