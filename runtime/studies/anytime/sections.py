"""The study of early decisions laid out for people."""

from __future__ import annotations

import math

from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.anytime.study import Anytime, Costs, Right, Rule

SHOWN = (5, 10, 25, 50, 75, 90, 100)
"""Windows in the text; JSON and the picture have more."""


def sections(result: Anytime) -> list[Section]:
    """Accuracies by window, costs by rule, and what can be saved for nothing."""
    full, labelled = result.full, result.labelled
    shown = []
    if labelled and full.correct is not None:
        lines = [f"chip accuracy:   {percent(full.correct, labelled)}"]
        if full.float_correct is not None:
            lines.insert(0, f"float accuracy:  {percent(full.float_correct, labelled)}")
        shown = [Section("Accuracy", [Text("\n".join(lines))]), Section("Windows", [window_table(result)])]
    return [*shown, Section("Rules", [rule_table(result)]), Section("Savings", [Text("\n".join(_lines(result)))])]


def _lines(result: Anytime) -> list[str]:
    lines = [_saving(result.rules[index], name) for name, index in result.savings.items()]
    live = f"live: spikeloom watch NET.loom --bins {result.bins} --until-sure"
    if result.chosen is None:
        return [*lines, live]
    rule = result.rules[result.chosen]
    assert rule.factor is not None, "a chosen rule is calibrated"
    assert rule.bound is not None, "likewise"
    return [
        *lines,
        f"calibrated on {rule.races} races for second place of {result.calibrated_on}, split train; of others at most "
        f"{100 * rule.bound:.1f} % end otherwise at an allowed {_allowed(rule)} (95 % confidence)",
        f"{live} {math.ceil(1e4 * rule.factor) / 1e4:g}",  # a larger one is as safe
    ]


def window_table(result: Anytime) -> Table:
    """Right decisions by the part of each recording that is observed."""

    def cell(right: Right) -> str:
        low, high = right.interval
        return f"{100 * right.correct / result.labelled:.2f} ({100 * low:.1f} … {100 * high:.1f})"

    rows = [
        [f"{each.percent} %", f"{each.bins:.0f}", *([cell(each.model)] if each.model else []), cell(each.chip)]
        for each in result.windows
        if each.percent in SHOWN
    ]
    sides = ["float", "chip"] if result.windows[0].model else ["chip"]
    return Table(["observed", "bins", *(f"{name}, % right" for name in sides)], rows)


def _allowed(rule: Rule) -> str:
    return f"{100 * (rule.allowed or 0):g} %"


def rule_name(rule: Rule) -> str:
    """What a rule allows."""
    return "proven" if rule.allowed is None else f"sure, {_allowed(rule)} may differ"


def rule_table(result: Anytime) -> Table:
    """Costs, differing and right decisions of each rule."""
    full = result.full
    head = ["stop when", "votes ahead", "steps", "operations", *full.costs.energy_j]
    head += [*(f"time, {name}" for name in full.costs.time_s), "differ", "right"]
    model = any(rule.model for rule in result.rules)
    head += ["float: steps", "differ", "right"] if model else []

    def cells(costs: Costs) -> list[str]:
        found = [f"{costs.chip_steps:.1f}", f"{costs.operations:,.0f}"]
        found += [si(costs.energy_j[name], "J") for name in full.costs.energy_j]
        return found + [si(costs.time_s[name], "s") for name in full.costs.time_s]

    def shown(count: int | None) -> str:
        return "" if count is None else str(count)

    rows = [["all is seen", "", *cells(full.costs), "", shown(full.correct)]]
    rows[0] += ["", "", shown(full.float_correct)] if model else []
    for rule in result.rules:
        ahead = "more than can come" if rule.factor is None else f"{rule.factor:.3f}·√left"
        row = [rule_name(rule), ahead, *cells(rule.mean), str(rule.changes.differ), shown(rule.changes.correct)]
        if rule.model is not None:
            changes = rule.model.changes
            row += [f"{rule.model.steps:.1f}", str(changes.differ), shown(changes.correct)]
        rows.append(row)
    return Table(head, rows)


def _saving(rule: Rule, name: str) -> str:
    """The largest saving under a condition."""
    saved = rule.saved
    parts = [f"{100 * saved.chip_steps:.1f} % of the steps", f"{100 * saved.operations:.1f} % of the operations"]
    parts += [f"{100 * each:.1f} % of the energy ({table})" for table, each in saved.energy_j.items()]
    parts += [f"{100 * each:.1f} % of the time ({table})" for table, each in saved.time_s.items()]
    what = "all decisions equal" if name == "identical" else "at most one recording less right"
    return f"{what}: {', '.join(parts)} saved ({rule_name(rule)})"
