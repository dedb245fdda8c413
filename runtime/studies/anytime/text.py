"""What ``anytime`` prints."""

from __future__ import annotations

import math
from typing import Any

from spikeloom.runtime.report.tables import percent, si, table

Json = dict[str, Any]

SHOWN = (5, 10, 25, 50, 75, 90, 100)
"""Windows in the text; JSON and the picture have more."""


def anytime_text(report: Json) -> str:
    """Accuracies by window, costs by rule, and what can be saved for nothing."""
    full, labelled = report["full"], report["labelled"]
    lines = []
    if labelled:
        beside = [("float accuracy: ", "float_correct")] if "float_correct" in full else []
        lines += [f"{head} {percent(full[key], labelled)}" for head, key in (*beside, ("chip accuracy:  ", "correct"))]
        lines += ["", _windows(report), ""]
    lines += [_rules(report), ""]
    lines += [_saving(report, name, index) for name, index in report["savings"].items()]
    if "chosen" in report:
        rule = report["rules"][report["chosen"]]
        lines.append(
            f"calibrated on {rule['races']} races for second place of {report['calibrated_on']}, split train; of "
            f"others at most {100 * rule['bound']:.1f} % end otherwise at an allowed {_share(rule)} (95 % confidence)"
        )
        factor = math.ceil(1e4 * rule["factor"]) / 1e4  # a larger one is as safe
        lines.append(f"live: spikeloom watch NET.loom --bins {report['bins']} --until-sure {factor:g}")
    else:
        lines.append(f"live: spikeloom watch NET.loom --bins {report['bins']} --until-sure")
    return "\n".join(lines)


def _windows(report: Json) -> str:
    sides = [name for name in ("float", "chip") if name in report["windows"][0]]
    rows = []
    for window in report["windows"]:
        if window["percent"] in SHOWN:
            cells = []
            for name in sides:
                low, high = window[name]["interval"]
                share = window[name]["correct"] / report["labelled"]
                cells.append(f"{100 * share:.2f} ({100 * low:.1f} … {100 * high:.1f})")
            rows.append([f"{window['percent']} %", f"{window['bins']:.0f}", *cells])
    return table(["observed", "bins", *(f"{name}, % right" for name in sides)], rows)


def _share(rule: Json) -> str:
    return f"{100 * rule['allowed']:g} %"


def _named(rule: Json) -> str:
    return "proven" if rule["allowed"] is None else f"sure, {_share(rule)} may differ"


def _rules(report: Json) -> str:
    full = report["full"]
    energies, times = list(full["energy_j"]), list(full["time_s"])
    head = ["stop when", "votes ahead", "steps", "operations"]
    head += [*energies, *(f"time, {name}" for name in times), "differ", "right"]
    floats = any("float" in rule for rule in report["rules"])
    head += ["float: steps", "differ", "right"] if floats else []

    def cells(costs: Json) -> list[str]:
        found = [f"{costs['chip_steps']:.1f}", f"{costs['operations']:,.0f}"]
        found += [si(costs["energy_j"][name], "J") for name in energies]
        return found + [si(costs["time_s"][name], "s") for name in times]

    def right(entry: Json, key: str = "correct") -> str:
        return "" if entry.get(key) is None else str(entry[key])

    whole = ["", "", right(full, "float_correct")] if floats else []
    rows = [["all is seen", "", *cells(full), "", right(full), *whole]]
    for rule in report["rules"]:
        ahead = "more than can come" if rule["factor"] is None else f"{rule['factor']:.3f}·√left"
        row = [_named(rule), ahead, *cells(rule["mean"]), str(rule["differ"]), right(rule)]
        if floats:
            row += [f"{rule['float']['steps']:.1f}", str(rule["float"]["differ"]), right(rule["float"])]
        rows.append(row)
    return table(head, rows)


def _saving(report: Json, name: str, index: int) -> str:
    """The largest saving under a condition."""
    rule = report["rules"][index]
    saved = rule["saved"]
    parts = [f"{100 * saved['chip_steps']:.1f} % of the steps", f"{100 * saved['operations']:.1f} % of the operations"]
    parts += [f"{100 * each:.1f} % of the energy ({of})" for of, each in saved["energy_j"].items()]
    parts += [f"{100 * each:.1f} % of the time ({of})" for of, each in saved["time_s"].items()]
    what = "all decisions equal" if name == "identical" else "at most one recording less right"
    return f"{what}: {', '.join(parts)} saved ({_named(rule)})"
