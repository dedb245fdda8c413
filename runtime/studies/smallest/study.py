"""The smallest network for some recordings: candidates by successive halving, a choice, and what that reaches.

On the first rung every candidate is cross-validated once at one strength; what may still be chosen goes on,
with more strengths, and from there to five rounds. Everything happens on the training split but the last
look at the choice. Taken is the cheapest that is not shown to be worse than the best.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.jobs import sweep
from spikeloom.runtime.studies.search.budgets import SHARES, Budget, excess
from spikeloom.runtime.studies.search.choice import NEAR, choose, front, is_worse, lead
from spikeloom.runtime.studies.search.results import Data, chosen_by, titles_of
from spikeloom.runtime.studies.smallest import work
from spikeloom.runtime.studies.smallest.baselines import baselines
from spikeloom.runtime.studies.smallest.results import Checked, Choice, Smallest, Tried
from spikeloom.runtime.studies.smallest.space import Candidate, variants
from spikeloom.runtime.studies.smallest.trained import Sensor
from spikeloom.runtime.studies.smallest.work import RUNGS, Measured

POINT = 0.01
"""Accuracy whose price is told."""

LIMITS = ("energy", "time", "operations", "cores", "accuracy", "certified")
"""What ``--budget`` limits."""

KEPT = {1: 20, 2: 14}
"""Candidates that go on from a rung."""

VARIED = {1: 12, 2: 4}
"""Those of them, the first, of which variants go on, too."""

BEST = 50
"""How much more it weighs to be behind a cheaper one than behind the best: the front goes on, down to cheap ones."""

SLACK = 1.25
"""Factor by which a candidate may miss a budget on an early rung: a variant may fit."""


def smallest(
    candidates: Iterable[Candidate],
    data: Data,
    target: Target,
    budgets: Sequence[Budget],
    store: Path,
    make: Callable[[Candidate], tuple[Checked, tuple[str, ...]]],
    *,
    sensor: Sensor,
    command: str,
    jobs: int | None = None,
) -> Smallest:
    """Search as far as the store does not know, choose, and `make` the choice: train, compile and verify it.

    `command` repeats it; `make` also gives the commands that do what it does.
    """
    certify = any(budget.what == "certified" for budget in budgets)
    trial = partial(work.trial, data=data, sensor=sensor, target=target.name, certify=certify)
    on = partial(promote, budgets=budgets)
    beside = search(baselines(), most_accurate, trial, store, jobs=jobs)
    tried = search(candidates, on, trial, store, jobs=jobs)
    taken = pick(tried, budgets)
    best = tried[taken.best - 1]
    tried = [_beside(each, best, tried) for each in tried]
    by = chosen_by(target)
    checked, commands = make(tried[taken.cheapest[by.energy] - 1].candidate)
    return Smallest(
        spikeloom=__version__,
        command=command,
        target=target.name,
        data=data,
        tables=titles_of(target),
        chosen_by=by,
        tried=tuple(tried),
        baselines=tuple(_beside(each, best, ()) for each in beside),
        choice=taken,
        checked=checked,
        commands=commands,
    )


def search(
    candidates: Iterable[Candidate],
    promote: Callable[[Sequence[Tried], int], Sequence[Tried]],
    trial: Callable[[Candidate, int, float | None], work.Trial],
    store: Path,
    *,
    jobs: int | None,
) -> list[Tried]:
    """All candidates, as far as each came; `promote` chooses those that go on from a rung."""
    known: dict[str, Tried] = {}
    # By name, with the setting that the rung before has chosen
    alive: dict[str, tuple[Candidate, float | None]] = {each.name: (each, None) for each in candidates}
    for rung in range(1, RUNGS + 1):
        works = [trial(each, rung, setting) for each, setting in alive.values()]
        found = sweep(works, work.measure, store, jobs=jobs, label=f"rung {rung} of {RUNGS}", kind=Measured)
        for job in works:
            number = known[job.label].number if job.label in known else len(known) + 1
            known[job.label] = _tried(number, job, found[job.key])
        if rung < RUNGS:
            on = promote([known[name] for name in alive], rung)
            alive = {each.candidate.name: (each.candidate, each.setting) for each in on}
            for each in on[: VARIED[rung]]:
                alive |= {other.name: (other, each.setting) for other in variants(each.candidate, rung)}
    return list(known.values())


def most_accurate(tried: Sequence[Tried], rung: int) -> list[Tried]:
    """Baselines that go on from a rung: three of each kind, then one."""
    ordered = sorted(tried, key=lambda each: -each.accuracy)
    kinds = dict.fromkeys(each.candidate.system for each in tried)
    return [
        each
        for kind in kinds
        for each in [e for e in ordered if e.candidate.system == kind][: {1: 3, 2: 1}[rung]]
    ]


def _tried(number: int, trial: work.Trial, measured: Measured) -> Tried:
    about = {each.name: getattr(measured, each.name) for each in fields(measured)}
    recordings = int(np.count_nonzero(measured.tried))
    right = accuracy(measured)
    low, high = wilson(right * recordings, recordings)
    about |= {"number": number, "candidate": trial.candidate, "rung": trial.rung}
    return Tried(**about, accuracy=right, low=low, high=high)


def accuracy(measured: Measured) -> float:
    """Share of right decisions, over recordings that were decided at all, each with the same weight."""
    return float(np.nanmean(measured.shares)) if any(measured.tried) else 0.0


def _beside(each: Tried, best: Tried, tried: Sequence[Tried]) -> Tried:
    """A candidate with what the best has ahead of it, and whether it is on the front of those that came as far."""
    behind, error = lead(best.shares, each.shares)
    peers = [other for other in tried if other.rung == each.rung and other.costs is not None]
    marks = front([other.accuracy for other in peers], [energy(other) for other in peers])
    on = any(mark and other.number == each.number for mark, other in zip(marks, peers, strict=True))
    return replace(each, behind=behind, behind_error=error, front=on)


def promote(tried: Iterable[Tried], rung: int, budgets: Sequence[Budget] = ()) -> list[Tried]:
    """Those that may still be chosen: least behind a cheaper one, or, which weighs less, behind the best.

    Where budgets are nearly met by any, those alone go on.
    """
    priced = [each for each in tried if each.costs is not None]
    limits = [budget for budget in budgets if budget.what not in SHARES]
    able = [
        each for each in priced if all(excess(values(each), budget) <= SLACK for budget in limits)
    ] or priced
    top = max((each.accuracy for each in able), default=0.0)

    def lag(each: Tried) -> float:
        cheaper = max(other.accuracy for other in able if energy(other) <= energy(each))
        return cheaper - each.accuracy + (top - each.accuracy) / BEST

    return sorted(able, key=lambda each: (lag(each), energy(each)))[: KEPT[rung]]


def energy(tried: Tried, table: str | None = None) -> float:
    """Joules of a mean inference, by the first table unless another is named; operations where none prices them."""
    assert tried.costs is not None, "what the chip does not hold has no price"
    return tried.costs.least if table is None else tried.costs.energy_j[table]


def pick(tried: Sequence[Tried], budgets: Sequence[Budget]) -> Choice:
    """The cheapest of the last rung, by each table, that fits the budgets and is not shown to be worse than the best.

    Worse is one whose accuracy is lower by more than a standard error of the difference, recording by
    recording. Where an accuracy is wanted, all that reach it are good enough. Where no candidate of the last
    rung fits, earlier ones may.
    """
    priced = [each for each in tried if each.costs is not None]
    if not priced:
        raise OptionError(f"the chip holds no candidate; the first: {tried[0].refused}")
    pool = [each for each in priced if each.rung == RUNGS]
    selection = choose(pool, values, worse, budgets)
    if not selection.fitting:
        earlier = choose(priced, values, worse, budgets)
        selection = earlier if earlier.fitting else selection
    allowed = selection.allowed
    assert selection.best.costs is not None, "all of these are priced"
    tables = list(selection.best.costs.energy_j)
    cheapest = {
        table: min(allowed, key=lambda each: (energy(each, table), -each.accuracy)).number
        for table in tables
    }
    chosen = next(each for each in allowed if each.number == cheapest[tables[0]])
    above = [each for each in pool if each.accuracy >= chosen.accuracy + POINT - NEAR]
    return Choice(
        budgets=tuple(budget.words for budget in budgets),
        fits=bool(selection.fitting),
        best=selection.best.number,
        cheapest=cheapest,
        allowed=tuple(each.number for each in allowed),
        ahead=min(above, key=energy).number if above else None,
    )


def worse(best: Tried, other: Tried) -> bool:
    """Whether one is shown to be worse than another."""
    return is_worse(best.shares, other.shares)


def values(tried: Tried) -> dict[str, float]:
    """What budgets limit."""
    costs = tried.costs
    assert costs is not None, "what the chip does not hold has no price"
    known = {"energy": costs.least, "operations": costs.operations, "cores": float(costs.cores)}
    known |= {"accuracy": tried.accuracy, "certified": tried.certified or 0.0}
    return known | ({"time": next(iter(costs.time_s.values()))} if costs.time_s else {})
