"""A chart as pictures to print: SVG and PNG, told apart by shape as well as by colour."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from spikeloom.runtime.studies.chart.costs import Cost, costs_of
from spikeloom.runtime.studies.chart.figure import log_ticks, series_of, taken_points
from spikeloom.runtime.studies.chart.points import by_chip

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Json = dict[str, Any]

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000", "#B8A800")
"""Okabe and Ito's, which people with any colour vision tell apart; the yellow darkened for white paper."""

MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">")

DPI = 150

SIZE = (7.2, 4.4)
"""Of a panel, in inches."""

ACROSS = 2
"""Panels side by side."""


def pictures(report: Json) -> dict[str, bytes]:
    """``chart.svg`` and ``chart.png``; the same bytes for the same chart.

    Parameters
    ----------
    report : dict
        A chart.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    with mpl.rc_context({"svg.hashsalt": "spikeloom", "font.size": 9}):
        figure = _drawn(report)
        found = {}
        for kind in ("svg", "png"):
            content = io.BytesIO()
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            figure.savefig(content, format=kind, dpi=DPI, metadata=metadata)
            found[f"chart.{kind}"] = content.getvalue()
        plt.close(figure)
    return found


def _drawn(report: Json) -> Figure:
    from matplotlib import pyplot as plt

    costs = costs_of(report)
    width, height = SIZE
    down = -(-len(costs) // ACROSS)
    figure, rows = plt.subplots(
        down, ACROSS, figsize=(width * ACROSS, height * down), layout="constrained", squeeze=False, sharey=True
    )
    panels = list(rows.flat)
    for axes, (name, cost) in zip(panels, costs.items(), strict=False):
        _panel(axes, report, name, cost)
    for axes in panels[len(costs) :]:
        axes.set_visible(False)
    for row in rows:
        row[0].set_ylabel("test accuracy on the chip (%)")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 6), fontsize=8)
    data = report["data"]
    figure.suptitle(
        f"{len(report['points'])} configurations, {data['test']} test recordings of {_name(data['path'])}; larger "
        "marks have seen more of each recording",
        fontsize=10,
    )
    return figure


def _name(path: str) -> str:
    return path.rstrip("/").rsplit("/", 1)[-1]


def _panel(axes: Axes, report: Json, name: str, cost: Cost) -> None:
    points = report["points"]
    axis, names = series_of(points)
    for index, value in enumerate(names):
        own = [point for point in points if str(point[axis]) == value]
        colour = COLOURS[index % len(COLOURS)]
        hollow = index // len(COLOURS) % 2 == 1
        axes.scatter(
            [cost.value(point) for point in own],
            [100 * point["test"]["accuracy"] for point in own],
            s=[14 + 0.3 * point["window"] for point in own],
            marker=MARKERS[index % len(MARKERS)],
            facecolors="none" if hollow else colour,
            edgecolors=colour if hollow else "white",
            linewidths=0.9 if hollow else 0.4,
            label=value,
            zorder=3,
        )
    on = sorted((cost.value(p), 100 * p["test"]["accuracy"]) for p in points if p["front"][name])
    axes.plot(
        [spent for spent, _ in on],
        [right for _, right in on],
        color="0.25",
        linewidth=1.0,
        linestyle=(0, (5, 2)),
        drawstyle="steps-post",
        label="front on the test split",
        zorder=2,
    )
    _float_line(axes, report)
    _taken(axes, report, cost)
    axes.set_xscale("log")
    _ticks(axes, [cost.value(point) for point in points], cost)
    axes.set_xlabel(cost.axis)
    axes.grid(alpha=0.25)
    axes.margins(0.06, 0.08)


def _float_line(axes: Axes, report: Json) -> None:
    network = max(by_chip(report["networks"], report["target"])[0], key=lambda net: net["expected"])
    found = network["float"][max(network["float"], key=int)]["test"]
    axes.axhline(
        100 * found["accuracy"],
        color="0.45",
        linewidth=0.9,
        linestyle=":",
        label=f"float model of {network['name']}",
        zorder=1,
    )


def _taken(axes: Axes, report: Json, cost: Cost) -> None:
    """Rings and intervals of the points to take; their names in turn above and below, where there are no marks."""
    points = {point["number"]: point for point in report["points"]}
    for place, (number, names) in enumerate(taken_points(report).items()):
        test = points[number]["test"]
        x, y, low, high = cost.value(points[number]), *(100 * test[name] for name in ("accuracy", "low", "high"))
        axes.plot([x, x], [low, high], color="0.15", linewidth=0.9, zorder=2)
        axes.scatter([x], [y], s=150, facecolors="none", edgecolors="black", linewidths=1.2, zorder=4)
        axes.annotate(
            f"#{number} {names}",
            (x, low if place % 2 else high),
            xytext=(0, -11 if place % 2 else 4),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            fontweight="bold",
            zorder=5,
        )


def _ticks(axes: Axes, values: Sequence[float], cost: Cost) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    positive = [math.log10(value) for value in values if value > 0] or [0.0]
    axes.xaxis.set_major_locator(FixedLocator(log_ticks(min(positive) - 0.1, max(positive) + 0.1)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: cost.said(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
