"""The study of early decisions laid out for people, and drawn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from spikeloom.runtime.report.drawing import CHIP, COLOURS, DASHES, GREY, Drawing, sheet, styled
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.anytime.exits import Calibrated
from spikeloom.runtime.studies.anytime.study import Anytime, Costs

SHOWN = (5, 10, 25, 50, 75, 90, 100)
"""Windows in the text; JSON and the picture have more."""


def sections(result: Anytime) -> list[Section]:
    """Accuracies by window, costs by rule, and how to stop live."""
    shown = []
    if result.full.correct is not None:
        accuracy = Text(f"chip accuracy:   {percent(result.full.correct, result.labelled)}")
        shown = [Section("Accuracy", [accuracy]), Section("Windows", [window_table(result)])]
    return [*shown, Section("Rules", [rule_table(result)]), Section("Live", [Text("\n".join(_lines(result)))])]


def _lines(result: Anytime) -> list[str]:
    live = f"live: spikeloom watch NET.loom --bins {result.bins} --until-sure"
    if result.chosen is None:
        return [live]
    rule = result.rules[result.chosen].stop
    assert rule.bound is not None, "a chosen rule is calibrated"
    return [
        f"calibrated on {rule.races} races for second place of {result.calibrated_on}, split train, which the network "
        f"may have been trained on: at an allowed {_allowed(rule)} at most {100 * rule.bound:.1f} % of such races end "
        "otherwise (95 % confidence), of decisions more may",
        f"{live} {math.ceil(1e4 * rule.factor) / 1e4:g}",  # a larger one is as safe
    ]


def window_table(result: Anytime) -> Table:
    """Right decisions by the part of each recording that is observed."""
    rows = []
    for each in result.windows:
        if each.percent in SHOWN:
            low, high = each.chip.interval
            right = f"{100 * each.chip.correct / result.labelled:.2f} ({100 * low:.1f} … {100 * high:.1f})"
            rows.append([f"{each.percent} %", f"{each.bins:.0f}", right])
    return Table(["observed", "bins", "chip, % right"], rows)


def _allowed(rule: Calibrated) -> str:
    return f"{100 * (rule.allowed or 0):g} %"


def rule_name(rule: Calibrated) -> str:
    """What a rule allows."""
    return "proven" if rule.allowed is None else f"sure, {_allowed(rule)} may differ"


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
        rows.append([rule_name(rule.stop), ahead, *cells(rule.mean), *changed])
    return Table(head, rows)


# -- picture -----------------------------------------------------------------------------------------------------------


@styled
def picture(result: Anytime) -> Drawing:
    """Draw the study."""
    title = f"{result.source}, {result.samples} recordings of split {result.split}"
    drawing = sheet(title, 4.6, width=10.5)
    windows, stops = drawing.figure.subplots(1, 2)
    _draw_windows(windows, result)
    _draw_stops(stops, result)
    drawing.figure.suptitle(title)
    return drawing


def _draw_windows(axes: Any, result: Anytime) -> None:
    """Accuracy of the chip with its interval."""
    axes.set(title="accuracy against the window", xlabel="observed (% of the recording)", ylabel="right (%)")
    axes.grid()
    if not result.windows:
        axes.text(0.5, 0.5, "no labels", transform=axes.transAxes, ha="center", color=GREY)
        return
    shares = [window.percent for window in result.windows]
    right = [100 * window.chip.correct / result.labelled for window in result.windows]
    low, high = 100 * np.array([window.chip.interval for window in result.windows]).T
    axes.fill_between(shares, low, high, color=CHIP, alpha=0.13, linewidth=0)
    axes.plot(shares, right, color=CHIP, marker="o", markersize=4, label="chip, 95 % interval")
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
        axes.step(*where, ls=dash, where="post", color=colour, linewidth=1.8, label=rule_name(rule.stop))
        axes.axvline(ends.mean(), color=colour, ls=dash, linewidth=0.8, alpha=0.6)
    axes.set(title="when recordings stop (thin: mean)", xlabel="chip steps", ylabel="stopped (%)")
    axes.set_xlim(0, whole)
    axes.set_ylim(0, 101)
    axes.grid()
    _legend(axes)


def _legend(axes: Any) -> None:
    """Below the panel, where nothing is."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
