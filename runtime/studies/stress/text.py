"""Tables of ``stress`` for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.tables import table
from spikeloom.runtime.studies.stress.verdicts import SIDES, shown

Json = dict[str, Any]

ACROSS = 10
"""Levels side by side at most."""

NONE = "–"

VERDICT_HEAD = ["perturbation", "verdict", "leaves, float", "chip", "chance, float", "chip", "least", "why"]

CURVE_ROWS = (*SIDES, "equal", "spikes")

KEY = """\
leaves: first level below the clean interval; chance: first level no better than chance; least: fewest decisions equal
curves in per cent: accuracy ± 95 % interval of the mean over seeds; equal decisions; spikes in common in the layer that
has fewest of them"""


def stress_text(report: Json) -> str:
    """Clean accuracy, verdicts, curves, and what was not measured."""
    clean, recordings = report["clean"], report["recordings"]
    lines = [f"{side} accuracy, clean: {percent(clean['right'][side], recordings)}" for side in SIDES]
    lines.append(f"decisions equal, clean: {clean['equal']} of {recordings}; chance {100 / report['classes']:.1f} %")
    lines += ["", verdict_table(report["perturbations"]), ""]
    lines.append(KEY)
    for name, found in report["perturbations"].items():
        lines += ["", f"{name}: {found['what']} ({found['unit']})", *_curves(found)]
    for name, reason in report["not_applicable"].items():
        lines += ["", f"{name}: not measured, {reason}"]
    missed = {text.partition(": ")[0]: text for text in report["missed"]}
    if report["required"]:
        lines.append("")
        lines += [f"required {missed.get(words, f'{words}: kept')}" for words in report["required"]]
    return "\n".join(lines)


def verdict_table(found: Json) -> str:
    """One line for each perturbation."""
    rows = [VERDICT_HEAD, *verdict_rows(found)]
    widest = max(len(row[-1]) for row in rows)
    head, *others = [[*row[:-1], row[-1].ljust(widest)] for row in rows]
    return table(head, others)


def verdict_rows(found: Json) -> list[list[str]]:
    """Cells of that table."""
    rows = []
    for name, one in found.items():
        breaks = one["breaks"]
        places = [breaks[side][what] for what in ("leaves", "chance") for side in SIDES]
        least = min(point["equal"] for point in one["levels"])
        rows.append(
            [
                name,
                one["verdict"],
                *(NONE if place is None else shown(place) for place in places),
                f"{100 * least:.0f} %",
                why(one),
            ]
        )
    return rows


def why(one: Json) -> str:
    """What is to be seen on the chip where it leaves, or at chance where that says more; on which side it breaks."""
    chip = one["breaks"]["chip"]
    words = []
    if not one["same_place"]:
        places = [one["breaks"][side]["leaves"] for side in SIDES]
        order = [point["level"] for point in one["levels"]]
        ranks = [len(order) if place is None else order.index(place) for place in places]
        words.append("chip first" if ranks[1] < ranks[0] else "float first")
    for place in (chip["chance"], chip["leaves"]):
        reasons: list[str] = next((point["why"]["chip"] for point in one["levels"] if point["level"] == place), [])
        if reasons:
            return "; ".join([*words, *reasons])
    return "; ".join([*words, *([] if chip["leaves"] is None else ["other spikes, as many"])])


def _curves(found: Json) -> list[str]:
    """Levels side by side, accuracies of both sides and equal decisions below."""
    levels = found["levels"]
    parts = [levels[i : i + ACROSS] for i in range(0, len(levels), ACROSS)]
    return [table(["", *(shown(point["level"]) for point in part)], curve_cells(part)) for part in parts]


def curve_cells(levels: Sequence[Json]) -> list[list[str]]:
    """Cells of the curves, one row for each of ``CURVE_ROWS``, per cent."""
    rows = [[side, *(_accuracy(point[side]) for point in levels)] for side in SIDES]
    rows.append(["equal", *(f"{100 * point['equal']:.0f}" for point in levels)])
    rows.append(["spikes", *(f"{100 * min(point['common'].values()):.0f}" for point in levels)])
    return rows


def _accuracy(spread: Json) -> str:
    """Per cent, with the reach of the interval where there are several seeds."""
    mean = f"{100 * spread['mean']:.0f}"
    if len(spread["values"]) == 1:
        return mean
    reach = 100 * max(spread["high"] - spread["mean"], spread["mean"] - spread["low"])
    return f"{mean}±{reach:.0f}"
