"""Figures of the page that are of one kind: confusion matrices, cores on the mesh, taxels on the fingertip."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from spikeloom.runtime.page.text import sender
from spikeloom.runtime.report.svg import LETTER, WIDTH, drawing, legend, shape, words

Json = dict[str, Any]

SIDES = {"float": "float model", "chip": "chip"}


# -- decisions ---------------------------------------------------------------------------------------------------------


def confusion(decisions: Json) -> str:
    """Both matrices side by side: rows are labels, columns decisions."""
    classes, size = decisions["classes"], 410.0
    cell = size / classes
    every = next((step for step in (1, 5, 10, 50) if classes <= 12 * step), 100)
    content = []
    for panel, (side, name) in enumerate(SIDES.items()):
        left, top = 56.0 + panel * (size + 68), 44.0
        content.append(words(left + size / 2, 14, f"{name}: decided as", "strong", "middle"))
        content.append(shape("rect", "frame", x=left, y=top, width=size, height=size))
        for k in range(0, classes, every):
            at = (k + 0.5) * cell
            content += [
                words(left + at, top - 8, str(k), "small", "middle"),
                words(left - 6, top + at + 4, str(k), "small", "end"),
            ]
        for label, row in enumerate(decisions["matrices"][side]):
            for decided, count in enumerate(row):
                if count:
                    content.append(_cell(name, label, decided, count, sum(row), (left, top, cell)))
    content.append(words(14, 44 + size / 2, "label", "strong", "middle", upwards=True))
    return drawing("confusion", "Confusion matrices of the float model and of the chip", 44 + size + 8, content)


def _cell(side: str, label: int, decided: int, count: int, total: int, at: tuple[float, float, float]) -> str:
    left, top, cell = at
    tip = f"{side}: label {label} decided as {decided}, {count} of {total}"
    x, y = left + decided * cell, top + label * cell
    style = "right" if label == decided else "wrong"
    box = shape("rect", style, tip, x=x, y=y, width=cell, height=cell, fill_opacity=f"{0.2 + 0.35 * count / total:.2f}")
    size = min(13.0, cell * 0.85)
    return box + words(x + cell / 2, y + cell / 2 + 0.36 * size, str(count), "in-cell", "middle", size=size)


# -- cores -------------------------------------------------------------------------------------------------------------

MARGIN = 16.0
INPUT = 46.0
"""Width of the input's bar at the left."""

DRAWN = 80
"""Connections that are drawn, the busiest first; the table has all."""


def core_map(cores: Json) -> str:
    """Used part of each chip's mesh: tiles, their cores, how full the fullest limit is, and who sends how much."""
    places, height, content = _places(cores)
    for core in cores["cores"]:
        content.append(_core(core, places[core["core"]]))
    ways = sorted((way for way in cores["traffic"] if way["packets"] > 0), key=lambda way: -way["packets"])
    most = ways[0]["packets"] if ways else 1.0
    content.append(shape("rect", "input", x=0, y=24, width=INPUT - 16, height=height - 24, rx=4))
    middle = (INPUT - 16) / 2, height / 2 + 12
    content.append(words(*middle, "input", "strong", "middle", upwards=True))
    content += [_way(way, places, most, height) for way in ways[:DRAWN]]
    content += [_name(core, places[core["core"]]) for core in cores["cores"]]
    names = {"w-in": "packets from the input", "w-core": "packets between cores (arrow: direction; width: amount)"}
    content.append(legend(names, INPUT, 12))
    return drawing("cores", "Cores on the mesh, how full they are and the packets between them", height, content)


Box = tuple[float, float, float, float]


def _places(cores: Json) -> tuple[dict[int, Box], float, list[str]]:
    """Box of each core, height of the figure, and the tiles, chip after chip from top to bottom."""
    places: dict[int, Box] = {}
    content: list[str] = []
    top, fullest = 24.0, max(Counter(core["tile"] for core in cores["cores"]).values())
    columns = min(fullest, 2)
    rows = -(-fullest // columns)
    chips = sorted({core["chip"] for core in cores["cores"]})
    for chip in chips:
        held = [core for core in cores["cores"] if core["chip"] == chip]
        x0, y0 = (min(core[axis] for core in held) for axis in "xy")
        across, down = (max(core[axis] for core in held) - first + 1 for axis, first in (("x", x0), ("y", y0)))
        wide = min((WIDTH - INPUT) / across, 440.0)
        high = min(max(wide * 0.62, 100.0), 130.0 * rows)
        if len(chips) > 1:
            content.append(words(INPUT, top + 12, f"chip {chip}", "small strong"))
            top += 18
        for tile, x, y in sorted({(core["tile"], core["x"], core["y"]) for core in held}):
            left, upper = INPUT + (x - x0) * wide, top + (y - y0) * high
            content.append(shape("rect", "tile", x=left, y=upper, width=wide - MARGIN, height=high - MARGIN, rx=6))
            place = f"tile {tile} (x {x}, y {y})"
            content.append(words(left + 8, upper + 15, place if wide > 180 else f"tile {tile}", "small"))
            inner = (wide - MARGIN - 8) / columns, (high - MARGIN - 24) / rows
            for slot, core in enumerate(core for core in held if core["tile"] == tile):
                row, column = divmod(slot, columns)
                at = left + 8 + column * inner[0], upper + 22 + row * inner[1]
                places[core["core"]] = (*at, inner[0] - 8, inner[1] - 6)
        top += down * high
    return places, top, content


def _core(core: Json, box: Box) -> str:
    x, y, wide, high = box
    full = core["fill"][core["fullest"]]
    limits = ", ".join(f"{name} {100 * use['share']:.0f} %" for name, use in core["fill"].items())
    tip = f"core {core['core']}, {' '.join(core['layers'])}, {core['compartments']:,} compartments; {limits}"
    level = high * min(full["share"], 1.0)
    return "".join(
        [
            shape("rect", "core", tip, x=x, y=y, width=wide, height=high, rx=3),
            shape("rect", "fill", x=x, y=y + high - level, width=wide, height=level, rx=3),
        ]
    )


def _name(core: Json, box: Box) -> str:
    """What a core is, as far as its box has room; it lies over the lines."""
    x, y, wide, _ = box
    full = core["fill"][core["fullest"]]
    named = core["fullest"].removeprefix("core.").replace("_", " ")
    lines = [f"core {core['core']}: {' '.join(core['layers'])}", f"{100 * full['share']:.0f} % of {named}"]
    if wide < LETTER * len(lines[0]):
        lines = [str(core["core"])]
    lines = [line for line in lines if wide >= LETTER * len(line)]
    return "".join(
        words(x + 6, y + 14 + 14 * i, line, "over small" if i else "over small strong") for i, line in enumerate(lines)
    )


def _way(way: Json, places: dict[int, Box], most: float, height: float) -> str:
    """A bent line; those back are bent to the other side."""
    tip = f"{sender(way)} to core {way['to']}: {way['packets']:,.0f} packets in a mean recording"
    tip += "" if way["hops"] is None else f", {way['hops']} hops"
    share = math.sqrt(way["packets"] / most)
    x2, y2 = _port(places[way["to"]], 0.62)
    if way["from"] is None:
        x1, y1 = INPUT - 16, min(max(y2, 40.0), height - 10)
        x2 = places[way["to"]][0] if abs(x2 - x1) < 200 else x2
    elif way["from"] == way["to"]:
        x, y = _port(places[way["to"]], 0.5)
        return shape("circle", "way w-core", tip, cx=x, cy=y, r=9, stroke_width=1 + 5 * share)
    else:
        x1, y1 = _port(places[way["from"]], 0.38)
    bend_x, bend_y = (x1 + x2) / 2 - 0.14 * (y2 - y1), (y1 + y2) / 2 + 0.14 * (x2 - x1)
    along = math.atan2(y2 - bend_y, x2 - bend_x)
    size = 5 + 4 * share
    wings = [(x2 - size * math.cos(along + turn), y2 - size * math.sin(along + turn)) for turn in (0.45, -0.45)]
    arrow = f"M{wings[0][0]:.1f} {wings[0][1]:.1f}L{x2:.1f} {y2:.1f}L{wings[1][0]:.1f} {wings[1][1]:.1f}"
    path = f"M{x1:.1f} {y1:.1f}Q{bend_x:.1f} {bend_y:.1f} {x2:.1f} {y2:.1f}{arrow}"
    return shape("path", "way w-in" if way["from"] is None else "way w-core", tip, d=path, stroke_width=1 + 5 * share)


def _port(box: Box, along: float) -> tuple[float, float]:
    x, y, wide, high = box
    return x + wide * along, y + high * 0.7


# -- taxels ------------------------------------------------------------------------------------------------------------

DETAILED = 1000
"""Taxels up to which their graph is drawn and each tells its values."""

FINGER = 400.0
"""Most width and height of a fingertip."""


def fingertip(taxels: Json) -> str:
    """Taxels where they lie, joined as the graph joins them; discs grow with events, and with first-layer spikes."""
    n = len(taxels["events"])
    points = taxels["positions_mm"] or [
        [math.cos(2 * math.pi * i / n - math.pi / 2), math.sin(2 * math.pi * i / n - math.pi / 2)] for i in range(n)
    ]
    low = [min(point[axis] for point in points) for axis in (0, 1)]
    span = [max(point[axis] for point in points) - low[axis] for axis in (0, 1)]
    scale = (FINGER - 60) / max(*span, 1e-9)
    wide, high = (side * scale + 60 for side in span)
    places = [(30 + (x - low[0]) * scale, high - 30 - (y - low[1]) * scale) for x, y in points]
    reach = _reach(places)
    panels = {"input events": taxels["events"]}
    if taxels["spikes"] is not None:
        panels[f"{taxels['layer']} spikes on the chip"] = taxels["spikes"]
    content = []
    for number, (name, values) in enumerate(panels.items()):
        left = (number + 0.5) * WIDTH / len(panels) - wide / 2
        content.append(words(left + wide / 2, 14, f"{name}, mean recording", "strong", "middle"))
        content.append(f'<g transform="translate({left:.1f} 24)">')
        content.append(_skin(wide, high) if taxels["positions_mm"] else "")
        for a, b in sorted({(min(pair), max(pair)) for pair in taxels["edges"]}) if n <= DETAILED else ():
            (x1, y1), (x2, y2) = places[a], places[b]
            content.append(shape("line", "edge", x1=x1, y1=y1, x2=x2, y2=y2))
        most = max(values) or 1.0
        for taxel, ((x, y), value) in enumerate(zip(places, values, strict=True)):
            tip = f"taxel {taxel}: {value:,.1f} {name} in a mean recording" if n <= DETAILED else ""
            radius = reach * (0.25 + 0.75 * math.sqrt(value / most))
            content.append(
                shape("circle", "taxel", tip, cx=x, cy=y, r=radius, fill_opacity=f"{0.2 + 0.4 * value / most:.2f}")
            )
            content.append(words(x, y + 3.5, str(taxel), "number", "middle") if reach > LETTER else "")
        content.append("</g>")
    return drawing("taxels", "Taxels, the graph over them and their activity", high + 34, content)


def _reach(places: list[tuple[float, float]]) -> float:
    """Largest radius of discs that keep apart."""
    from scipy.spatial import KDTree  # a tenth of a second that other commands need not wait

    nearest = KDTree(places).query(places, k=2)[0][:, 1].min() if len(places) > 1 else math.inf
    return float(min(max(nearest * 0.52, 1.0), 22.0))


def _skin(wide: float, high: float) -> str:
    """Outline of the fingertip's pad."""
    return shape("rect", "skin", x=1, y=1, width=wide - 2, height=high - 2, rx=wide * 0.42, ry=min(wide, high) * 0.42)
