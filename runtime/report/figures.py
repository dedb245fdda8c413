"""Figures that more than one page has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from spikeloom.runtime.report import drawing
from spikeloom.runtime.report.numbers import si
from spikeloom.runtime.report.sections import Figure, Table


def bar_figure(
    name: str, title: str, rows: Mapping[str, Sequence[float]], series: Sequence[str], unit: str, caption: str
) -> Figure:
    """Bars, with their numbers as a table; each row has a value for each of the series."""
    cells = [[label, *(si(value, unit) for value in values)] for label, values in rows.items()]
    numbers = [Table(["", *series], cells, title, most=0)]
    return Figure(name, partial(drawing.bars, title, rows, series, unit), f"{title}. {caption}", numbers)
