"""A chart's figure as inline SVG: test accuracy over a cost, one mark a point, the front, and the points to take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from spikeloom.models.recordings.counts import number as counted
from spikeloom.runtime.report import svg
from spikeloom.runtime.report.tables import si
from spikeloom.runtime.studies.chart.costs import Cost, costs_of
from spikeloom.runtime.studies.chart.points import by_chip
from spikeloom.runtime.studies.chart.text import NAMES, label

Json = dict[str, Any]

SERIES = 8
"""Colours and shapes, each pair its own; more series begin again, with hollow marks."""

LEFT, TOP, RIGHT, BOTTOM = 62.0, 22.0, svg.WIDTH - 16.0, 380.0

SMALLEST, LARGEST = 4.2, 6.6
"""Size of marks, by the part of the recording that has passed."""

Shape = tuple[tuple[float, float], ...]

PLUS: Shape = (
    *((-0.4, -1.1), (0.4, -1.1), (0.4, -0.4), (1.1, -0.4), (1.1, 0.4), (0.4, 0.4)),
    *((0.4, 1.1), (-0.4, 1.1), (-0.4, 0.4), (-1.1, 0.4), (-1.1, -0.4), (-0.4, -0.4)),
)

SHAPES: tuple[Shape, ...] = (
    (),  # a circle
    ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    ((0, -1.15), (1.05, 0.8), (-1.05, 0.8)),
    ((0, -1.25), (1.25, 0), (0, 1.25), (-1.25, 0)),
    ((0, 1.15), (1.05, -0.8), (-1.05, -0.8)),
    PLUS,
    ((-1.15, 0), (0.8, -1.05), (0.8, 1.05)),
    ((1.15, 0), (-0.8, -1.05), (-0.8, 1.05)),
)
"""Corners of marks, in units of their size: circle, square, triangles, diamond, plus."""


def series_of(points: Sequence[Json]) -> tuple[str, list[str]]:
    """Which axis the colours and shapes are for, and its values: networks where there are several.

    Examples
    --------
    >>> series_of([{"network": "a", "storage": "4b"}, {"network": "a", "storage": "8b"}])
    ('storage', ['4b', '8b'])
    """
    for axis in ("network", "storage", "cores", "window"):
        values = list(dict.fromkeys(str(point.get(axis)) for point in points))
        if len(values) > 1:
            return axis, values
    return "network", [str(points[0]["network"])]


def tip(point: Json, report: Json) -> str:
    """What is said of a point."""
    test = point["test"]
    costs = [f"{si(joule, 'J')} ({name})" for name, joule in test["energy_j"].items()]
    costs += [f"{si(seconds, 's')} ({name})" for name, seconds in test["time_s"].items()]
    right = f"test {100 * test['accuracy']:.2f} % ({100 * test['low']:.1f} … {100 * test['high']:.1f})"
    right += f", float {100 * test['float']['accuracy']:.2f} %, expected {100 * point['expected']:.2f} %"
    equal = f"{test['equal']} of {report['data']['test']} decisions equal"
    size = f"{test['synaptic_operations']:,.0f} synaptic operations, {counted(point['n_cores'], 'core')}"
    return f"#{point['number']} {label(point)}: {right}, {equal}, {', '.join(costs)}, {size}"


def scatter(report: Json, cost: str, *, prefix: str = "chart") -> str:
    """Accuracy over one cost, on a logarithmic axis.

    Parameters
    ----------
    report : dict
        A chart.
    cost : str
        Name of one of its axes, see :func:`costs.costs_of`.
    prefix : str
        Of the figure's id.
    """
    over = costs_of(report, measured=True)[cost]
    points = report["points"]
    values = [over.value(point) for point in points]
    frame = _frame(report, values)
    axis, names = series_of(points)
    content = [_legend(names), *_axes(frame, over), *_float(report, frame)]
    on = sorted(
        (v, p["test"]["accuracy"]) for v, p in zip(values, points, strict=True) if p["front"].get(cost) and v > 0
    )
    if len(on) > 1:
        content.append(_stairs([(frame.x(math.log10(v)), frame.y(100 * a)) for v, a in on]))
    taken = {number for number in report["recommended"].values() if number is not None}
    for point, value in zip(points, values, strict=True):
        if value > 0:
            x, y = frame.x(math.log10(value)), frame.y(100 * point["test"]["accuracy"])
            if point["number"] in taken:
                low, high = (frame.y(100 * point["test"][end]) for end in ("low", "high"))
                content.append(svg.shape("line", "whisker", x1=x, y1=low, x2=x, y2=high))
                content.append(svg.shape("circle", "taken", cx=x, cy=y, r=LARGEST + 5))
            content.append(_mark(point, x, y, names.index(str(point[axis])), tip(point, report)))
    content += _names(report, frame, over)
    return svg.drawing(f"{prefix}-{cost}", f"Test accuracy over {over.title}", BOTTOM + 42, content)


def _stairs(corners: Sequence[tuple[float, float]]) -> str:
    """A front: between two of its points nothing better than the cheaper one is to be had."""
    path = [corners[0]]
    for x, y in corners[1:]:
        path += [(x, path[-1][1]), (x, y)]
    points = " ".join(f"{svg.number(x)},{svg.number(y)}" for x, y in path)
    return svg.shape("polyline", "line front", points=points)


def _frame(report: Json, values: Sequence[float]) -> svg.Frame:
    positive = [math.log10(value) for value in values if value > 0] or [0.0]
    taken = taken_points(report)
    shares = [100 * point["test"]["accuracy"] for point in report["points"]]
    shares += [100 * p["test"][end] for p in report["points"] if p["number"] in taken for end in ("low", "high")]
    shares += [100 * net["float"][max(net["float"], key=int)]["test"]["accuracy"] for net in report["networks"]]
    room = max(0.08, 0.05 * (max(positive) - min(positive)))
    low, high = min(shares), max(shares)
    reach = max(2.5, 0.07 * (high - low))
    return svg.Frame(
        left=LEFT,
        top=TOP + 14,
        right=RIGHT,
        bottom=BOTTOM,
        x_from=min(positive) - room,
        x_to=max(positive) + room,
        y_from=max(0.0, low - reach),
        y_to=min(100.0, high + reach),
    )


def _axes(frame: svg.Frame, over: Cost) -> list[str]:
    content = []
    for value in svg.ticks(frame.y_from, frame.y_to, 6):
        y = frame.y(value)
        content.append(svg.shape("line", "grid", x1=frame.left, y1=y, x2=frame.right, y2=y))
        content.append(svg.words(frame.left - 6, y + 4, f"{value:g} %", "small", "end"))
    for value in log_ticks(frame.x_from, frame.x_to):
        x = frame.x(math.log10(value))
        content.append(svg.shape("line", "grid", x1=x, y1=frame.top, x2=x, y2=frame.bottom))
        content.append(svg.words(x, frame.bottom + 16, over.said(value), "small", "middle"))
    content.append(svg.shape("line", "axis", x1=frame.left, y1=frame.bottom, x2=frame.right, y2=frame.bottom))
    content.append(svg.words((frame.left + frame.right) / 2, frame.bottom + 34, over.axis, "small", "middle"))
    return content


def log_ticks(low: float, high: float) -> list[float]:
    """Numbers 1, 2, 5 times a power of ten between two logarithms; powers of ten alone over three decades.

    Examples
    --------
    >>> log_ticks(-4.1, -3.2)
    [0.0001, 0.0002, 0.0005]
    """
    digits = (1, 2, 5) if high - low < 3 else (1,)
    powers = range(math.floor(low), math.ceil(high) + 1)
    found = [float(f"{digit}e{power}") for power in powers for digit in digits]
    inside = [value for value in found if low <= math.log10(value) <= high]
    return inside if len(inside) > 1 else [10**low, 10**high]


def _float(report: Json, frame: svg.Frame) -> list[str]:
    """The float model of the network with the highest expectation, on whole recordings."""
    network = max(by_chip(report["networks"], report["target"])[0], key=lambda net: net["expected"])
    found = network["float"][max(network["float"], key=int)]["test"]
    y = frame.y(100 * found["accuracy"])
    text = f"float model of {network['name']}: {100 * found['accuracy']:.2f} %"
    line = svg.shape("line", "float-line", x1=frame.left, y1=y, x2=frame.right, y2=y)
    return [line, svg.words(frame.left + 6, y - 5, text, "small over")]


def _mark(point: Json, x: float, y: float, series: int, said: str) -> str:
    size = SMALLEST + (LARGEST - SMALLEST) * point["window"] / 100
    style = f"mark c{series % SERIES}{' hollow' if series // SERIES % 2 else ''}"
    return _shape(SHAPES[series % SERIES], x, y, size, style, said, point["number"])


def _shape(corners: Shape, x: float, y: float, size: float, style: str, said: str, number: int | None) -> str:
    own = {} if number is None else {"data_n": str(number)}
    if not corners:
        return svg.shape("circle", style, said, cx=x, cy=y, r=size, **own)
    path = " ".join(f"{svg.number(x + size * dx)},{svg.number(y + size * dy)}" for dx, dy in corners)
    return svg.shape("polygon", style, said, points=path, **own)


def _legend(names: Sequence[str]) -> str:
    parts, x, y = [], LEFT, 12.0
    for index, name in enumerate(names[: 2 * SERIES]):
        wide = 20 + svg.LETTER * len(name) + 16
        if x + wide > RIGHT and index:
            break
        hollow = " hollow" if index // SERIES % 2 else ""
        style = f"mark c{index % SERIES}{hollow}"
        parts += [
            _shape(SHAPES[index % SERIES], x + 7, y - 4, 5.5, style, "", None),
            svg.words(x + 18, y, name, "small"),
        ]
        x += wide
    return "".join(parts)


def taken_points(report: Json) -> dict[int, str]:
    """Points to take by number, with what for: ``best``, or ``cheapest, best``."""
    said: dict[int, list[str]] = {}
    for name, number in report["recommended"].items():
        if number is not None:
            said.setdefault(number, []).append(NAMES[name].partition(" within")[0])
    return {number: ", ".join(names) for number, names in said.items()}


def _names(report: Json, frame: svg.Frame, over: Cost) -> list[str]:
    """Names of the points to take, in turn above and below their intervals, where there are no marks."""
    points = {point["number"]: point for point in report["points"]}
    content = []
    for place, (number, names) in enumerate(taken_points(report).items()):
        test = points[number]["test"]
        value = over.value(points[number])
        if value > 0:
            x = frame.x(math.log10(value))
            y = frame.y(100 * test["low"]) + 13 if place % 2 else frame.y(100 * test["high"]) - 5
            wide = svg.LETTER * len(f"#{number} {names}") / 2
            x = min(max(x, frame.left + wide), frame.right - wide)
            content.append(svg.words(x, y, f"#{number} {names}", "over strong", "middle"))
    return content
