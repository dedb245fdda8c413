"""A search for people: the choice and why, the front, what was dropped, baselines, and the commands that repeat it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report import html
from spikeloom.runtime.report.drawing import COLOURS, Drawing, sheet, styled
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Block, Code, Details, Figure, Section, Table, Text
from spikeloom.runtime.studies.processor import price_table
from spikeloom.runtime.studies.search.picture import Mark, draw_front
from spikeloom.runtime.studies.smallest import baselines
from spikeloom.runtime.studies.smallest.results import Smallest, Tried
from spikeloom.runtime.studies.smallest.study import FAR, energy, worse
from spikeloom.runtime.studies.smallest.work import RUNGS

LOWER = 12
"""Points below the last rung's intervals that are drawn."""

MEANINGS = (
    "Accuracy by cross-validation inside the training split, with 95 % intervals (Wilson); conditions of the "
    "recordings are left out in turn, if they have any. Small marks were dropped "
    "before the last rung, the line is its front, the ring the choice. Where the chip can be stopped, costs are "
    "those until the decision is proven; none changes. Bars are classifiers without spikes, on a small processor "
    "between arithmetic and memory accesses alone, and all cycles of one that can be bought."
)


def sections(result: Smallest) -> Iterator[Section]:
    """All of a search."""
    every = [*sorted(result.tried, key=lambda each: energy(each) if each.costs else 0.0), *result.baselines]
    last = [each for each in every if each.rung >= RUNGS]
    dropped = sorted(
        (each for each in every if each.rung < RUNGS), key=lambda each: (-each.rung, -each.accuracy)
    )
    yield Section("The choice", [*map(Text, [*_why(result), _needless(result)])])
    figure = Figure("front", partial(picture, result), "Accuracy over energy of a mean inference.")
    yield Section(
        "Accuracy against cost", [figure, Details("What is drawn", [Text(MEANINGS)], unfolded=True)]
    )
    lines = [f"dropped before the last rung: {number(len(dropped), 'candidate')}"]
    if refused := [each for each in result.tried if each.refused]:
        first = f"{refused[0].candidate.name}: {refused[0].refused}"
        lines.append(f"{number(len(refused), 'candidate')} cannot be had; the first is {first}")
    blocks: list[Block] = [
        _table(result, last, "Candidates of the last rung, cheapest first, then baselines"),
        Text("\n".join(lines)),
        Details("All that was dropped", [_table(result, dropped, "Candidates of earlier rungs", 0)]),
    ]
    yield Section("Candidates", blocks)
    yield Section("On the chip", [Text(_checked(result))])
    yield Section("Again", [Code([result.command, *result.commands]), price_table()])


def page(result: Smallest) -> str:
    """The same as one HTML file."""
    name = result.data.path.rstrip("/").rsplit("/", 1)[-1]
    return html.page(
        f"The smallest network for {name}", "What was tried, what was taken, and why.", sections(result)
    )


def _spent(each: Tried) -> str:
    """Joules by each table, of a baseline at least and at most."""
    if (plain := each.processor) is not None:
        return f"{si(plain.least_j, 'J')} … {si(plain.most_j, 'J')}"
    costs = {} if each.costs is None else each.costs.energy_j
    return ", ".join(f"{si(joules, 'J')} ({table})" for table, joules in costs.items())


def _named(each: Tried) -> str:
    return f"#{each.number} {each.candidate.name}: {100 * each.accuracy:.1f} %"


def _interval(each: Tried) -> str:
    return f"{100 * each.low:.1f} … {100 * each.high:.1f}"


def _behind(each: Tried) -> str:
    return f"{100 * each.behind:.1f} ± {100 * each.behind_error:.1f}"


def _tip(each: Tried) -> str:
    return f"{_named(each)} ({_interval(each)}), {_spent(each)}"


def _why(result: Smallest) -> Iterator[str]:
    """The choice, what it was held against, where tables disagree, and what the next point of accuracy costs."""
    chosen, best, choice = result.chosen, result.candidate(result.choice.best), result.choice
    yield (
        f"{len(result.tried)} candidates by cross-validation in {result.data.train} training recordings; the test "
        "split is looked at once, in the end"
    )
    if choice.budgets:
        yield f"budget: {' and '.join(choice.budgets)}{'' if choice.fits else ': nothing fits, the nearest is taken'}"
    if chosen.certified is not None:
        yield f"no single event alters {100 * chosen.certified:.1f} % of its decisions on held-out training recordings"
    whole = f"; to the end {_spent(replace(chosen, costs=chosen.whole))}" if chosen.whole else ""
    yield f"take {_named(chosen)} (95 % interval {_interval(chosen)}), {_spent(chosen)}{whole}"
    if chosen.number == best.number:
        yield "it is the best of what was tried, and what is as good takes about as much or more"
    else:
        low = 100 * (chosen.behind - 1.96 * chosen.behind_error)
        high = 100 * (chosen.behind + 1.96 * chosen.behind_error)
        ahead = f"recording by recording it is {100 * chosen.behind:.1f} % ahead (95 % interval {low:.1f} … {high:.1f})"
        yield f"the best is {_named(best)} for {_spent(best)}; {ahead}"
    for table, index in choice.cheapest.items():
        if index != chosen.number:
            other = result.candidate(index)
            yield f"by the table {table} it would be {_named(other)}, {_spent(other)}"
    if choice.ahead is None:
        yield "nothing that was tried is 1 % more accurate"
    else:
        more = result.candidate(choice.ahead)
        times = energy(more) / energy(chosen)
        yield f"1 % more accuracy costs {times:.1f} times the energy: {_named(more)}, {_spent(more)}"
    if choice.cheaper is not None:
        less = result.candidate(choice.cheaper)
        yield f"for at most two thirds of the energy: {_named(less)}, {_spent(less)}"
    yield from _conditions(result)
    yield _unfinished(result)


def _unfinished(result: Smallest) -> str:
    """Which systems were tried to the end: cross-validated on all folds until more epochs no longer helped."""
    lines = []
    for family in result.families:
        best = result.candidate(family.best)
        known = f"{_named(best)} after {number(int(best.setting), 'epoch')}"
        if family.system == COUNTING:
            continue
        if best.refused:
            lines.append(f"{family.system}: not tried ({best.refused})")
        elif family.finished:
            lines.append(f"{family.system}: tried to the end, the best is {known}")
        else:
            why = "more epochs still helped" if best.finished is False else _left(best, result.tried)
            lines.append(f"{family.system}: not tried to the end, {known}: {why}")
    if result.untried:
        more = f" and {number(len(result.untried) - 1, 'other')}" if len(result.untried) > 1 else ""
        lines.append(f"not tried, time was short: {result.untried[0]}{more}")
    return "\n".join(lines) if lines else "not tried: networks trained by gradients"


def _left(each: Tried, tried: Sequence[Tried]) -> str:
    """Why a network was trained no longer."""
    top = max(accuracy for other in tried for epochs, accuracy in other.curve if epochs == each.setting)
    if top > each.accuracy + FAR:
        return f"{100 * (top - each.accuracy):.1f} % behind the best then, it went no further"
    return "time was short"


def _conditions(result: Smallest) -> Iterator[str]:
    """What was left out in turn, where the choice is worst, and what parts at random say."""
    if not result.conditions:
        yield (
            "conditions not seen in training were not tested: the recordings have no groups (--groups), and parts at "
            "random were left out"
        )
        return
    chosen = result.chosen
    shares = sorted(chosen.conditions.items(), key=lambda pair: pair[1])
    yield (
        f"left out in turn: {', '.join(result.conditions)}; of these the choice is worst at {shares[0][0]} "
        f"({100 * shares[0][1]:.1f} %) and best at {shares[-1][0]} ({100 * shares[-1][1]:.1f} %)"
    )
    groups: dict[str, dict[str, float]] = {}
    for name, share in chosen.conditions.items():
        group, value = name.split("=", 1)
        groups.setdefault(group, {})[value] = share
    new = (
        f"{100 * sum(known.values()) / len(known):.1f} % where {group} is new"
        for group, known in groups.items()
    )
    yield f"expect {', '.join(new)}"
    if result.at_random is not None:
        yield f"where all conditions are known it reaches {100 * result.at_random:.1f} %, by parts at random"
    for group, known in groups.items():
        yield from _beyond(group, known)


def _beyond(group: str, known: Mapping[str, float]) -> Iterator[str]:
    """What lies beyond the values of a group that are numbers, and the shares of right decisions at their ends.

    >>> next(_beyond("speed", {"10": 0.5, "9": 0.75}))
    'not tested: speed below 9 or above 10; at these ends, when they are new, 75.0 and 50.0 %: expect less beyond'
    """
    try:
        ends = sorted(known, key=float)[:: max(1, len(known) - 1)]
    except ValueError:
        return
    if len(ends) > 1:
        shares = " and ".join(f"{100 * known[end]:.1f}" for end in ends)
        yield (
            f"not tested: {group} below {ends[0]} or above {ends[-1]}; at these ends, when they are new, "
            f"{shares} %: expect less beyond"
        )


def _needless(result: Smallest) -> str:
    """Whether a processor does the job as well: the best of the baselines, and the cheapest that is no worse."""
    last = [(each, each.processor) for each in result.baselines if each.processor and each.rung >= RUNGS]
    if not last:
        return baselines.MISSING
    enough, joules = [pair for pair in last if not worse(result.chosen, pair[0])], energy(result.chosen)
    each, costs = (
        min(enough, key=lambda pair: pair[1].most_j) if enough else max(last, key=lambda p: p[0].accuracy)
    )
    words = f"{each.candidate.name}, {100 * each.accuracy:.1f} %, {_spent(each)} on a processor"
    if not enough:
        return f"without spikes: the best is {words}; that is shown to be worse"
    if costs.most_j < joules:
        return f"no spiking network is needed here: {words}, is not shown to be worse, and takes less in any case"
    rest = (
        "; whether it takes less depends on the processor" if costs.least_j < joules else ", but takes more"
    )
    return f"without spikes: {words}, is not shown to be worse{rest}"


def _table(result: Smallest, tried: Sequence[Tried], caption: str, most: int | None = None) -> Table:
    """Candidates by the first tables of energy and time; of baselines what a processor takes at least and at most."""
    by, rows = result.chosen_by, []
    for each in tried:
        costs, plain, name, spent, time = each.costs, each.processor, f"#{each.number}", "–", "–"
        size = ["–", "–"]
        if plain is not None:
            name, spent, size = "processor", _spent(each), [f"{plain.operations:,.0f}", "–"]
        elif costs is not None:
            marks = {
                "choice": each is result.chosen,
                "best": each.number == result.choice.best,
                "front": each.front,
            }
            name, spent = (
                " ".join([name, *(mark for mark, on in marks.items() if on)]),
                si(energy(each), "J"),
            )
            size = [f"{costs.operations:,.0f}", str(costs.cores)]
            time = "–" if by.time is None else si(costs.time_s[by.time], "s")
        known = [
            each.candidate.name,
            name,
            f"{100 * each.accuracy:.1f}",
            _interval(each),
            _behind(each),
            spent,
        ]
        rows.append([*known, *([] if by.time is None else [time]), *size])
    head = ["candidate", "#", "accuracy %", "95 % interval", "behind the best %", f"energy ({by.energy})"]
    head += [] if by.time is None else [f"time ({by.time})"]
    return Table([*head, "operations", "cores"], rows, caption, most=most)


def _checked(result: Smallest) -> str:
    """What the choice reaches, trained on all of the training split."""
    checked = result.checked
    different = " and ".join(f"{count:,} in {split}" for split, count in checked.different.items())
    return "\n".join(
        [
            f"chip accuracy on the test split: {percent(checked.right.correct, result.data.test)}",
            f"spikes in which network and chip differ: {different}",
            checked.pace,
            f"written: {checked.network}, sha256 {checked.network_sha256}",
            f"written: {checked.netlist}, sha256 {checked.netlist_sha256}",
        ]
    )


@styled()
def picture(result: Smallest) -> Drawing:
    """Accuracy over energy; baselines of the last rung between what they take on a processor at least and at most."""
    drawing = sheet("Accuracy of candidates over energy", 4.6)
    panel = drawing.figure.subplots()
    marks = {each.number: _mark(each) for each in result.tried if each.costs is not None}
    label = f"energy of a mean inference ({result.chosen_by.energy})"
    draw_front(drawing, panel, list(marks.values()), marks[result.chosen.number], "J", label)
    last = [each for each in result.baselines if each.rung >= RUNGS]
    for index, each in enumerate(last):
        assert each.processor is not None, "these are priced"
        ends = (each.processor.least_j, each.processor.most_j)
        height = 100 * each.accuracy
        colour = COLOURS[2 + index % 2]
        panel.hlines(height, *ends, color=colour, lw=3.0, alpha=0.8, label=each.candidate.system, zorder=4)
        drawing.tips += [(panel, joules, height, _tip(each)) for joules in ends]
    panel.autoscale(True, axis="x")
    shown = [*(each for each in result.tried if each.rung >= RUNGS), *last]
    panel.set_ylim(
        100 * min(each.low for each in shown) - LOWER, min(100, 100 * max(each.high for each in shown) + 2)
    )
    panel.set_ylabel("accuracy by cross-validation (%)")
    drawing.figure.legend(
        *panel.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8
    )
    return drawing


def _mark(each: Tried) -> Mark:
    """A candidate, large if it came to the last rung."""
    last = each.rung >= RUNGS
    return Mark(
        cost=energy(each),
        accuracy=each.accuracy,
        low=each.low,
        high=each.high,
        series=each.candidate.system,
        large=last,
        front=last and each.front,
        tip=_tip(each),
    )
