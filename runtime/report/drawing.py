"""All figures, in Matplotlib: inline on pages, where pointer and arrow keys read values, or as files to print.

Series differ in shape or dash as well as in colour. Colours are Okabe and Ito's, which people with any
colour vision tell apart; on pages the style sheet chooses them for light and dark.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.runtime.report.numbers import counted, si

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#5b5b5b", "#b8a800")
CHIP = COLOURS[0]
FLOAT = COLOURS[4]
GREY = "#808890"
DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 2)), (0, (8, 2, 2, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">")
PICTURES = {"png": ("Software",), "svg": ("Creator", "Date", "Format", "Type"), "pdf": ("CreationDate",)}
"""Kinds of files by their ending, and what each would say of itself that differs from day to day."""
WIDTH = 9.6
"""Of a figure, in inches."""

STYLE = {
    "font.size": 9,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "axes.edgecolor": GREY,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": "black",
    "ytick.labelcolor": "black",
    "legend.frameon": False,
    "svg.fonttype": "none",
    "text.parse_math": False,  # names may hold a dollar
    "svg.hashsalt": "spikeloom",
}


@dataclass(eq=False)
class Drawing:
    """A Matplotlib figure and the values that pointer and keys read from it."""

    figure: Figure
    title: str  # What screen readers say
    # {"", "x", "y"}; direction in which the pointer seeks the nearest value; both by default
    along: Literal["", "x", "y"] = ""
    # Panel, place in it, and what is said there, in the order in which keys visit them
    tips: list[tuple[Axes, float, float, str]] = field(default_factory=list)
    # A panel whose rows have names and whose columns are steps: there the pointer reads every cell
    cells: tuple[Axes, Sequence[str]] | None = None

    def svg(self, name: str) -> str:
        """For a page, on which no other drawing has the name: see-through, colours by the style sheet."""
        text = self.file("svg", transparent=True).decode()
        text = text[text.index("<svg") :]
        for index, colour in enumerate(COLOURS):
            text = text.replace(colour, f"var(--c{index})")
        assert re.fullmatch(r"[a-z0-9-]+", name), (
            "names are ours: nothing from a file becomes a part of the page"
        )
        return re.sub(r'(id="|href="#|url\(#)', rf"\1{name}-", text)

    def values(self) -> JsonObject:
        """What a page's script reads: places in the units of the SVG."""
        height = self.figure.get_figheight() * 72

        def place(axes: Axes, x: float, y: float) -> list[float]:
            right, up = axes.transData.transform((x, y)) * 72 / self.figure.dpi
            return [round(float(right), 1), round(height - float(up), 1)]

        values: dict[str, Any] = {
            "along": self.along,
            "tips": [[*place(axes, x, y), tip] for axes, x, y, tip in self.tips],
        }
        if self.cells is not None:
            axes, names = self.cells
            (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
            values["cells"] = {
                "from": place(axes, left, top),
                "to": place(axes, right, bottom),
                "rows": list(names),
            }
            values["cells"]["columns"] = round(right - left)
        return values

    def file(self, kind: str, **options: Any) -> bytes:
        """As one of `PICTURES`; the same bytes for the same drawing."""
        content = io.BytesIO()
        with styled():
            none = dict.fromkeys(PICTURES[kind])
            self.figure.savefig(content, format=kind, dpi=150, metadata=none, **options)
        return content.getvalue()


@contextmanager
def styled() -> Iterator[None]:
    """The common style, whatever the user's matplotlibrc says; `@styled()` draws in it."""
    from matplotlib import rc_context, rcdefaults, rcParams

    with rc_context():
        rcdefaults()
        rcParams.update(STYLE)  # type: ignore[arg-type]
        yield


def sheet(title: str, height: float, *, width: float = WIDTH) -> Drawing:
    """An empty figure; sizes in inches."""
    from matplotlib.figure import Figure  # the object interface: no global state, no window

    return Drawing(Figure(figsize=(width, height), layout="constrained"), title)


def scale(axes: Any, unit: str) -> None:
    """Numbers of an axis with SI prefixes; letters for thousands and millions without a unit."""
    axes.set_major_formatter(lambda value, _: si(value, unit) if unit else counted(value))


def plain_logarithm(axis: Any) -> None:
    """Numbers of a logarithmic axis as plain text, since names may hold a dollar and formulas are not read."""
    from matplotlib.ticker import LogFormatter

    axis.set_major_formatter(LogFormatter())
    axis.set_minor_formatter(LogFormatter(labelOnlyBase=False))


@styled()
def bars(title: str, rows: Mapping[str, Sequence[float]], series: Sequence[str], unit: str = "") -> Drawing:
    """Horizontal bars, one for each series in each row, with their values beside them."""
    drawing = sheet(title, 0.5 + 0.21 * len(series) * len(rows) + 0.12 * len(rows))
    drawing.along = "y"
    axes = drawing.figure.subplots()
    thick = 0.8 / len(series)
    for place, (label, values) in enumerate(rows.items()):
        for index, (value, kind) in enumerate(zip(values, series, strict=True)):
            y = place + (index - (len(series) - 1) / 2) * thick
            shown = si(value, unit) if unit else f"{value:,.0f}"
            colour = COLOURS[index % len(COLOURS)]
            axes.barh(y, value, thick * 0.9, color=colour, label=kind if place == 0 else None)
            axes.annotate(shown, (value, y), (4, 0), textcoords="offset points", va="center", fontsize=8)
            drawing.tips.append((axes, value, y, f"{label}, {kind}: {shown}"))
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.margins(x=0.12, y=0.02)
    axes.xaxis.set_visible(False)
    axes.spines["bottom"].set_visible(False)
    if len(series) > 1:
        drawing.figure.legend(loc="outside upper left", ncols=len(series))
    return drawing


@styled()
def matrices(title: str, panels: Mapping[str, IntArray]) -> Drawing:
    """Confusion matrices side by side: rows are labels, columns decisions; right ones are of another colour."""
    from matplotlib.patches import Rectangle

    drawing = sheet(title, 4.6)
    axes_of = np.ravel(drawing.figure.subplots(1, len(panels)))
    for axes, (side, counts) in zip(axes_of, panels.items(), strict=True):
        totals = np.maximum(counts.sum(axis=1), 1)
        size = min(9.0, 150 / len(counts))
        for label, decided in np.argwhere(counts).tolist():
            count = int(counts[label, decided])
            colour = CHIP if label == decided else FLOAT
            alpha = 0.2 + 0.4 * count / totals[label]
            corner = decided - 0.5, label - 0.5
            axes.add_patch(Rectangle(corner, 1, 1, facecolor=colour, alpha=alpha, edgecolor="none"))
            axes.text(decided, label, str(count), ha="center", va="center", fontsize=size)
            tip = f"{side}: label {label} decided as {decided}, {count} of {counts[label].sum()} recordings"
            drawing.tips.append((axes, decided, label, tip))
        axes.set(xlim=(-0.5, len(counts) - 0.5), ylim=(len(counts) - 0.5, -0.5), aspect="equal", title=side)
        axes.set(xlabel="decided as", ylabel="label")
        axes.locator_params(integer=True)
        axes.spines[:].set_visible(True)
    return drawing


@styled()
def raster(
    title: str, neurons: Sequence[int], steps: int, spikes: Mapping[str, IntArray], kind: str = "neuron"
) -> Drawing:
    """Spikes of both sides: rows are `neurons`, columns steps; differences are marked.

    `spikes` holds pairs of step and neuron: ``both``, ``float`` and ``chip`` (of one side only).
    """
    drawing = sheet(title, min(max(0.032 * len(neurons), 1.0), 4.4) + 0.9)
    axes = drawing.figure.subplots()
    row = {neuron: index for index, neuron in enumerate(neurons)}

    def places(side: str) -> IntArray:
        shown = [(step, row[neuron]) for step, neuron in spikes[side].tolist() if neuron in row]
        return np.array(sorted(shown), np.int64).reshape(-1, 2)

    image = np.zeros((max(len(neurons), 1), max(steps, 1), 4))
    both = places("both")
    image[both[:, 1], both[:, 0]] = (0.5, 0.53, 0.56, 0.9)
    extent = (-0.5, steps - 0.5, len(image) - 0.5, -0.5)
    axes.imshow(image, aspect="auto", interpolation="nearest", extent=extent)
    axes.plot([], [], "s", color=GREY, ms=4, label="both fire")
    tips = []
    for side, colour, marker in (("float", FLOAT, "_"), ("chip", CHIP, "|")):
        alone = places(side)
        name = "float model" if side == "float" else side
        axes.plot(
            alone[:, 0],
            alone[:, 1],
            marker,
            color=colour,
            ms=3 if len(neurons) > 150 else 6,
            mew=1.2,
            label=f"{name} only",
        )
        tips += [(x, y, f"{kind} {neurons[y]}, step {x}: only the {name} fires") for x, y in alone.tolist()]
    drawing.tips += [(axes, x, y, tip) for x, y, tip in sorted(tips)]
    drawing.cells = axes, [f"{kind} {neuron}" for neuron in neurons]
    if not neurons:
        axes.text(0.02, 0.5, "silent", transform=axes.transAxes, va="center")
    shown = range(0, len(neurons), max(1, -(-len(neurons) // 25)))
    axes.set_yticks(shown, [str(neurons[index]) for index in shown], fontsize=7)
    axes.set(xlabel="step", ylabel=kind)
    drawing.figure.legend(loc="outside upper left", ncols=3)
    return drawing
