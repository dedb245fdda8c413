"""A chart in text: tables for the terminal, and every point as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report.tables import percent, si, table
from spikeloom.runtime.studies.chart.budget import UNITS
from spikeloom.runtime.studies.chart.points import by_chip, own_value

Json = dict[str, Any]

NAMES = {
    "cheapest": "cheapest within one sample of float",
    "fastest": "fastest within it, real time",
    "best": "best",
}
"""Recommended points in words."""

LISTED = 20
"""Points of a front, and refused configurations, that the text names."""


def label(point: Json) -> str:
    """Short name of a configuration.

    Examples
    --------
    >>> label({"network": "objects", "storage": "4b 2p", "cores": "latency", "window": 50})
    'objects 4b 2p, latency, 50 %'
    """
    layout = "" if point["cores"] == "cores" else f", {point['cores']}"
    return f"{point['network']} {point['storage']}{layout}, {point['window']} %"


def figures(point: Json, energy: str, time: str | None) -> list[str]:
    """Cells of a point in a table of points."""
    test = point["test"]
    return [
        f"{100 * point['expected']:.2f}",
        f"{100 * test['accuracy']:.2f}",
        f"{100 * test['low']:.1f} … {100 * test['high']:.1f}",
        f"{100 * test['float']['accuracy']:.2f}",
        f"{test['equal']}",
        _cost(test["energy_j"], energy, "J"),
        "–" if time is None else _cost(test["time_s"], time, "s"),
        f"{test['synaptic_operations']:,.0f}",
        str(point["n_cores"]),
    ]


def _cost(found: Json, name: str, unit: str) -> str:
    """A cost; of a chip whose tables have other names with that of its own."""
    told = "" if name in found else f" ({next(iter(found))})"
    return f"{si(own_value(found, name), unit)}{told}"


def head(energy: str, time: str | None) -> list[str]:
    """Names of these cells."""
    timed = "time" if time is None else f"time ({time})"
    names = ["expected %", "test %", "interval", "float %", "equal", f"energy ({energy})", timed, "operations", "cores"]
    return ["#", "configuration", *names]


def chart_text(report: Json, folder: str) -> str:
    """What people read on the terminal."""
    points = {point["number"]: point for point in report["points"]}
    samples = report["data"]["test"]
    refused = f", {number(len(report['refused']), 'more configuration')} refused" if report["refused"] else ""
    lines = [
        f"{number(len(points), 'point')} of {number(len(report['networks']), 'network')} on {samples} test and "
        f"{report['data']['train']} training recordings{refused}",
        f"choices are made on the training split by what is expected: {report['expected']}; test figures are reported "
        "beside",
        "",
        table(
            ["network", "graph", "validation %", "float, training %", "float, test"],
            [
                [
                    net["name"],
                    net["graph"],
                    "–" if net["validation"] is None else f"{100 * net['validation']:.2f}",
                    f"{100 * net['float_training']:.2f}",
                    _float_test(net, samples),
                ]
                for net in report["networks"]
            ],
        ),
        "",
        recommended_text(report),
    ]
    for name in ("energy", "latency"):
        on = [index for index, point in points.items() if point["front"].get(name)]
        if on:
            on.sort(key=lambda index: points[index]["test"]["accuracy"])
            more = f", {len(on) - LISTED} more in the files" if len(on) > LISTED else ""
            lines += [
                "",
                f"front of test accuracy and {name} (a description, no choice){more}:",
                _rows(report, on[:LISTED]),
            ]
    lines += [*_others(report), "", *saving_lines(report)]
    if report["budget"] is not None:
        lines += ["", *budget_lines(report)]
    lines += [f"does not fit: {_configuration(each)}: {each['why'][0]}" for each in report["refused"][:LISTED]]
    if len(report["refused"]) > LISTED:
        lines.append(f"does not fit: {len(report['refused']) - LISTED} more, see chart.json")
    lines += ["", f"written: {folder}/chart.html, .svg, .png, .csv, .json; netlists in {folder}/netlists"]
    return "\n".join(lines)


def _others(report: Json) -> list[str]:
    """Points of other chips, each under its own names of prices and time."""
    _, others = by_chip(report["points"], report["target"])
    lines = []
    for chip in dict.fromkeys(point["target"] for point in others):
        own = [point for point in others if point["target"] == chip]
        energy, time = (next(iter(own[0]["test"][name])) for name in ("energy_j", "time_s"))
        shown = [[str(point["number"]), label(point), *figures(point, energy, time)] for point in own]
        lines += [
            "",
            f"on {chip}, whose prices are others (no choice, no front):",
            table(head(energy, time), shown[:LISTED]),
        ]
    return lines


def recommended_text(report: Json) -> str:
    """Points to take, and the commands that make them."""
    points = {point["number"]: point for point in report["points"]}
    chosen = {name: index for name, index in report["recommended"].items() if index is not None}
    lines = ["recommended:", _rows(report, list(chosen.values()), [NAMES[name] for name in chosen])]
    lines += [f"  {NAMES[name]}: no point" for name, index in report["recommended"].items() if index is None]
    for index in dict.fromkeys(chosen.values()):
        lines += [f"  #{index}: {command}" for command in points[index]["commands"]]
    return "\n".join(lines)


def _rows(report: Json, numbers: Sequence[int], names: Sequence[str] = ()) -> str:
    """A table of points; with names before them, where there are any."""
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    points = {point["number"]: point for point in report["points"]}
    shown = [[str(index), label(points[index]), *figures(points[index], energy, time)] for index in numbers]
    above = head(energy, time)
    if not names:
        return table(above, shown)
    return table(["", *above], [[name, *row] for name, row in zip(names, shown, strict=True)])


def _float_test(network: Json, samples: int) -> str:
    longest = max(network["float"], key=int)
    found = percent(network["float"][longest]["test"]["correct"], samples)
    return found if longest == "100" else f"{found} at {longest} %"


def _configuration(each: Json) -> str:
    return f"{each['network']} {each['storage']}, {each['cores']}"


def _times(ratios: Json, what: str) -> str:
    """Ratios by table in words."""
    return ", ".join(
        f"{'–' if ratio is None else f'{ratio:.2f}'} times less {what} ({name})" for name, ratio in ratios.items()
    )


def saving_lines(report: Json) -> list[str]:
    """How much less energy than the usual mapping is needed, chosen cleanly and seen on the test split."""
    found = report["saving"]
    if found is None:
        return ["the usual mapping (8 bits, one plane, whole recordings) is not in the grid: no saving to tell"]
    points = {point["number"]: point for point in report["points"]}
    usual = points[found["usual"]]
    lines = [f"against {label(usual)} (#{found['usual']}), for at most a point of accuracy:"]
    for name, words in (
        ("chosen", "chosen on the training split"),
        ("seen", "least on the test split (seen, not chosen)"),
    ):
        own = found[name]
        lines.append(
            f"  {words}: #{own['point']} {label(points[own['point']])}: {_times(own['energy'], 'energy')}, test "
            f"accuracy {100 * own['accuracy']:+.2f} points"
        )
    return lines


def budget_lines(report: Json) -> list[str]:
    """The point that a budget picks, what it gives up, and its commands."""
    found = report["budget"]
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    points = {point["number"]: point for point in report["points"]}
    point, best = points[found["point"]], points[found["best"]]
    asked = " and ".join(found["budgets"])
    if found["fits"]:
        lines = [f"{asked}: {found['fitting']} of {len(points)} points fit; take #{found['point']} {label(point)}"]
    else:
        lines = [f"{asked}: no point fits; the nearest is #{found['point']} {label(point)}"]
        lines += [f"  misses {_missed(what, each)}" for what, each in found["misses"].items()]
    lines.append(table(head(energy, time), [[str(found["point"]), label(point), *figures(point, energy, time)]]))
    if found["point"] == found["best"]:
        lines.append("  it is the best of all points: nothing is given up")
    else:
        up = found["given_up"]
        saved = [_times(up["energy"], "energy"), *([_times(up["time"], "time")] if up["time"] else [])]
        lines.append(
            f"  beside the best, #{found['best']} {label(best)}: expected {100 * up['expected']:+.2f} points, test "
            f"{100 * up['accuracy']:+.2f} points, {', '.join(saved)}"
        )
    return [*lines, *(f"  {command}" for command in point["commands"])]


def _missed(what: str, each: Json) -> str:
    if what == "accuracy":
        return f"{what}: expected are {100 * each['found']:.2f} %, asked {100 * each['limit']:g} %"
    unit = next(iter(UNITS[what]))
    return f"{what}: it takes {si(each['found'], unit)}, allowed {si(each['limit'], unit)}"


# -- files -------------------------------------------------------------------------------------------------------------


def csv_text(report: Json) -> str:
    """Every point as a line; what is measured on this machine comes last, in columns named so."""
    tables = list(report["tables"]["energy"])
    times = list(report["tables"]["time"])
    columns = ["number", "network", "graph", "bits", "planes", "groups", "prune", "fine_tuned", "cores", "window"]
    sizes = ["n_cores", "neurons", "synapses"]
    per_split = ["correct", "accuracy", "low", "high", "equal", "synaptic_operations"]
    split_head = [*per_split, "float_accuracy", *(f"energy_j_{n}" for n in tables), *(f"time_s_{n}" for n in times)]
    file = io.StringIO()
    out = csv.writer(file, lineterminator="\n")
    fronts = ["energy", "latency"]
    out.writerow(
        [
            *columns,
            *sizes,
            "expected",
            *(f"{split}_{name}" for split in ("test", "train") for name in split_head),
            *(f"front_{name}" for name in fronts),
            "compile",
            "run",
            "measured_recordings_per_s",
        ]
    )
    for point in report["points"]:
        cells = [point[name] for name in columns]
        cells[columns.index("bits")] = "+".join(map(str, point["bits"]))
        cells += [*(point[name] for name in sizes), point["expected"]]
        for split in ("test", "train"):
            own = point[split]
            cells += [*(own[name] for name in per_split), own["float"]["accuracy"]]
            cells += [own["energy_j"].get(name, "") for name in tables]
            cells += [own["time_s"].get(name, "") for name in times]
        cells += [point["front"].get(name, "") for name in fronts]
        rate = report["measured"]["recordings_per_s"][str(point["number"])]
        out.writerow([*cells, *point["commands"], f"{rate:.0f}"])
    return file.getvalue()
