"""Where it breaks, on the page of ``report``: the curves of ``stress``, its verdicts and reasons."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError
from spikeloom.runtime.report.intervals import wilson
from spikeloom.runtime.report.markup import figure, paragraph, table, unfold
from spikeloom.runtime.report.svg import WIDTH, Frame, drawing, legend, number, shape, words
from spikeloom.runtime.studies.stress.text import CURVE_ROWS, KEY, VERDICT_HEAD, curve_cells, verdict_rows
from spikeloom.runtime.studies.stress.verdicts import SIDES, shown

Json = dict[str, Any]

KEYS = {"recordings", "classes", "seeds", "clean", "perturbations", "not_applicable", "provenance"}

ACROSS = 4
HIGH = 178.0
"""Of a panel with its title and levels, in the figure's units."""

LABELS = 6
"""Levels that are named below a panel at most."""

SHIFT = 0.07
"""Steps between the marks of the two sides."""


def read_stress(path: str, netlist: str, sha256: str) -> Json:
    """Read what ``stress -o`` wrote about a netlist of this name and hash.

    Raises
    ------
    DataError
        If the file is not there, something else, or about another netlist.
    """
    place = Path(path)
    if not place.is_file():
        raise DataError(f"--stress {path}: no such file; write it with spikeloom stress -o")
    try:
        found = json.loads(place.read_bytes())
    except ValueError:
        found = None
    if not isinstance(found, dict) or not found.keys() >= KEYS:
        raise DataError(f"--stress {path}: is not what spikeloom stress -o writes; give such a file")
    about = found["provenance"]["netlist_sha256"]
    if about != sha256:
        raise DataError(
            f"--stress {path}: is about a netlist of sha256 {about[:12]}…, {netlist} has {sha256[:12]}…; "
            "stress that one, or report the other"
        )
    return found


def stability(report: Json) -> list[str]:
    """Verdicts, curves, and the numbers behind them."""
    found = report["stress"]
    curves = found["perturbations"]
    clean = {side: count / found["recordings"] for side, count in found["clean"]["right"].items()}
    skipped = [paragraph(f"{name}: not measured, {why}.") for name, why in found["not_applicable"].items()]
    numbers = [
        table(f"{name}: {one['what']} ({one['unit']})", ["", *_labels(one)], curve_cells(one["levels"]))
        for name, one in curves.items()
    ]
    return [
        paragraph(
            f"{len(curves)} perturbations on {found['recordings']} recordings, {found['seeds']} seeds of each that is "
            f"left to chance. Without any, the float model decides {100 * clean['float']:.1f} % right, the chip "
            f"{100 * clean['chip']:.1f} %."
        ),
        table("Where they break and why", VERDICT_HEAD, verdict_rows(curves), left=True),
        paragraph(f"{KEY.splitlines()[0]}."),
        figure(
            panels(found),
            "Accuracy over the level of each perturbation, from mild to harsh, with 95 % intervals. Grey: interval of "
            "the clean accuracy on the chip; dotted: chance; vertical lines: where the mean leaves the clean interval.",
            unfold("Every curve", "".join([paragraph(f"Rows: {', '.join(CURVE_ROWS)}, in per cent."), *numbers])),
        ),
        *skipped,
    ]


def _labels(one: Json) -> list[str]:
    return [shown(point["level"]) for point in one["levels"]]


def panels(found: Json) -> str:
    """All curves as one figure."""
    curves = found["perturbations"]
    wide = WIDTH / ACROSS
    content = [legend({"l-float": "float model", "l-chip": "chip"}, 50, 14, strokes=True)]
    for place, (name, one) in enumerate(curves.items()):
        row, column = divmod(place, ACROSS)
        content += _panel(name, one, found, column * wide, 26 + row * HIGH)
    return drawing("stress", "Accuracy under each perturbation", 26 + -(-len(curves) // ACROSS) * HIGH, content)


def _panel(name: str, one: Json, found: Json, left: float, top: float) -> list[str]:
    points = one["levels"]
    frame = Frame(
        left=left + 34,
        top=top + 20,
        right=left + WIDTH / ACROSS - 8,
        bottom=top + HIGH - 44,
        x_from=-0.5,
        x_to=len(points) - 0.5,
        y_from=0,
        y_to=100,
    )
    low, high = (100 * bound for bound in wilson(found["clean"]["right"]["chip"], found["recordings"]))
    width = frame.right - frame.left
    content = [
        words((frame.left + frame.right) / 2, top + 13, f"{name}: {one['verdict']}", "small", "middle"),
        shape("rect", "clean", x=frame.left, y=frame.y(high), width=width, height=frame.y(low) - frame.y(high)),
        _rule("theta", frame, frame.y(100 / found["classes"])),
        shape("rect", "frame", x=frame.left, y=frame.top, width=width, height=frame.bottom - frame.top),
    ]
    content += [words(frame.left - 4, frame.y(value) + 4, str(value), "small", "end") for value in (0, 50, 100)]
    every = -(-len(points) // LABELS)
    for place, label in list(enumerate(_labels(one)))[::every]:
        content.append(words(frame.x(place), frame.bottom + 14, label, "small", "middle"))
    content.append(words((frame.left + frame.right) / 2, frame.bottom + 28, one["unit"], "small", "middle"))
    for side, shift in zip(SIDES, (-SHIFT, SHIFT), strict=True):
        content += _side(side, shift, name, one, frame)
    return content


def _rule(style: str, frame: Frame, y: float) -> str:
    return shape("line", style, x1=frame.left, y1=y, x2=frame.right, y2=y)


def _side(side: str, shift: float, name: str, one: Json, frame: Frame) -> list[str]:
    """Curve, intervals and marks of one side, and where it leaves."""
    points = one["levels"]
    at = [(frame.x(place + shift), point[side]) for place, point in enumerate(points)]
    content = [
        shape("line", f"l-{side}", x1=x, y1=frame.y(100 * p["low"]), x2=x, y2=frame.y(100 * p["high"])) for x, p in at
    ]
    joined = " ".join(f"{number(x)},{number(frame.y(100 * p['mean']))}" for x, p in at)
    content.append(shape("polyline", f"line l-{side}", points=joined))
    leaves = one["breaks"][side]["leaves"]
    if leaves is not None:
        x = frame.x([point["level"] for point in points].index(leaves) + 2 * shift)
        content.append(shape("line", f"l-{side}", x1=x, y1=frame.top, x2=x, y2=frame.bottom, stroke_opacity="0.5"))
    for (x, p), label in zip(at, _labels(one), strict=True):
        y = frame.y(100 * p["mean"])
        tip = f"{name} {label}, {side}: {100 * p['mean']:.1f} % ({100 * p['low']:.1f} … {100 * p['high']:.1f})"
        if side == "float":
            content.append(shape("circle", f"k-{side}", tip, cx=x, cy=y, r=3))
        else:
            content.append(shape("rect", f"k-{side}", tip, x=x - 2.8, y=y - 2.8, width=5.6, height=5.6))
    return content
