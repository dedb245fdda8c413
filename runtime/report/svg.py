"""Figures as SVG text: a few shapes, nice ticks, bars and lines. Colours come from the page's style sheet, by class.

A shape with a tip carries it as ``<title>``: browsers show it on hover, the page's script reads it to the keyboard.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from spikeloom.runtime.report.tables import si

WIDTH = 960
"""Of a figure, in its own units; the page scales it."""

LETTER = 6.6
"""About the width of a letter of a figure's text."""


def number(value: float) -> str:
    """A coordinate in as few letters as tell hundredths.

    Examples
    --------
    >>> number(3.0), number(2.504), number(-0.001)
    ('3', '2.5', '0')
    """
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def shape(name: str, style: str, tip: str = "", /, **attributes: float | str) -> str:
    """One element; underscores in names of attributes are hyphens.

    Examples
    --------
    >>> shape("rect", "bar", "5 < 6", x=1, width=2.5)
    '<rect class="bar v" x="1" width="2.5"><title>5 &lt; 6</title></rect>'
    """
    words = [f'class="{style} v"' if tip else f'class="{style}"']
    for key, value in attributes.items():
        shown = value if isinstance(value, str) else number(value)
        words.append(f'{key.replace("_", "-")}="{escape(shown)}"')
    inner = f"<title>{escape(tip)}</title>" if tip else ""
    return f"<{name} {' '.join(words)}>{inner}</{name}>" if tip else f"<{name} {' '.join(words)}/>"


def words(
    x: float,
    y: float,
    text: str,
    style: str = "",
    anchor: str = "start",
    *,
    size: float | None = None,
    upwards: bool = False,
) -> str:
    """A line of text."""
    kind = f' class="{style}"' if style else ""
    where = "" if anchor == "start" else f' text-anchor="{anchor}"'
    where += "" if size is None else f' style="font-size:{number(size)}px"'
    where += f' transform="rotate(-90 {number(x)} {number(y)})"' if upwards else ""
    return f'<text x="{number(x)}" y="{number(y)}"{kind}{where}>{escape(text)}</text>'


def drawing(name: str, title: str, height: float, content: Sequence[str], *, width: float = WIDTH) -> str:
    """A whole figure, `name` being its id; the title is what screen readers say."""
    return (
        f'<svg id="{name}" role="img" aria-labelledby="{name}-title" viewBox="0 0 {number(width)} {number(height)}">'
        f'<title id="{name}-title">{escape(title)}</title>{"".join(content)}</svg>'
    )


def ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers between two others, `most` + 1 at most.

    Examples
    --------
    >>> ticks(0, 250), ticks(0.0, 0.83)
    ([0, 50, 100, 150, 200, 250], [0.0, 0.2, 0.4, 0.6000000000000001, 0.8])
    >>> ticks(2, 2)
    [2]
    """
    if high <= low:
        return [low]
    rough = (high - low) / most
    size = 10.0 ** math.floor(math.log10(rough))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= rough * 0.999999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    if float(step).is_integer():
        return [i * int(step) for i in range(first, last + 1)]
    return [i * step for i in range(first, last + 1)]


def legend(names: Mapping[str, str], x: float, y: float, *, strokes: bool = False) -> str:
    """A row of swatches, or of strokes; names by class."""
    parts = []
    for style, name in names.items():
        if strokes:
            parts.append(shape("line", f"line {style}", x1=x - 8, y1=y - 4, x2=x + 14, y2=y - 4))
        else:
            parts.append(shape("rect", style, x=x, y=y - 9, width=14, height=10))
        parts.append(words(x + 19, y, name))
        x += 19 + LETTER * len(name) + 26
    return "".join(parts)


# -- bars --------------------------------------------------------------------------------------------------------------

ROW = 15
GAP = 9


def bars(
    name: str, title: str, rows: Mapping[str, Sequence[float]], series: Sequence[str], unit: str, *, left: float = 110
) -> str:
    """Horizontal bars, one for each series in each row, with their values beside them.

    Parameters
    ----------
    name, title : str
        Id, and what it shows.
    rows : mapping of str to sequence of float
        One value of each series.
    series : sequence of str
        Their names, in the colours of classes ``s0``, ``s1`` …
    unit : str
        For SI prefixes; empty for counts.
    left : float
        Room for names of rows.
    """
    most = max((value for values in rows.values() for value in values), default=0.0) or 1.0
    scale = (WIDTH - left - 90) / most
    content = [legend({f"s{i}": label for i, label in enumerate(series)}, left, 14)] if len(series) > 1 else []
    y = 30.0 if content else 8.0
    for label, values in rows.items():
        content.append(words(left - 8, y + len(values) * ROW / 2 + 4, label, anchor="end"))
        for i, (value, kind) in enumerate(zip(values, series, strict=True)):
            shown = si(value, unit) if unit else f"{value:,.0f}"
            tip = f"{label}, {kind}: {shown}"
            content.append(
                shape("rect", f"s{i}", tip, x=left, y=y, width=max(value * scale, 0.6), height=ROW - 2, rx=1.5)
            )
            content.append(words(left + value * scale + 5, y + 11, shown, "small"))
            y += ROW
        y += GAP
    content.append(shape("line", "axis", x1=left, y1=24 if len(series) > 1 else 2, x2=left, y2=y - GAP + 2))
    return drawing(name, title, y, content)


# -- lines -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A plot's area and its axes.

    Parameters
    ----------
    left, top, right, bottom : float
        Of the area.
    x_from, x_to, y_from, y_to : float
        Values at its edges.
    """

    left: float
    top: float
    right: float
    bottom: float
    x_from: float
    x_to: float
    y_from: float
    y_to: float

    def x(self, value: float) -> float:
        """Where a value is."""
        return self.left + (value - self.x_from) * (self.right - self.left) / ((self.x_to - self.x_from) or 1)

    def y(self, value: float) -> float:
        """Where a value is; upwards."""
        return self.bottom - (value - self.y_from) * (self.bottom - self.top) / ((self.y_to - self.y_from) or 1)

    def axes(self, label: str, unit: str) -> list[str]:
        """Grid, numbers and the name of the horizontal axis; `unit` as for :func:`bars`."""
        content = []
        for value in ticks(self.y_from, self.y_to, 4):
            y, shown = self.y(value), si(value, unit) if unit else f"{value:.4g}"
            content.append(shape("line", "grid", x1=self.left, y1=y, x2=self.right, y2=y))
            content.append(words(self.left - 6, y + 4, shown, "small", "end"))
        for value in ticks(self.x_from, self.x_to, 8):
            content.append(words(self.x(value), self.bottom + 16, f"{value:g}", "small", "middle"))
        content.append(shape("line", "axis", x1=self.left, y1=self.bottom, x2=self.right, y2=self.bottom))
        content.append(words((self.left + self.right) / 2, self.bottom + 32, label, "small", "middle"))
        return content

    def line(self, values: Sequence[float], style: str, first: float = 0) -> str:
        """One line through a value for each whole step."""
        points = " ".join(f"{number(self.x(first + i))},{number(self.y(value))}" for i, value in enumerate(values))
        return shape("polyline", f"line {style}", points=points)

    def columns(self, tips: Sequence[str], first: float = 0) -> str:
        """What is said of each step on hover: columns that are not seen."""
        wide = (self.right - self.left) / max(len(tips), 1)
        return "".join(
            shape(
                "rect",
                "column",
                tip,
                x=self.x(first + i) - wide / 2,
                y=self.top,
                width=wide,
                height=self.bottom - self.top,
            )
            for i, tip in enumerate(tips)
        )


def lines(name: str, title: str, series: Mapping[str, Sequence[float]], label: str, unit: str) -> str:
    """Lines over steps, each in a colour and a dash of its own (classes ``l0``, ``l1`` …)."""
    longest = max(len(values) for values in series.values())
    most = max((max(values, default=0.0) for values in series.values()), default=0.0) or 1.0
    frame = Frame(
        left=80, top=30, right=WIDTH - 15, bottom=230, x_from=0, x_to=max(longest - 1, 1), y_from=0, y_to=most * 1.05
    )
    content = [
        *frame.axes(label, unit),
        legend({f"l{i}": kind for i, kind in enumerate(series)}, frame.left + 8, 16, strokes=True),
    ]
    content += [frame.line(values, f"l{i}") for i, values in enumerate(series.values())]
    tips = [
        f"step {step}: " + ", ".join(f"{si(v[step], unit)} {kind}" for kind, v in series.items() if step < len(v))
        for step in range(longest)
    ]
    return drawing(name, title, 270, [*content, frame.columns(tips)])
