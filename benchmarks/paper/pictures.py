"""The paper's tables as pictures: accuracies beside the published ones, costs of graphs, neurons that never fire."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
from cells import RUNS
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from spreads import Line

SERIES = {
    "best": ("best epoch on test", "C0", "o"),
    "last": ("last epoch", "C1", "s"),
    "clean": ("clean epoch, chosen on validation", "C2", "^"),
    "chip": ("last epoch on the chip, 8 bits", "C3", "D"),
}
"""Label, colour and marker."""

ENERGY = "davies2018"
DPI = 110
WIDTH = 6.4
"""Of a panel, in inches."""


def pictures(table: str, lines: Sequence[Line]) -> dict[str, bytes]:
    """PNG files of a table by name."""
    mpl.use("Agg")
    by_data = {
        data: [line for line in lines if line.row.data == data]
        for data in {line.row.data: 0 for line in lines}
    }
    found = {f"{table}.png": _png(_accuracies(by_data))}
    if table == "graphs":
        found |= {"graphs-costs.png": _png(_costs(by_data)), "graphs-quiet.png": _png(_quiet(by_data))}
    return found


def _png(figure: Figure) -> bytes:
    """With a palette: a third of the bytes."""
    drawn, content = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(128).save(content, "PNG", optimize=True)
    return content.getvalue()


def _panels(by_data: dict[str, list[Line]], down: int, height: float) -> tuple[Figure, Any]:
    size = (WIDTH * len(by_data), height * down)
    return plt.subplots(down, len(by_data), figsize=size, layout="constrained", squeeze=False)


def _legend(figure: Figure, panels: Sequence[Axes], loc: Any = "outside lower center") -> None:
    """One legend for all panels, each label once."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    columns = 3 if figure.get_figwidth() > WIDTH else 2
    figure.legend(list(entries.values()), list(entries), loc=loc, ncols=columns, fontsize=8)


def _titled(lines: Sequence[Line]) -> str:
    return f"{lines[0].row.data}, {lines[0].row.epochs} epochs"


def _accuracies(by_data: dict[str, list[Line]]) -> Figure:
    """For each row every seed, means with intervals, and the paper's figure."""
    rows = max(map(len, by_data.values()))
    figure, panels = _panels(by_data, 1, 1.5 + 0.62 * rows)
    if rows < 6:  # few enough for one above the other, as a phone shows them best
        plt.close(figure)
        size = (0.8 * WIDTH, len(by_data) * (1.2 + 0.5 * rows))
        figure, panels = plt.subplots(len(by_data), figsize=size, layout="constrained", squeeze=False)
    panels = panels.ravel()
    for axes, lines in zip(panels, by_data.values(), strict=True):
        values: list[float] = []
        for place, line in enumerate(lines):
            values += _accuracy_row(axes, place, line)
        # intervals of two or three seeds may reach far beyond the points
        room = max(2.0, 0.25 * (max(values) - min(values)))
        axes.set_xlim(max(0.0, min(values) - room), min(100.0, max(values) + room))
        axes.set_yticks(range(len(lines)), [line.name for line in lines])
        axes.set_ylim(len(lines) - 0.5, -0.5)
        axes.set_title(_titled(lines))
        axes.grid(axis="x", alpha=0.3)
        for place in range(1, len(lines)):
            axes.axhline(place - 0.5, color="0.9", linewidth=0.8)
    for axes in panels[-1:] if rows < 6 else panels:
        axes.set_xlabel("accuracy (%)\nbar: 95 % interval of the mean,\ncut at the frame; dots: seeds")
    _legend(figure, panels)
    return figure


def _accuracy_row(axes: Axes, place: int, line: Line) -> list[float]:
    """Draw a row; return its accuracies."""
    seen: list[float] = []
    if line.paper is not None:
        mean, std = line.paper
        reach = 2 * (std or 0.0) / RUNS**0.5
        band = [place - 0.44, place + 0.44]
        axes.fill_betweenx(band, mean - reach, mean + reach, color="0.35", alpha=0.18, lw=0)
        axes.plot([mean] * 2, band, color="0.35", linewidth=1.6, label="paper: mean ± 2 standard errors")
        seen.append(mean)
    for at, (reading, (label, colour, marker)) in zip((-0.3, -0.1, 0.1, 0.3), SERIES.items(), strict=True):
        spread = line.accuracy(reading)
        axes.plot(
            spread.values, [place + at] * len(spread.values), ".", color=colour, alpha=0.45, markersize=5
        )
        if spread.interval is not None:
            axes.plot(spread.interval, [place + at] * 2, color=colour, linewidth=1.4)
        axes.plot([spread.mean], [place + at], marker, color=colour, markersize=5.5, label=label)
        seen += spread.values
    return seen


def _costs(by_data: dict[str, list[Line]]) -> Figure:
    """Accuracy at the last epoch, as float model and on the chip, against first-layer operations and energy."""
    figure, panels = _panels(by_data, 2, 4.6)
    for column, lines in enumerate(by_data.values()):
        _against(panels[0, column], lines, lambda line: line.mean("first_layer_operations") / 1e6)
        _against(panels[1, column], lines, lambda line: 1e6 * line.mean("energy_j", ENERGY))
        panels[0, column].set(
            xlabel="first-layer synaptic operations an inference (million)", title=_titled(lines)
        )
        panels[1, column].set(xlabel=f"energy of an inference (µJ, {ENERGY})")
    _legend(figure, list(panels.flat))
    return figure


def _against(axes: Axes, lines: Sequence[Line], cost_of: Callable[[Line], float]) -> None:
    """Float model and chip of each row over a cost, dots for seeds."""
    points: dict[tuple[float, float], list[str]] = {}
    for line in lines:
        cost, seen = cost_of(line), list[float]()
        for reading in ("last", "chip"):
            label, colour, marker = SERIES[reading]
            spread = line.accuracy(reading)
            axes.plot(
                [cost] * len(spread.values), spread.values, ".", color=colour, alpha=0.45, markersize=4
            )
            size = 4.5 if reading == "chip" else 7
            axes.plot([cost], [spread.mean], marker, color=colour, markersize=size, label=label)
            seen += spread.values
        axes.plot([cost, cost], [min(seen), max(seen)], color="0.8", linewidth=0.8, zorder=0)
        points.setdefault((cost, max(seen)), []).append(line.name.removeprefix("released:"))
    axes.margins(0.08, 0.08)
    axes.grid(alpha=0.3)
    axes.set_ylabel("accuracy at the last epoch (%); dots: seeds")
    _name(axes, points)


def _name(axes: Axes, points: dict[tuple[float, float], list[str]]) -> None:
    """Names in one row above all points, upright and apart, each tied to its point; equal points share theirs."""
    order = sorted(points)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    gap = 0.03 * (right - left)
    places = [cost for cost, _ in order]
    for index in range(1, len(places)):
        places[index] = max(places[index], places[index - 1] + gap)
    places[-1] = min(places[-1], right - gap / 2)
    for index in range(len(places) - 2, -1, -1):
        places[index] = min(places[index], places[index + 1] - gap)
    for place, (cost, top) in zip(places, order, strict=True):
        axes.plot([cost, place], [top, high], color="0.85", linewidth=0.8, zorder=0)
        axes.text(
            place,
            high,
            " " + ", ".join(points[cost, top]),
            ha="center",
            va="bottom",
            fontsize=7,
            rotation=90,
        )
    axes.set_xlim(left, right)
    axes.set_ylim(low, high + 0.3 * (high - low))


def _quiet(by_data: dict[str, list[Line]]) -> Figure:
    """First-layer neurons by whether they fire, and what leaving out those that do not saves."""
    figure, panels = _panels(by_data, 2, 1.2 + 0.3 * max(map(len, by_data.values())))
    for column, lines in enumerate(by_data.values()):
        _neurons(panels[0, column], lines)
        panels[0, column].set(xlabel="neurons of the first layer, mean over seeds", title=_titled(lines))
        _savings(panels[1, column], lines)
        panels[1, column].set(xlabel="saved without neurons that fired in no training recording (%)")
        for axes in panels[:, column]:
            axes.set_yticks(range(len(lines)), [line.name for line in lines])
            axes.invert_yaxis()
    _legend(figure, [*panels[0]], "outside upper center")
    panels[1, 0].legend(loc="center right", fontsize=8)
    return figure


def _neurons(axes: Axes, lines: Sequence[Line]) -> None:
    keys = ("neurons", "cannot_fire", "unheard", "quiet_in_training", "quiet_in_both")
    means = [{key: line.mean("first_layer", key) for key in keys} for line in lines]
    parts = {
        "fire": [f["neurons"] - f["cannot_fire"] - f["unheard"] - f["quiet_in_training"] for f in means],
        "fire in test only": [f["quiet_in_training"] - f["quiet_in_both"] for f in means],
        "never fire on either split": [f["quiet_in_both"] for f in means],
        "cannot fire (proven), left out by compile": [f["cannot_fire"] for f in means],
    }
    left = [0.0] * len(lines)
    for (label, widths), colour in zip(parts.items(), ("C0", "C4", "C1", "0.75"), strict=True):
        axes.barh(range(len(lines)), widths, left=left, color=colour, label=label)
        left = [start + width for start, width in zip(left, widths, strict=True)]


def _savings(axes: Axes, lines: Sequence[Line]) -> None:
    figures = {
        "first-layer operations": ("first_layer_operations",),
        "all operations": ("synaptic_operations",),
        f"energy ({ENERGY})": ("energy_j", ENERGY),
    }
    most = 1.0
    for offset, (label, keys), colour in zip(
        (-0.27, 0.0, 0.27), figures.items(), ("C9", "C5", "C2"), strict=True
    ):
        saved = [100 * (1 - line.mean("without_quiet", *keys) / line.mean(*keys)) for line in lines]
        axes.barh(
            [place + offset for place in range(len(lines))], saved, height=0.25, label=label, color=colour
        )
        most = max(most, *saved)
    axes.set_xlim(0, 1.5 * most)  # room for the legend
    axes.grid(axis="x", alpha=0.3)
