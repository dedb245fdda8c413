"""The study of early decisions laid out for people, and drawn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from spikeloom.runtime.report.drawing import CHIP, COLOURS, DASHES, FLOAT, GREY, Drawing, sheet, styled
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.anytime.exits import Calibrated
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
    rule = result.rules[result.chosen].stop
    assert rule.bound is not None, "a chosen rule is calibrated"
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


def _allowed(rule: Calibrated) -> str:
    return f"{100 * (rule.allowed or 0):g} %"


def _short(rule: Rule) -> str:
    return "proven" if rule.stop.allowed is None else f"sure, {_allowed(rule.stop)}"


def rule_name(rule: Rule) -> str:
    """What a rule allows."""
    return _short(rule) if rule.stop.allowed is None else f"{_short(rule)} may differ"


def rule_table(result: Anytime) -> Table:
    """Costs, differing and right decisions of each rule."""
    full = result.full
    head = ["stop when", "votes ahead", "steps", "operations", *full.costs.energy_j]
    head += [*(f"time, {name}" for name in full.costs.time_s), "differ", "right"]

    def cells(costs: Costs) -> list[str]:
        found = [f"{costs.chip_steps:.1f}", f"{costs.operations:,.0f}"]
        found += [si(costs.energy_j[name], "J") for name in full.costs.energy_j]
        return found + [si(costs.time_s[name], "s") for name in full.costs.time_s]

    def shown(count: int | None) -> str:
        return "" if count is None else str(count)

    rows = [["all is seen", "", *cells(full.costs), "", shown(full.correct)]]
    for rule in result.rules:
        ahead = "more than can come" if rule.stop.allowed is None else f"{rule.stop.factor:.3f}·√left"
        changed = [str(rule.changes.differ), shown(rule.changes.correct)]
        rows.append([rule_name(rule), ahead, *cells(rule.mean), *changed])
    return Table(head, rows)


def _saving(rule: Rule, name: str) -> str:
    """The largest saving under a condition."""
    saved = rule.saved
    parts = [f"{100 * saved.chip_steps:.1f} % of the steps", f"{100 * saved.operations:.1f} % of the operations"]
    parts += [f"{100 * each:.1f} % of the energy ({table})" for table, each in saved.energy_j.items()]
    parts += [f"{100 * each:.1f} % of the time ({table})" for table, each in saved.time_s.items()]
    what = "all decisions equal" if name == "identical" else "at most one recording less right"
    return f"{what}: {', '.join(parts)} saved ({rule_name(rule)})"


# -- picture -----------------------------------------------------------------------------------------------------------


@styled
def picture(result: Anytime) -> Drawing:
    """Draw the study."""
    title = f"{result.source}, {result.samples} recordings of split {result.split}"
    drawing = sheet(title, 4.6, width=15.5)
    windows, stops, savings = drawing.figure.subplots(1, 3)
    _draw_windows(windows, result)
    _draw_stops(stops, result)
    _draw_savings(savings, result)
    drawing.figure.suptitle(title)
    return drawing


def _draw_windows(axes: Any, result: Anytime) -> None:
    """Accuracy of float model and chip with their intervals."""
    axes.set(title="accuracy against the window", xlabel="observed (% of the recording)", ylabel="right (%)")
    axes.grid()
    if not result.windows:
        axes.text(0.5, 0.5, "no labels", transform=axes.transAxes, ha="center", color=GREY)
        return
    shares = [window.percent for window in result.windows]
    model, chip = [window.model for window in result.windows], [window.chip for window in result.windows]
    for label, colour, line, marker, found in (
        ("float model", FLOAT, "--", "s", model),
        ("chip", CHIP, "-", "o", chip),
    ):
        known = [each for each in found if each is not None]
        if known:
            right = [100 * each.correct / result.labelled for each in known]
            low, high = 100 * np.array([each.interval for each in known]).T
            axes.fill_between(shares, low, high, color=colour, alpha=0.13, linewidth=0)
            axes.plot(shares, right, line, color=colour, marker=marker, markersize=4, label=f"{label}, 95 % interval")
    axes.set_xlim(0, 102)
    axes.set_ylim(0, 100)
    _legend(axes)


def _draw_stops(axes: Any, result: Anytime) -> None:
    """Share of recordings that have stopped by the proof, the chosen rule and the loosest one, by chip step."""
    whole = max(result.chip_steps)
    shown = dict.fromkeys((0, result.chosen or 0, len(result.rules) - 1))
    for order, index in enumerate(shown):
        rule, colour, dash = result.rules[index], COLOURS[order], DASHES[order]
        ends = np.sort(rule.samples.chip_steps)
        stopped = 100 * np.arange(1, len(ends) + 1) / len(ends)
        where = [0, *ends, whole], [0, *stopped, 100]
        axes.step(*where, ls=dash, where="post", color=colour, linewidth=1.8, label=_short(rule))
        axes.axvline(ends.mean(), color=colour, ls=dash, linewidth=0.8, alpha=0.6)
    axes.set(title="when recordings stop (thin: mean)", xlabel="chip steps", ylabel="stopped (%)")
    axes.set_xlim(0, whole)
    axes.set_ylim(0, 101)
    axes.grid()
    _legend(axes)


def _draw_savings(axes: Any, result: Anytime) -> None:
    """Energy saved by each rule, and how many decisions it changes."""
    rules = result.rules
    kinds = {"operations": [100 * rule.saved.operations for rule in rules]}
    kinds |= {
        f"energy, {name}": [100 * rule.saved.energy_j[name] for rule in rules] for name in rules[0].saved.energy_j
    }
    height, places = 0.8 / len(kinds), np.arange(len(rules))
    for index, (label, widths) in enumerate(kinds.items()):
        offset = (index - (len(kinds) - 1) / 2) * height
        axes.barh(places + offset, widths, height * 0.92, label=label, color=COLOURS[index])
    longest = max(max(widths) for widths in kinds.values())
    for place, rule in zip(places, rules, strict=True):
        note = f"{rule.changes.differ} differ"
        if rule.changes.correct is not None and result.full.correct is not None:
            note += f", {rule.changes.correct - result.full.correct:+d} right"
        axes.text(longest * 1.03 + 0.5, place, note, va="center", fontsize=8)
    axes.set_yticks(places, [_short(rule) for rule in rules])
    axes.invert_yaxis()
    axes.set_xlim(0, max(1.0, longest) * 1.4)
    axes.set(title="saved, and what it changes", xlabel="saved (%)")
    axes.grid(axis="x")
    _legend(axes)


def _legend(axes: Any) -> None:
    """Below the panel, where nothing is."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
