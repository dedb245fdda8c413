"""A search for people: the choice and why, the front, what was dropped, baselines, and the commands that repeat it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report import html
from spikeloom.runtime.report.drawing import COLOURS, GREY, MARKERS, Drawing, scale, sheet, styled
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Code, Details, Figure, Section, Table, Text
from spikeloom.runtime.studies.smallest import baselines
from spikeloom.runtime.studies.smallest.choice import energy, worse
from spikeloom.runtime.studies.smallest.results import RUNGS, Smallest, Tried

LOWER = 12
"""Points below the last rung's intervals that are drawn."""

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEANINGS = (
    "Accuracy by cross-validation inside the training split, with 95 % intervals (Wilson). Small marks were dropped "
    "before the last rung, the dashed line is its front, the ring the choice. Bars are support vector machines: on a "
    "small processor they take between arithmetic and memory accesses alone, and an instruction for every operation."
)


def sections(result: Smallest) -> Iterator[Section]:
    """All of a search."""
    tried = sorted((each for each in result.tried if each.rung == RUNGS), key=energy)
    beside = [each for each in result.baselines if each.rung == RUNGS]
    dropped = [each for each in (*result.tried, *result.baselines) if each.rung < RUNGS]
    dropped.sort(key=lambda each: (-each.rung, -each.accuracy))
    yield Section("The choice", [*map(Text, [*_why(result), *_needless(result)])])
    figure = Figure("front", partial(picture, result), "Accuracy over energy and time of a mean inference.")
    yield Section("Accuracy against cost", [figure, Details("What is drawn", [Text(MEANINGS)], unfolded=True)])
    yield Section(
        "Candidates",
        [
            _table(result, [*tried, *beside], "Candidates of the last rung, cheapest first, then baselines"),
            Text("\n".join(_dropped(result, dropped))),
            Details("All that was dropped", [_table(result, dropped, "Candidates of earlier rungs", 0)]),
        ],
    )
    yield Section("On the chip", [Text(_checked(result))])
    yield Section("Again", [Code([result.command, *result.commands]), Text(baselines.SOURCE)])


def page(result: Smallest) -> str:
    """The same as one HTML file."""
    name = result.data.path.rstrip("/").rsplit("/", 1)[-1]
    return html.page(f"The smallest network for {name}", "Point at a mark to read its figures.", sections(result))


# -- the choice --------------------------------------------------------------------------------------------------------


def _joules(each: Tried) -> str:
    assert each.costs is not None, "only what is priced is shown"
    return ", ".join(f"{si(joules, 'J')} ({table})" for table, joules in each.costs.energy_j.items())


def _share(each: Tried) -> str:
    return f"{100 * each.accuracy:.1f} %"


def _why(result: Smallest) -> Iterator[str]:
    """The choice, what it was held against, where tables disagree, and what the next point of accuracy costs."""
    chosen, best, choice = result.chosen, result.candidate(result.choice.best), result.choice
    yield (
        f"{len(result.tried)} candidates by cross-validation in {result.data.train} training recordings; the test "
        "split is looked at once, in the end"
    )
    if choice.budgets:
        yield f"budget: {' and '.join(choice.budgets)}{'' if choice.fits else ': nothing fits, the nearest is taken'}"
    interval = f"95 % interval {100 * chosen.low:.1f} … {100 * chosen.high:.1f}"
    yield f"take #{chosen.number} {chosen.candidate.name}: {_share(chosen)} ({interval}), {_joules(chosen)}"
    if chosen.number == best.number:
        yield "it is the best of them, and nothing cheaper is as good"
    else:
        yield (
            f"the best, #{best.number} {best.candidate.name}, has {_share(best)} for {_joules(best)}; recording by "
            f"recording it is {_behind(chosen)} points ahead"
        )
    for table, index in choice.cheapest.items():
        if index != chosen.number:
            other = result.candidate(index)
            yield f"by the table {table} it would be #{index} {other.candidate.name}, {_joules(other)}"
    if choice.ahead is None:
        yield "no candidate is a point more accurate"
    else:
        ahead = result.candidate(choice.ahead)
        times = f"{energy(ahead) / energy(chosen):.1f} times the energy"
        yield f"a point more costs {times}: #{ahead.number} {ahead.candidate.name}, {_share(ahead)}, {_joules(ahead)}"


def _behind(each: Tried) -> str:
    return f"{100 * each.behind:.1f} ± {100 * each.behind_error:.1f}"


def _needless(result: Smallest) -> Iterator[str]:
    """Whether a processor does the job as well: the best of the baselines, and the cheapest that is no worse."""
    last = [each for each in result.baselines if each.processor and each.rung == RUNGS]
    if not last:
        yield baselines.MISSING
        return
    chosen = result.chosen
    enough = [each for each in last if not worse(chosen, each)]
    each = min(enough or last, key=lambda each: each.processor.most_j if each.processor and enough else -each.accuracy)
    assert each.processor is not None, "these are priced"
    costs = each.processor
    words = f"{each.candidate.name}, {_share(each)}, {si(costs.least_j, 'J')} … {si(costs.most_j, 'J')} on a processor"
    if not enough:
        yield f"without spikes: the best is {words}; that is shown to be worse"
    elif costs.most_j < energy(chosen):
        yield f"no spiking network is needed here: {words}, is not shown to be worse, and takes less in any case"
    elif costs.least_j < energy(chosen):
        yield f"without spikes: {words}, is not shown to be worse; whether it takes less depends on the processor"
    else:
        yield f"without spikes: {words}, is not shown to be worse, but takes more"


# -- tables ------------------------------------------------------------------------------------------------------------


def _table(result: Smallest, tried: Sequence[Tried], caption: str, most: int | None = None) -> Table:
    """Candidates by the first tables of energy and time; of baselines what a processor takes at least and at most."""
    by = result.chosen_by
    head = ["#", "candidate", "accuracy %", "interval", "behind the best", f"energy ({by.energy})"]
    head += [] if by.time is None else [f"time ({by.time})"]
    chosen, best, rows = result.chosen, result.candidate(result.choice.best), []
    for each in tried:
        mark = f"#{each.number}" if each.processor is None else "–"
        marks = {mark: True, "choice": each is chosen, "best": each is best, "front": each.front}
        row = [
            " ".join(name for name, on in marks.items() if on),
            each.candidate.name,
            f"{100 * each.accuracy:.1f}",
            f"{100 * each.low:.1f} … {100 * each.high:.1f}",
            _behind(each),
        ]
        timed = by.time is not None
        if (costs := each.costs) is not None:
            row += [si(energy(each), "J"), *([si(costs.time_s[str(by.time)], "s")] if timed else [])]
            row += [f"{costs.operations:,.0f}", str(costs.cores)]
        elif (plain := each.processor) is not None:
            row += [f"{si(plain.least_j, 'J')} … {si(plain.most_j, 'J')}", *(["–"] if timed else [])]
            row += [f"{plain.events + plain.products:,.0f}", "processor"]
        else:
            row += ["–"] * (3 + timed)
        rows.append(row)
    return Table([*head, "operations", "cores"], rows, caption, most=most)


def _dropped(result: Smallest, dropped: Sequence[Tried]) -> Iterator[str]:
    """How many stayed behind on each rung, and what the chip does not hold."""
    counts = Counter((each.rung, each.candidate.system) for each in dropped)
    for rung in sorted({rung for rung, _ in counts}):
        words = ", ".join(f"{count} {system}" for (at, system), count in sorted(counts.items()) if at == rung)
        yield f"dropped after rung {rung}, since a cheaper one is ahead: {words}"
    refused = [each for each in result.tried if each.refused]
    if refused:
        first = f"{refused[0].candidate.name}: {refused[0].refused}"
        yield f"the chip does not hold {number(len(refused), 'candidate')}; the first is {first}"


def _checked(result: Smallest) -> str:
    """What the choice reaches, trained on all of the training split."""
    checked, data = result.checked, result.data
    equal = f"{checked.equal['train']} of {data.train} in training and {checked.equal['test']} of {data.test} on test"
    return "\n".join(
        [
            f"chip accuracy on the test split: {percent(checked.right.correct, data.test)}",
            f"float model and chip: {checked.different:,} spikes differ in training; decisions equal: {equal}",
            f"written: {checked.network}, sha256 {checked.network_sha256}",
            f"written: {checked.netlist}, sha256 {checked.netlist_sha256}",
        ]
    )


# -- the figure --------------------------------------------------------------------------------------------------------


@styled
def picture(result: Smallest) -> Drawing:
    """Accuracy over energy and, where the chip has a time table, over time."""
    by = result.chosen_by
    drawing = sheet("Accuracy of candidates over energy and time", 4.6)
    panels = drawing.figure.subplots(1, 1 if by.time is None else 2, squeeze=False, sharey=True)[0]
    _panel(drawing, panels[0], result, "J")
    panels[0].set(xlabel=f"energy of a mean inference ({by.energy})", ylabel="accuracy by cross-validation (%)")
    if by.time is not None:
        _panel(drawing, panels[1], result, "s")
        panels[1].set_xlabel(f"time of a mean inference on the chip ({by.time})")
    drawing.figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return drawing


def _panel(drawing: Drawing, panel: Axes, result: Smallest, unit: str) -> None:
    """One cost: joules, with the baselines, or seconds."""
    from matplotlib.ticker import LogLocator, NullFormatter

    def cost(each: Tried) -> float:
        assert each.costs is not None, "only what is priced is drawn"
        return energy(each) if unit == "J" else each.costs.time_s[str(result.chosen_by.time)]

    priced = [each for each in result.tried if each.costs is not None]
    for index, system in enumerate(dict.fromkeys(each.candidate.system for each in priced)):
        colour, marker = COLOURS[index], MARKERS[index]
        for last, size, alpha, name in ((False, 9, 0.35, f"{system}, dropped"), (True, 34, 1.0, system)):
            members = [each for each in priced if each.candidate.system == system and (each.rung == RUNGS) is last]
            if members:
                x, y = [cost(each) for each in members], [100 * each.accuracy for each in members]
                panel.scatter(x, y, size, marker=marker, color=colour, alpha=alpha, linewidths=0, label=name, zorder=3)
            if members and last:
                low, high = [100 * each.low for each in members], [100 * each.high for each in members]
                panel.vlines(x, low, high, color=colour, alpha=0.5, lw=1.0, zorder=2)
    front = sorted((cost(each), 100 * each.accuracy) for each in priced if each.rung == RUNGS and each.front)
    panel.step(*zip(*front, strict=True), where="post", color=GREY, lw=1.0, ls=(0, (5, 2)), label="front", zorder=1)
    chosen = result.chosen
    at = cost(chosen), 100 * chosen.accuracy
    panel.plot(*at, "o", ms=13, mfc="none", mec=COLOURS[4], mew=1.8, ls="none", label="choice", zorder=5)
    drawing.tips += [(panel, cost(each), 100 * each.accuracy, _tip(each)) for each in sorted(priced, key=cost)]
    if unit == "J":
        _processors(drawing, panel, result)
    shown = [each for each in (*result.tried, *result.baselines) if each.rung == RUNGS]
    panel.set_ylim(100 * min(each.low for each in shown) - LOWER, min(100, 100 * max(each.high for each in shown) + 2))
    panel.set_xscale("log")
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if unit == "s" else (1,)))
    panel.xaxis.set_minor_formatter(NullFormatter())
    scale(panel.xaxis, unit)
    panel.grid(True)


def _processors(drawing: Drawing, panel: Axes, result: Smallest) -> None:
    """Baselines of the last rung, between what they take on a processor at least and at most."""
    for index, each in enumerate(each for each in result.baselines if each.rung == RUNGS):
        if (costs := each.processor) is not None:
            x, y, colour = [costs.least_j, costs.most_j], 100 * each.accuracy, COLOURS[2 + index % 2]
            panel.plot(x, [y, y], color=colour, lw=3.0, alpha=0.8, label=each.candidate.system, zorder=4)
            drawing.tips += [(panel, joules, y, _tip(each)) for joules in x]


def _tip(each: Tried) -> str:
    share = f"{_share(each)} ({100 * each.low:.1f} … {100 * each.high:.1f})"
    if each.processor is not None:
        return f"{each.candidate.name}: {share}, {si(each.processor.least_j, 'J')} … {si(each.processor.most_j, 'J')}"
    assert each.costs is not None, "only what is priced is drawn"
    times = [f"{si(seconds, 's')} ({name})" for name, seconds in each.costs.time_s.items()]
    size = f"{each.costs.operations:,.0f} synaptic operations, {number(each.costs.cores, 'core')}"
    return (
        f"#{each.number} {each.candidate.name}: {share}, {', '.join([_joules(each), *times, size])}, rung {each.rung}"
    )
