"""What ``stress`` has to say, laid out for terminals and for the page of a network, and its figure."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.files import reading
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report.conditions import UNSEEN, worst_and_best
from spikeloom.runtime.report.drawing import CHIP, FLOAT, GREY, WIDTH, Drawing, sheet, styled
from spikeloom.runtime.report.encode import read_json
from spikeloom.runtime.report.numbers import percent, wilson
from spikeloom.runtime.report.sections import Figure, Section, Table, Text, terminal
from spikeloom.runtime.studies.robustness.pair import SIDES
from spikeloom.runtime.studies.robustness.results import Curve, Spread, Stress, shown

NONE = "–"

LOOKS: dict[str, tuple[str, str, Any, float]] = {
    "float": (FLOAT, "s", (0, (5, 2)), -0.07),
    "chip": (CHIP, "o", "-", 0.07),
}
"""Colour, marker, dash and shift of a side."""

KEY = (
    "leaves: first level below the clean interval; chance: first level no better than chance; least: fewest decisions "
    "equal"
)

CURVE_KEY = """\
curves in per cent: accuracy ± 95 % interval of the mean over seeds; equal decisions; spikes in common in the layer that
has fewest of them"""


def sections(result: Stress) -> list[Section]:
    """What the page of a network shows, every curve, and requirements."""
    missed = {text.partition(": ")[0]: text for text in result.missed}
    required = [f"required {missed.get(words, f'{words}: kept')}" for words in result.required]
    return [
        *overview(result),
        Section("Key", [Text(CURVE_KEY)]),
        *(
            Section(name, [Text(_title(name, each)), _table(each)])
            for name, each in result.perturbations.items()
        ),
        Section("Required", [Text("\n".join(required))]),
    ]


def overview(result: Stress) -> list[Section]:
    """Clean accuracy, verdicts, the curves as a figure with their numbers, and what was not measured."""
    clean = result.clean
    recordings = result.recordings
    lines = [f"{side} accuracy, clean: {percent(clean.right[side], recordings)}" for side in SIDES]
    lines.append(
        f"decisions equal, clean: {clean.equal} of {recordings}; chance {100 / result.classes:.1f} %"
    )
    title = "Accuracy under each perturbation"
    caption = (
        f"{title} over its level, from mild to harsh, with 95 % intervals. Grey: interval of the clean accuracy on the "
        "chip; dotted: chance; vertical lines: where the mean leaves the clean interval."
    )
    curves = result.perturbations.items()
    numbers = [_table(each, f"{_title(name, each)}, in per cent", most=0) for name, each in curves]
    drawn = [Figure("stress", partial(figure, result, title), caption, numbers)] if numbers else []
    skipped = [Text(f"{name}: not measured, {why}") for name, why in result.not_applicable.items()]
    return [
        Section("Clean", [Text("\n".join(lines)), *_by_condition(result)]),
        Section("Verdicts", [verdicts(result), Text(KEY), *drawn]),
        Section("", skipped),
    ]


def _by_condition(result: Stress) -> list[Text | Table]:
    """Accuracies of clean recordings in each condition, the worst and the best of the chip named."""
    if not result.conditions:
        return [Text(f"the recordings have no groups: {UNSEEN}")]
    rows = []
    for name, each in result.conditions.items():
        shares = [f"{100 * each.right[side] / each.recordings:.1f}" for side in SIDES]
        rows.append([name, str(each.recordings), *shares])
    chip = {name: each.right["chip"] / each.recordings for name, each in result.conditions.items()}
    head = ["condition", "recordings", *(f"{side} %" for side in SIDES)]
    return [Text(f"chip by condition: {worst_and_best(chip)}"), Table(head, rows, "Clean, by condition")]


@styled()
def figure(result: Stress, title: str = "", *, across: int = 3) -> Drawing:
    """A panel for each perturbation: accuracies of both sides in per cent over its levels, with their intervals."""
    panels = result.perturbations.items()
    across = max(min(across, len(panels)), 1)
    down = max(-(-len(panels) // across), 1)
    drawing = sheet(title, 2.3 * down + 0.4, width=max(WIDTH, 3.2 * across))
    rows = drawing.figure.subplots(down, across, squeeze=False, sharey=True)
    for axes in rows.flat[len(panels) :]:
        axes.set_visible(False)
    low, high = wilson(result.clean.right["chip"], result.recordings)
    for axes, (name, curve) in zip(rows.flat, panels, strict=False):
        axes.axhspan(100 * low, 100 * high, color=GREY, alpha=0.2, lw=0)
        axes.axhline(100 / result.classes, color=GREY, ls=":", lw=1)
        for side in SIDES:
            _curve(drawing, axes, name, curve, side)
        axes.set_xticks(range(len(curve.levels)), [shown(point.level) for point in curve.levels], fontsize=7)
        axes.set(
            xlim=(-0.5, len(curve.levels) - 0.5),
            ylim=(-3, 103),
            title=_heading(name, curve),
            xlabel=curve.unit,
        )
        axes.grid(axis="y")
    handles, labels = rows.flat[0].get_legend_handles_labels()
    drawing.figure.legend(handles, labels, loc="outside upper left", ncols=2)
    return drawing


def _curve(drawing: Drawing, axes: Any, name: str, curve: Curve, side: str) -> None:
    """Accuracy of a side, and a line where it leaves the clean interval."""
    colour, marker, dash, shift = LOOKS[side]
    spreads = [point.spread(side) for point in curve.levels]
    low, mean, high = 100 * np.array([(spread.low, spread.mean, spread.high) for spread in spreads]).T
    at = np.arange(len(spreads)) + shift
    reach = np.maximum([mean - low, high - mean], 0)
    look = {
        "color": colour,
        "marker": marker,
        "ls": dash,
        "ms": 3.5,
        "lw": 1.3,
        "elinewidth": 1,
        "capsize": 2,
    }
    axes.errorbar(at, mean, yerr=reach, label="float model" if side == "float" else side, **look)
    order = [point.level for point in curve.levels]
    if (leaves := curve.breaks[side].leaves) is not None:
        axes.axvline(order.index(leaves) + 2 * shift, color=colour, ls=dash, lw=1, alpha=0.6)
    for x, point, a, b, c in zip(at, curve.levels, low, mean, high, strict=True):
        tip = f"{_heading(name, curve)}; {shown(point.level)}, {side}: {b:.1f} % ({a:.1f} … {c:.1f})"
        drawing.tips.append((axes, x, b, tip))


def picture(result: Stress) -> Drawing:
    """The figure as a file has it: it says by itself what it is of."""
    about = result.provenance
    seeds = number(result.seeds, "seed")
    title = (
        f"{about.netlist} on {result.recordings} recordings of {about.data}, {seeds}; accuracy in per cent"
    )
    drawn = figure(result, title, across=5)
    drawn.figure.supxlabel(title, fontsize=9)
    return drawn


def verdicts(result: Stress) -> Table:
    """One line for each perturbation."""
    head = ["perturbation", "verdict", "leaves, float", "chip", "chance, float", "chip", "least", "why"]
    rows = []
    for name, each in result.perturbations.items():
        breaks = [each.breaks[side] for side in SIDES]
        places = [*(one.leaves for one in breaks), *(one.chance for one in breaks)]
        least = min(point.equal for point in each.levels)
        shown_places = [NONE if place is None else shown(place) for place in places]
        rows.append([name, each.verdict, *shown_places, f"{100 * least:.0f} %", why(each)])
    return Table(head, rows, "Where they break and why", words=True)


def why(curve: Curve) -> str:
    """What is to be seen on the chip where it leaves, or at chance where that says more; which side is first."""
    chip = curve.breaks["chip"]
    words = []
    if not curve.same_place:
        order = [point.level for point in curve.levels]
        places = {side: curve.breaks[side].leaves for side in SIDES}
        ranks = {side: len(order) if place is None else order.index(place) for side, place in places.items()}
        words.append("chip first" if ranks["chip"] < ranks["float"] else "float first")
    for place in (chip.chance, chip.leaves):
        seen = next((point.why["chip"] for point in curve.levels if point.level == place), ())
        if seen:
            return "; ".join([*words, *seen])
    return "; ".join([*words, *([] if chip.leaves is None else ["other spikes, as many"])])


def _title(name: str, curve: Curve) -> str:
    return f"{name}: {curve.what} ({curve.unit})"


def _heading(name: str, curve: Curve) -> str:
    return f"{name}: {curve.verdict}"


def _table(curve: Curve, caption: str = "", *, most: int | None = None) -> Table:
    """Levels side by side; accuracies of both sides, equal decisions and common spikes below."""
    points = curve.levels
    rows = [[side, *(_accuracy(point.spread(side)) for point in points)] for side in SIDES]
    rows.append(["equal", *(f"{100 * point.equal:.0f}" for point in points)])
    rows.append(["spikes", *(f"{100 * min(point.common.values()):.0f}" for point in points)])
    return Table(["", *(shown(point.level) for point in points)], rows, caption, most=most)


def _accuracy(spread: Spread) -> str:
    """Per cent, with the reach of the interval where there are several seeds."""
    mean = f"{100 * spread.mean:.0f}"
    if len(spread.values) == 1:
        return mean
    return f"{mean}±{100 * max(spread.high - spread.mean, spread.mean - spread.low):.0f}"


def read_stress(path: str, netlist: str, sha256: str) -> Stress:
    """Read what ``stress -o`` wrote about a netlist of this name and hash; refused if it cannot be shown, or is not."""
    result = read_json(Stress, Path(path), "--stress", "spikeloom stress -o")
    about = result.provenance.netlist_sha256
    if about != sha256:
        raise DataError(
            f"--stress {path}: is about a netlist of sha256 {about[:12]}…, {netlist} has {sha256[:12]}…; "
            "stress that one, or report the other"
        )
    with reading(f"--stress {path}", DataError, "write it with spikeloom stress -o"):
        terminal(overview(result))
        figure(result).file("svg")
    return result
