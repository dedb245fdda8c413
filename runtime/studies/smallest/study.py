"""The smallest network for some recordings: candidates by successive halving, a choice, and what that reaches.

On the first rung every candidate is cross-validated once at one strength; what may still be chosen goes on, with more
strengths, and from there to five rounds. Everything happens on the training split but the last look at the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.targets.base import Target
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.chart.results import ChosenBy, Data
from spikeloom.runtime.studies.fronts import Budget, front
from spikeloom.runtime.studies.jobs import sweep
from spikeloom.runtime.studies.smallest import choice, work
from spikeloom.runtime.studies.smallest.baselines import baselines
from spikeloom.runtime.studies.smallest.results import RUNGS, Checked, Smallest, Tried
from spikeloom.runtime.studies.smallest.space import Candidate, variants
from spikeloom.runtime.studies.smallest.trained import Sensor


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
    fresh: bool = False,
) -> Smallest:
    """Search as far as the store does not know, choose, and `make` the choice: train, compile and verify it.

    `command` repeats it; `make` also gives the commands that do what it does.
    """
    trial = partial(work.trial, data=data, sensor=sensor, target=target.name)
    on = partial(choice.going_on, budgets=budgets)
    beside = search(baselines(), most_accurate, trial, store, jobs=jobs, fresh=fresh)
    tried = search(candidates, on, trial, store, jobs=jobs)
    taken = choice.choose(tried, budgets)
    best = tried[taken.best - 1]
    tried = [_beside(each, best, tried) for each in tried]
    times = {table.name: table.title for table in target.time}
    by = ChosenBy(energy=next(iter(taken.cheapest)), time=next(iter(times), None))
    checked, commands = make(tried[taken.cheapest[by.energy] - 1].candidate)
    return Smallest(
        spikeloom=__version__,
        command=command,
        target=target.name,
        data=data,
        tables={"energy": {table.name: table.title for table in target.energy}, "time": times},
        chosen_by=by,
        tried=tuple(tried),
        baselines=tuple(_beside(each, best, ()) for each in beside),
        choice=taken,
        checked=checked,
        commands=commands,
    )


def search(
    candidates: Iterable[Candidate],
    going_on: Callable[[Sequence[Tried], int], Sequence[Tried]],
    trial: Callable[[Candidate, int, float | None], work.Trial],
    store: Path,
    *,
    jobs: int | None,
    fresh: bool = False,
) -> list[Tried]:
    """All candidates, as far as each came; `going_on` chooses those that go on from a rung."""
    known: dict[str, Tried] = {}
    alive: dict[str, tuple[Candidate, float | None]]  # by name, with the setting that the rung before has chosen
    alive = {each.name: (each, None) for each in candidates}
    for rung in range(1, RUNGS + 1):
        works = {name: trial(each, rung, setting) for name, (each, setting) in alive.items()}
        label = f"rung {rung} of {RUNGS}"
        points, anew = list(works.values()), fresh and rung == 1
        found = sweep(points, work.measure, store, jobs=jobs, fresh=anew, label=label, kind=work.Measured)
        for name, each in works.items():
            number = known[name].number if name in known else len(known) + 1
            known[name] = _tried(number, each.candidate, rung, found[each.key])
        if rung < RUNGS:
            on = going_on([known[name] for name in alive], rung)
            extra = [
                (other, each.setting) for each in on[: choice.VARIED[rung]] for other in variants(each.candidate, rung)
            ]
            alive = {each.name: (each, setting) for each, setting in [*((e.candidate, e.setting) for e in on), *extra]}
    return list(known.values())


def most_accurate(tried: Sequence[Tried], rung: int) -> list[Tried]:
    """Baselines that go on from a rung: three of each kind, then one."""
    ordered = sorted(tried, key=lambda each: -each.accuracy)
    kinds = dict.fromkeys(each.candidate.system for each in tried)
    return [each for kind in kinds for each in [e for e in ordered if e.candidate.system == kind][: {1: 3, 2: 1}[rung]]]


def _tried(number: int, candidate: Candidate, rung: int, measured: work.Measured) -> Tried:
    right, recordings = choice.accuracy(measured), int(np.count_nonzero(measured.tried))
    low, high = wilson(right * recordings, recordings)
    return Tried(
        number=number,
        candidate=candidate,
        rung=rung,
        accuracy=right,
        low=low,
        high=high,
        setting=measured.setting,
        costs=measured.stopped or measured.costs,
        whole=measured.costs if measured.stopped else None,
        refused=measured.refused,
        processor=measured.processor,
        measured=measured,
    )


def _beside(each: Tried, best: Tried, tried: Sequence[Tried]) -> Tried:
    """A candidate with what the best has ahead of it, and whether it is on the front of those that came as far."""
    behind, error = choice.gap(best.measured, each.measured)
    peers = [other for other in tried if other.rung == each.rung and other.costs is not None]
    marks = front([other.accuracy for other in peers], [choice.energy(other) for other in peers])
    on = any(mark and other.number == each.number for mark, other in zip(marks, peers, strict=True))
    return replace(each, behind=behind, behind_error=error, front=on)
