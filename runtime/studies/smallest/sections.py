"""A search for people: the choice and why, what is on the front, what was dropped, and the commands that repeat it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from spikeloom.models.recordings.counts import number
from spikeloom.runtime.report.numbers import percent, si
from spikeloom.runtime.report.sections import Code, Section, Table, Text
from spikeloom.runtime.studies.smallest.choice import energy
from spikeloom.runtime.studies.smallest.results import Smallest, Tried


def sections(result: Smallest) -> Iterator[Section]:
    """All of a search."""
    yield Section("The choice", [Text(_why(result)), *map(Text, _beside(result))])
    last = [each for each in result.tried if each.rung == max(each.rung for each in result.tried)]
    yield Section("Candidates", [_table(result, last, "Candidates of the last rung"), Text(_dropped(result.tried))])
    yield Section("On the chip", [Text(_checked(result))])
    yield Section("Again", [Code([result.command, *result.commands])])


def _costs(each: Tried) -> list[str]:
    costs = each.costs
    assert costs is not None, "only what is priced is shown"
    times = [si(seconds, "s") for seconds in costs.time_s.values()]
    joules = [si(joules, "J") for joules in costs.energy_j.values()]
    return [*joules, *times, f"{costs.operations:,.0f}", str(costs.cores)]


def _why(result: Smallest) -> str:
    """The choice, how good it is expected to be, and what it was held against."""
    chosen, best, choice = result.chosen, result.candidate(result.choice.best), result.choice
    data = result.data
    lines = [
        f"{len(result.tried)} candidates, by cross-validation in {data.train} training recordings; the test split is "
        "looked at in the end",
    ]
    if choice.budgets:
        fit = "" if choice.fits else ": no candidate fits; the nearest is taken"
        lines.append(f"budget: {' and '.join(choice.budgets)}{fit}")
    share = f"{100 * chosen.accuracy:.1f} % (95 % interval {100 * chosen.low:.1f} … {100 * chosen.high:.1f})"
    lines.append(f"take #{chosen.number} {chosen.candidate.name}: {share}, {_joules(chosen)}")
    if chosen.number == best.number:
        lines.append("  the best, and none that is cheaper is as good")
    else:
        lines.append(
            f"  the best, #{best.number} {best.candidate.name}, has {100 * best.accuracy:.1f} % for {_joules(best)}; "
            f"it is {100 * chosen.behind:.1f} ± {100 * chosen.behind_error:.1f} points ahead, recording by recording"
        )
    return "\n".join(lines)


def _joules(each: Tried) -> str:
    assert each.costs is not None, "only what is priced is shown"
    return ", ".join(f"{si(joules, 'J')} ({table})" for table, joules in each.costs.energy_j.items())


def _beside(result: Smallest) -> Iterator[str]:
    """Where another table disagrees, and what the next point of accuracy costs."""
    chosen = result.chosen
    for table, index in result.choice.cheapest.items():
        if index != chosen.number:
            other = result.candidate(index)
            yield f"  by the table {table} it would be #{index} {other.candidate.name}, {_joules(other)}"
    if result.choice.ahead is None:
        yield "  no candidate is a point better"
    else:
        ahead = result.candidate(result.choice.ahead)
        times = energy(ahead) / energy(chosen)
        yield (
            f"  a point more, {100 * ahead.accuracy:.1f} %, costs {times:.1f} times the energy: "
            f"#{ahead.number} {ahead.candidate.name}"
        )


def _table(result: Smallest, tried: Sequence[Tried], caption: str) -> Table:
    tables = [f"energy ({name})" for name in result.choice.cheapest]
    times = [f"time ({name})" for name in result.tables["time"]]
    head = ["#", "candidate", "accuracy %", "interval", "behind the best", *tables, *times, "operations", "cores", ""]
    rows = []
    for each in sorted(tried, key=lambda each: each.costs.least if each.costs else 0.0):
        marks = [
            *(["front"] if each.front else []),
            *(["best"] if each.number == result.choice.best else []),
            *(["choice"] if each.number == result.chosen.number else []),
        ]
        rows.append(
            [
                f"#{each.number}",
                each.candidate.name,
                f"{100 * each.accuracy:.1f}",
                f"{100 * each.low:.1f} … {100 * each.high:.1f}",
                f"{100 * each.behind:.1f} ± {100 * each.behind_error:.1f}",
                *_costs(each),
                ", ".join(marks),
            ]
        )
    return Table(head, rows, caption)


def _dropped(tried: Sequence[Tried]) -> str:
    """How many stayed behind, by rung."""
    last = max(each.rung for each in tried)
    counts = Counter((each.rung, each.candidate.system) for each in tried if each.rung < last)
    lines = [f"dropped on rung {rung}: {count} of {system}" for (rung, system), count in sorted(counts.items())]
    refused = [each for each in tried if each.refused]
    if refused:
        lines.append(f"{number(len(refused), 'candidate')} the chip does not hold; the first: {refused[0].refused}")
    return "\n".join(lines)


def _checked(result: Smallest) -> str:
    """What the choice reaches, trained on all of the training split."""
    checked, data = result.checked, result.data
    equal = (
        f"{checked.equal['train']} of {data.train} training and {checked.equal['test']} of {data.test} test decisions"
    )
    return "\n".join(
        [
            f"chip accuracy on the test split: {percent(checked.right.correct, data.test)}",
            f"float model and chip: {checked.different:,} spikes differ in training; equal are {equal}",
            f"written: {checked.network}, sha256 {checked.network_sha256}",
            f"written: {checked.netlist}, sha256 {checked.netlist_sha256}",
        ]
    )
