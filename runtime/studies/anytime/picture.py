"""What ``anytime --picture`` draws: accuracy against the window, when recordings stop, savings and what they change."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.runtime.report.drawing import CHIP, COLOURS, DASHES, FLOAT, GREY, Drawing, sheet, styled
from spikeloom.runtime.studies.anytime.study import Anytime, Rule


@styled
def picture(result: Anytime) -> Drawing:
    """Draw the study."""
    title = f"{result.source}, {result.samples} recordings of split {result.split}"
    drawing = sheet(title, 4.6, width=15.5)
    windows, stops, savings = drawing.figure.subplots(1, 3)
    _windows(windows, result)
    _stops(stops, result)
    _savings(savings, result)
    drawing.figure.suptitle(title)
    return drawing


def _windows(axes: Any, result: Anytime) -> None:
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


def _name(rule: Rule) -> str:
    return "proven" if rule.allowed is None else f"sure, {100 * rule.allowed:g} %"


def _stops(axes: Any, result: Anytime) -> None:
    """Share of recordings that have stopped by the proof, the chosen rule and the loosest one, by chip step."""
    whole = max(result.chip_steps)
    shown = dict.fromkeys((0, result.chosen or 0, len(result.rules) - 1))
    for order, index in enumerate(shown):
        rule, colour, dash = result.rules[index], COLOURS[order], DASHES[order]
        ends = np.sort(rule.samples.chip_steps)
        stopped = 100 * np.arange(1, len(ends) + 1) / len(ends)
        where = [0, *ends, whole], [0, *stopped, 100]
        axes.step(*where, ls=dash, where="post", color=colour, linewidth=1.8, label=_name(rule))
        axes.axvline(ends.mean(), color=colour, ls=dash, linewidth=0.8, alpha=0.6)
    axes.set(title="when recordings stop (thin: mean)", xlabel="chip steps", ylabel="stopped (%)")
    axes.set_xlim(0, whole)
    axes.set_ylim(0, 101)
    axes.grid()
    _legend(axes)


def _savings(axes: Any, result: Anytime) -> None:
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
    axes.set_yticks(places, [_name(rule) for rule in rules])
    axes.invert_yaxis()
    axes.set_xlim(0, max(1.0, longest) * 1.4)
    axes.set(title="saved, and what it changes", xlabel="saved (%)")
    axes.grid(axis="x")
    _legend(axes)


def _legend(axes: Any) -> None:
    """Below the panel, where nothing is."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, fontsize=8)
