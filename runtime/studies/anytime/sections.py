"""The study of early decisions laid out for people."""

import math

from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.studies.anytime.exits import Calibrated
from spikeloom.runtime.studies.anytime.study import Anytime, StoppedCosts

SHOWN = (5, 10, 25, 50, 75, 90, 100)
"""Windows in the text; JSON has more."""


def sections(result: Anytime) -> list[Section]:
    """Accuracies by window, costs by rule, and how to stop live."""
    shown = []
    if result.full.correct is not None:
        accuracy = Text(f"chip accuracy:   {percent(result.full.correct, result.labelled)}")
        shown = [Section("Accuracy", [accuracy]), Section("Windows", [window_table(result)])]
    return [
        *shown,
        Section("Rules", [rule_table(result)]),
        Section("Live", [Text("\n".join(_lines(result)))]),
    ]


def _lines(result: Anytime) -> list[str]:
    live = f"live: spikeloom watch NET.loom --bins {result.bins} --until-sure"
    shortest = result.bins - (max(result.chip_steps) - min(result.chip_steps))
    padded = (
        f"each recording ends with its own last step here, after {shortest} to {result.bins}; live, all are "
    )
    note = [] if shortest == result.bins else [f"{padded}padded to --bins: other figures, perhaps decisions"]
    if result.chosen is None:
        return [*note, live]
    rule = result.rules[result.chosen].stop
    assert rule.bound is not None, "a chosen rule is calibrated"
    kind, noun = (
        ("held-out decisions", "decisions") if result.held_out else ("races for second place", "races")
    )
    return [
        f"calibrated on {rule.races} {kind} of {result.calibrated_on}, split train: of such {noun} at most "
        f"{100 * rule.bound:.1f} % end otherwise where {_allowed(rule)} did (95 % confidence)"
        + ("" if result.held_out else "; nothing bounds decisions"),
        *note,
        f"{live} {math.ceil(1e4 * rule.factor) / 1e4:g}",  # a larger one is as safe
    ]


def window_table(result: Anytime) -> Table:
    """Right decisions by the part of each recording that is run; the steps of counters end with their read-out."""
    rows = []
    for each in result.windows:
        if each.percent in SHOWN:
            low, high = each.chip.interval
            right = f"{100 * each.chip.correct / result.labelled:.2f} ({100 * low:.1f} … {100 * high:.1f})"
            rows.append([f"{each.percent} %", f"{each.bins:.0f}", right])
    return Table(["run", "steps", "chip, % right"], rows)


def _allowed(rule: Calibrated) -> str:
    return f"{100 * (rule.allowed or 0):g} %"


def rule_table(result: Anytime) -> Table:
    """Costs, differing and right decisions of each rule."""
    full = result.full
    head = ["stop when", "votes ahead", "steps", "operations", *full.costs.energy_j]
    head += [*(f"time, {name}" for name in full.costs.time_s), "differ", "right"]

    def cells(costs: StoppedCosts) -> list[str]:
        found = [f"{costs.chip_steps:.1f}", f"{costs.operations:,.0f}"]
        found += [si(costs.energy_j[name], "J") for name in full.costs.energy_j]
        return found + [si(costs.time_s[name], "s") for name in full.costs.time_s]

    def shown(count: int | None) -> str:
        return "" if count is None else str(count)

    rows = [["all is seen", "", *cells(full.costs), "", shown(full.correct)]]
    for rule in result.rules:
        name = "proven"
        ahead = "more than can come"
        if rule.stop.allowed is not None:
            whose = "held-out decisions" if result.held_out else "training races"
            name = f"sure, {_allowed(rule.stop)} of {whose}"
            ahead = f"{rule.stop.factor:.3f}·√left"
        rows.append([name, ahead, *cells(rule.mean), str(rule.differ), shown(rule.correct)])
    return Table(head, rows)
