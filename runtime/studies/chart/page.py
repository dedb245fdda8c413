"""A chart as a page: one HTML file that needs nothing else, with filters, and the commands behind every point."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from typing import Any

from spikeloom.runtime.report.markup import facts, figure, paragraph, section, table, unfold
from spikeloom.runtime.report.tables import percent, si
from spikeloom.runtime.studies.chart.costs import costs_of
from spikeloom.runtime.studies.chart.figure import scatter, tip
from spikeloom.runtime.studies.chart.points import by_chip
from spikeloom.runtime.studies.chart.text import NAMES, budget_lines, figures, head, label, saving_lines

Json = dict[str, Any]

AXES = {
    "network": "network",
    "graph": "graph",
    "storage": "storage",
    "cores": "layout",
    "window": "part of the recording",
}
"""Axes that the page filters by, in words; ``storage`` is bits, planes, groups and pruning together."""

MEANINGS = (
    "Expected: what the training reached on recordings that it left out, times the share of training accuracy that the "
    "point keeps; choices are made by this alone.",
    "Front: no other point is right more often on the test split for the same cost. It describes, nothing is chosen by "
    "it.",
    "Storage: bits of a weight (b), times that a synapse is stored (p), scales in a layer (g).",
)


BESIDE = (
    "Points of another chip stand at their own prices, named in brackets; fronts and choices leave them out, since "
    "prices of two chips hold different things."
)


def chart_page(report: Json) -> str:
    """The whole page.

    Parameters
    ----------
    report : dict
        What ``chart --json`` prints.
    """
    data = report["data"]["path"].rstrip("/").rsplit("/", 1)[-1]
    title = f"{len(report['points'])} configurations on {data}"
    sections = {
        "take": ("Which one to deploy", _take(report)),
        "chart": ("Accuracy against cost", _chart(report)),
        "points": ("Every point", _points(report)),
        "networks": ("Networks", _networks(report)),
        "provenance": ("Provenance", _provenance(report)),
    }
    body = "".join(section(name, heading, content) for name, (heading, content) in sections.items())
    links = "".join(f'<li><a href="#{name}">{escape(heading)}</a></li>' for name, (heading, _) in sections.items())
    page, files = resources.files("spikeloom.runtime.page"), resources.files("spikeloom.runtime.studies.chart")
    style = "".join(sheet.read_text("utf-8") for sheet in (page / "report.css", files / "chart.css"))
    script = files.joinpath("chart.js").read_text("utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} – spikeloom</title>\n<style>\n{style}</style></head>\n<body>"
        '<a class="skip" href="#take">To the recommended points</a>'
        f"<header><h1>{escape(title)}</h1>"
        '<p class="hint">Point at a mark, or move to a figure with Tab and press arrow keys, to read its figures; a '
        "click or Enter keeps a point and shows the commands that make it.</p>"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav></header>\n<main>{body}</main>\n'
        f"<footer><p>Made by spikeloom {escape(report['spikeloom'])}; this page loads nothing.</p></footer>"
        f'\n<script type="application/json" id="data">{_data(report)}</script>'
        f"\n<script>\n{script}</script></body></html>\n"
    )


def chart_section(report: Json) -> list[str]:
    """A chart as a part of another page: figures, the points to take, and the commands that make them."""
    return [*_figures(report, "pareto"), *_taken(report), *(paragraph(line) for line in saving_lines(report))]


def _data(report: Json) -> str:
    """What the page's script knows of each point; no letter in it can end the element."""
    points = {
        str(point["number"]): {
            "axes": {axis: str(point[axis]) for axis in AXES},
            "tip": tip(point, report),
            "commands": point["commands"],
        }
        for point in report["points"]
    }
    return json.dumps(points, separators=(",", ":")).replace("<", "\\u003c")


# -- sections ----------------------------------------------------------------------------------------------------------


def _take(report: Json) -> list[str]:
    points = {point["number"]: point for point in report["points"]}
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    cards = {}
    for name, number in report["recommended"].items():
        if number is None:
            cards[NAMES[name]] = "none", "no point is good enough"
            continue
        test = points[number]["test"]
        costs = [si(test["energy_j"][energy], "J"), *([] if time is None else [si(test["time_s"][time], "s")])]
        cards[NAMES[name]] = f"#{number}: {', '.join(costs)}", f"test accuracy {100 * test['accuracy']:.2f} %"
    parts = [facts(cards), paragraph(f"Chosen on the training split by what is expected: {report['expected']}.")]
    parts += _taken(report)
    saved = saving_lines(report)
    parts += ["<h3>Less energy than the usual mapping</h3>", *(paragraph(line.strip()) for line in saved)]
    if report["budget"] is not None:
        first, *_ = budget_lines(report)
        point = points[report["budget"]["point"]]
        parts += ["<h3>Your budget</h3>", paragraph(first), *_commands([point])]
    return parts


def _taken(report: Json) -> list[str]:
    """Recommended points with their figures and commands."""
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    points = {point["number"]: point for point in report["points"]}
    rows = [
        [NAMES[name], f"#{number}", label(points[number]), *figures(points[number], energy, time)]
        for name, number in report["recommended"].items()
        if number is not None
    ]
    found = dict.fromkeys(number for number in report["recommended"].values() if number is not None)
    made = [table("Recommended points; test figures beside", ["", *head(energy, time)], rows)]
    return [*made, *_commands(points[number] for number in found)]


def _commands(points: Iterable[Json]) -> list[str]:
    return [
        f"<p>For #{point['number']}:</p><pre><code>{escape(chr(10).join(point['commands']))}</code></pre>"
        for point in points
    ]


def _chart(report: Json) -> list[str]:
    chosen = '<div id="chosen" class="chosen" aria-live="polite"></div>'
    return [
        _filters(report),
        _axis(report),
        *_figures(report, "chart", measured=True),
        chosen,
        *(paragraph(line) for line in MEANINGS),
        *([paragraph(BESIDE)] if by_chip(report["points"], report["target"])[1] else []),
    ]


def _figures(report: Json, prefix: str, *, measured: bool = False) -> list[str]:
    return [
        figure(
            scatter(report, name, prefix=prefix),
            f"Test accuracy over {cost.title}. {'' if name == 'speed' else 'Dashed: the front. '}Rings and lines: "
            "recommended points and their 95 % intervals. Larger marks have seen more of each recording.",
            raster=f"{prefix}-{name}" if measured else None,
        )
        for name, cost in costs_of(report, measured=measured).items()
    ]


def _axis(report: Json) -> str:
    """A choice of the figure that is shown; without scripts all of them are."""
    options = "".join(
        f'<option value="chart-{name}">{escape(cost.title)}</option>'
        for name, cost in costs_of(report, measured=True).items()
    )
    return f'<label class="choose">Accuracy against <select id="axis">{options}</select></label>'


def _filters(report: Json) -> str:
    """Check boxes for every axis of several values."""
    parts = []
    for axis, words in AXES.items():
        values = list(dict.fromkeys(str(point[axis]) for point in report["points"]))
        if len(values) < 2:
            continue
        boxes = "".join(
            f'<label><input type="checkbox" checked data-axis="{axis}" value="{escape(value)}"> '
            f"{escape(value)}{'&nbsp;%' if axis == 'window' else ''}</label>"
            for value in values
        )
        parts.append(f"<fieldset><legend>{escape(words)}</legend>{boxes}</fieldset>")
    if not parts:
        return ""
    shown = f'<output id="shown">{len(report["points"])} points</output>'
    return f'<div class="filters" role="group" aria-label="Filters">{"".join(parts)}{shown}</div>'


def _points(report: Json) -> list[str]:
    """Every point as a row; a button in it shows its commands."""
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    above = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in [*head(energy, time), "recordings/s, measured"])
    rates = report["measured"]["recordings_per_s"]
    rows = []
    for point in report["points"]:
        number = point["number"]
        cells = [label(point), *figures(point, energy, time), f"{rates[str(number)]:,.0f}"]
        first = f'<th scope="row"><button type="button" data-n="{number}">#{number}</button></th>'
        rows.append(f'<tr data-n="{number}">{first}{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>')
    made = (
        f'<div class="table"><table><caption>{len(report["points"])} points; the last column is measured on the '
        f"machine that charts</caption><thead><tr>{above}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )
    commands = unfold("Commands of every point", "".join(_commands(report["points"])))
    return [made, commands, *_refused(report["refused"])]


def _refused(refused: Sequence[Json]) -> list[str]:
    if not refused:
        return []
    rows = [[f"{each['network']} {each['storage']}, {each['cores']}", each["why"][0]] for each in refused]
    return [table("Configurations that the chip refuses", ["configuration", "why"], rows, left=True)]


def _networks(report: Json) -> list[str]:
    rows = []
    for network in report["networks"]:
        longest = max(network["float"], key=int)
        test = network["float"][longest]["test"]
        validation = network["validation"]
        rows.append(
            [
                network["name"],
                network["system"],
                network["graph"],
                f"{100 * network['float_training']:.2f} %",
                "–" if validation is None else f"{100 * validation:.2f} %",
                percent(test["correct"], report["data"]["test"]),
                network["trained_by"] or "not known",
            ]
        )
    names = ["network", "system", "graph", "training split", "validation", "test split", "trained by"]
    return [table("Float models on whole recordings", names, rows, left=True)]


def _provenance(report: Json) -> list[str]:
    data = report["data"]
    rows = [["recordings", data["path"], data["sha256"]]]
    rows += [[network["name"], network["path"], network["sha256"]] for network in report["networks"]]
    tables = [[f"{kind}, {name}", title] for kind, found in report["tables"].items() for name, title in found.items()]
    grid = [[axis, ", ".join(_shown(value) for value in values) or "all"] for axis, values in report["grid"].items()]
    return [
        table("Files", ["", "name", "sha256"], rows, left=True),
        table("Grid", ["axis", "values"], grid, left=True),
        table("Tables of prices and times", ["", "source"], tables, left=True),
        paragraph(f"Hash over all figures but measured ones: {report['digest']}"),
        "<h3>Command that repeats this chart</h3>",
        f"<pre><code>{escape(report['command'])}</code></pre>",
    ]


def _shown(value: Any) -> str:
    return "+".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
