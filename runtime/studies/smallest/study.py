"""The smallest network for some recordings: candidates by successive halving, a choice, and what that reaches.

Counting networks are cross-validated once at one strength on the first rung; what may still be chosen goes on,
with more strengths, and from there to five rounds. Networks that are trained by gradients are trained for twice as
many epochs on each rung, from where they stopped; the best of each system goes on in any case, and those whose
learning curve still rises on the last rung get one more. What is left out in turn are conditions, if the
recordings have any. Everything happens on the training split but the last look at the choice. Taken is the
cheapest that is at most `MARGIN` behind the best and not shown to be worse; of those that take `ALIKE` more at most,
the most accurate.
"""

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.targets.base import Target
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.folds import every, folds_of
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.jobs import sweep
from spikeloom.runtime.studies.search.budgets import SHARES, Budget, excess
from spikeloom.runtime.studies.search.choice import NEAR, choose, front, lead
from spikeloom.runtime.studies.search.results import chosen_by, titles_of
from spikeloom.runtime.studies.smallest import work
from spikeloom.runtime.studies.smallest.baselines import baselines
from spikeloom.runtime.studies.smallest.results import Checked, Choice, Family, Smallest, Tried
from spikeloom.runtime.studies.smallest.space import Candidate, epochs_of, other_ways, variants
from spikeloom.runtime.studies.smallest.work import RUNGS, Measured, Scene

POINT = 0.01
"""Accuracy whose price is told."""

LIMITS = ("energy", "time", "operations", "cores", "accuracy", "certified")
"""What ``--budget`` limits."""

KEPT = {1: 20, 2: 14, 3: 14}
"""Candidates that go on from a rung."""

TRAINED = {1: 9, 2: 6, 3: 2}
"""The same of networks that are trained by gradients; beside them goes the best of each system."""

SHARES_OF_TIME = {
    "baselines": (0.05, 0.08, 0.1),
    COUNTING: (0.15, 0.2, 0.3),
    "networks": (0.5, 0.7, 0.95, 0.95),
}
"""Of the time that is given, after which a rung begins nothing new, so that every rung has its part."""

AT_RANDOM = 3
"""Parts at random that the choice is trained without, of networks that are trained by gradients, beside conditions."""

FAR = 0.1
"""Behind the best by this, 10 points, a system goes no further; the answer says that it was not tried to the end."""

MARGIN = 0.02
"""Accuracy that the choice may be behind the best, if a paired test does not show that it is worse."""

ALIKE = 0.05
"""Share of the least energy by which another may exceed it and still counts as cheap: prices are not that exact."""

CONFIDENT = 1.96
"""Standard errors of a difference that show it: 95 % of a normal distribution are within."""

VARIED = {1: 12, 2: 4}
"""Those of them, the first, of which variants go on, too."""

VARIED_NETWORKS = 2
"""Networks trained by gradients, the most accurate, beside which others go on in other bins after the first rung."""

BEST = 50
"""How much more it weighs to be behind a cheaper one than behind the best: the front goes on, down to cheap ones."""

NEAR_BEST = 2
"""The same of networks that are trained by gradients, which take long, unless a budget says how accurate is enough."""

SLACK = 1.25
"""Factor by which a candidate may miss a budget on an early rung: a variant may fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """How measurements are made: where they are kept, processes, seconds from when on, and whether they certify."""

    store: Path
    jobs: int | None
    recordings: int  # Of the training split
    begun: float  # By the monotonic clock
    seconds: float | None
    certify: bool

    def until(self, share: float = 1.0) -> float | None:
        """When no more are begun, after a share of the seconds."""
        return None if self.seconds is None else self.begun + share * self.seconds

    @property
    def time_is_up(self) -> bool:
        """Whether no more are begun."""
        until = self.until()
        return until is not None and time.monotonic() >= until

    def measure(self, works: Sequence[work.Trial], label: str, share: float = 1.0) -> dict[str, Measured]:
        """Results by key, of those that were begun before that share of the time had passed; one candidate at least."""
        until = self.until(share)
        if works and until is not None and time.monotonic() >= until:
            works, until = [each for each in works if each.label == works[0].label], self.until()
        found = sweep(
            works, work.measure, self.store, jobs=self.jobs, label=label, kind=Measured, until=until
        )
        for key, each in found.items():
            if not each.suits(self.recordings):
                raise DataError(f"{self.store}: its result {key} is of other recordings; give another store")
        return found


def smallest(
    counters: Sequence[Candidate],
    networks: Sequence[Candidate],
    scene: Scene,
    training: Recordings,
    target: Target,
    budgets: Sequence[Budget],
    store: Path,
    make: Callable[[Tried], tuple[Checked, tuple[str, ...]]],
    *,
    command: str,
    jobs: int | None = None,
    seconds: float | None = None,
) -> Smallest:
    """Search as far as the store does not know, choose, and `make` the choice: train, compile and verify it.

    After so many `seconds` nothing new is begun. `command` repeats it; `make` also gives the commands that do what
    it does.
    """
    work_on = Work(
        store=store,
        jobs=jobs,
        recordings=len(training),
        begun=time.monotonic(),
        seconds=seconds,
        certify=any(budget.what == "certified" for budget in budgets),
    )
    folds = list(every(folds_of(training, 1)))
    scene.states.mkdir(exist_ok=True)
    beside = search(baselines(), most_accurate, scene, work_on, SHARES_OF_TIME["baselines"])
    steps = int(np.median(training.step_counts))
    tried = try_all(counters, networks, len(folds), budgets, scene, work_on, steps)
    taken = pick(tried, budgets)
    best = tried[taken.best - 1]
    tried = [_beside(each, best, tried) for each in tried]
    by = chosen_by(target)
    chosen = tried[taken.cheapest[by.energy] - 1]
    names = {each.candidate.name for each in tried}
    conditions = tuple(fold.condition for fold in folds if fold.condition is not None)
    at_random = accuracy_at_random(chosen, scene, work_on) if conditions else None
    if not work_on.time_is_up:  # else the same command goes on
        shutil.rmtree(scene.states, ignore_errors=True)
    checked, commands = make(chosen)
    return Smallest(
        spikeloom=__version__,
        command=command,
        target=target.name,
        data=scene.data,
        tables=titles_of(target),
        chosen_by=by,
        conditions=conditions,
        tried=tuple(tried),
        untried=tuple(each.name for each in (*counters, *networks) if each.name not in names),
        baselines=tuple(_beside(each, best, ()) for each in beside),
        choice=taken,
        at_random=at_random,
        families=families(tried),
        checked=checked,
        commands=commands,
    )


def try_all(
    counters: Iterable[Candidate],
    networks: Sequence[Candidate],
    folds: int,
    budgets: Sequence[Budget],
    scene: Scene,
    work_on: Work,
    steps: int,
) -> list[Tried]:
    """Counting networks, then those that are trained by gradients; OptionError if time was too short for any."""
    tried = search(counters, partial(promote, budgets=budgets), scene, work_on, SHARES_OF_TIME[COUNTING])
    trained = train_all(networks, folds, budgets, scene, work_on, steps)
    tried += [replace(each, number=len(tried) + each.number) for each in trained]
    able = any(each.rung >= RUNGS and each.costs is not None for each in tried)
    if not able and not (tried and all(each.refused for each in tried)):
        raise OptionError(
            "--time: was too short for any candidate; the same command goes on, give it longer"
        )
    return tried


def search(
    candidates: Iterable[Candidate],
    promote: Callable[[Sequence[Tried], int], Sequence[Tried]],
    scene: Scene,
    work_on: Work,
    shares_of_time: Sequence[float],
) -> list[Tried]:
    """All candidates, as far as each came; `promote` chooses those that go on from a rung."""
    known: dict[str, Tried] = {}
    # By name, with the setting that the rung before has chosen
    alive: dict[str, tuple[Candidate, float | None]] = {each.name: (each, None) for each in candidates}
    for rung in range(1, RUNGS + 1):
        works = [
            work.trial(each, rung, setting, scene, certify=work_on.certify)
            for each, setting in alive.values()
        ]
        found = work_on.measure(works, f"rung {rung} of {RUNGS}", shares_of_time[rung - 1])
        for job in works:
            if job.key in found:
                number = known[job.label].number if job.label in known else len(known) + 1
                known[job.label] = _tried(number, job.candidate, rung, found[job.key])
        if rung < RUNGS:
            on = promote([known[name] for name in alive if name in known], rung)
            alive = {each.candidate.name: (each.candidate, each.setting) for each in on}
            for each in on[: VARIED[rung]] if any(e.costs for e in on) else ():
                alive |= {other.name: (other, each.setting) for other in variants(each.candidate, rung)}
    return list(known.values())


def train_all(
    candidates: Sequence[Candidate],
    folds: int,
    budgets: Sequence[Budget],
    scene: Scene,
    work_on: Work,
    steps: int,
) -> list[Tried]:
    """The same for networks that are trained by gradients, for more epochs on each rung.

    Recordings usually have so many `steps`: beside the first that go on are the same in other bins.
    """
    known: dict[str, Tried] = {}
    alive = list(candidates)
    for rung, share in enumerate(SHARES_OF_TIME["networks"], 1):
        works = {each.name: work.trials(each, rung, scene, folds, certify=work_on.certify) for each in alive}
        epochs = number(epochs_of(rung, scene.data.train), "epoch")
        label = f"{epochs} of {number(len(alive), 'network')}"
        found = work_on.measure([job for jobs in works.values() for job in jobs], label, share)
        for each in alive:
            parts = [found[job.key] for job in works[each.name] if job.key in found]
            if len(parts) == len(works[each.name]):
                measured = work.merged(parts)
                before = known.get(each.name)
                number_of = len(known) + 1 if before is None else before.number
                known[each.name] = _grown(before, _tried(number_of, each, rung, measured))
        came = [known[each.name] for each in alive if each.name in known and known[each.name].rung == rung]
        on = climbing(came, rung, budgets)
        alive = [each.candidate for each in on]
        if rung == 1:
            best = sorted(on, key=lambda each: -each.accuracy)[:VARIED_NETWORKS]
            alive += [other for each in best for other in other_ways(each.candidate, steps)]
    return list(known.values())


def climbing(tried: Sequence[Tried], rung: int, budgets: Sequence[Budget]) -> list[Tried]:
    """Networks that are trained for longer: those that may be chosen, likely ones first, and the best of each system.

    From the last rung on, those of them whose curve still rises.
    """
    if rung > RUNGS:
        return []
    enough = any(budget.what == "accuracy" for budget in budgets)
    likely = promote(tried, rung, budgets, BEST if enough else NEAR_BEST)
    on = {each.number: each for each in likely[: TRAINED[rung]]}
    if rung < RUNGS:
        able = sorted((each for each in tried if each.costs is not None), key=lambda each: -each.accuracy)
        first = {each.candidate.system: each for each in reversed(able)}
        on |= {each.number: each for each in first.values() if each.accuracy >= able[0].accuracy - FAR}
    else:
        on = {number: each for number, each in on.items() if not each.finished}
    return list(on.values())


def _grown(before: Tried | None, made: Tried) -> Tried:
    """A network after a rung, and whether more epochs still helped it: from the rung that may be chosen on."""
    curve = () if before is None else before.curve
    made = replace(made, curve=(*curve, (int(made.setting), made.accuracy)))
    if made.rung < RUNGS or before is None or made.refused is not None:
        return replace(made, finished=True if made.refused else None)
    gain, error = lead(made.shares, before.shares)
    return replace(made, finished=gain <= max(error, POINT))


def accuracy_at_random(each: Tried, scene: Scene, work_on: Work) -> float | None:
    """Accuracy of a candidate where parts at random are left out; None where time was too short."""
    about = {"certify": False, "at_random": True}
    if each.candidate.system == COUNTING:
        works = [work.trial(each.candidate, each.rung, each.setting, scene, **about)]
    else:
        works = work.trials(each.candidate, each.rung, scene, AT_RANDOM, **about)
    found = work_on.measure(works, "parts at random")
    parts = [found[job.key] for job in works if job.key in found]
    return accuracy(work.merged(parts)) if len(parts) == len(works) else None


def families(tried: Sequence[Tried]) -> tuple[Family, ...]:
    """Of each system what was best, and whether that was tried to the end."""
    return tuple(
        Family(
            system=system,
            tried=len(same),
            best=max(same, key=lambda each: (min(each.rung, RUNGS), each.accuracy)).number,
            finished=any(each.rung >= RUNGS for each in same)
            and all(each.finished in (None, True) for each in same if each.rung >= RUNGS),
        )
        for system in dict.fromkeys(each.candidate.system for each in tried)
        if (same := [each for each in tried if each.candidate.system == system])
    )


def most_accurate(tried: Sequence[Tried], rung: int) -> list[Tried]:
    """Baselines that go on from a rung: three of each kind, then one."""
    ordered = sorted(tried, key=lambda each: -each.accuracy)
    kinds = dict.fromkeys(each.candidate.system for each in tried)
    return [
        each
        for kind in kinds
        for each in [e for e in ordered if e.candidate.system == kind][: {1: 3, 2: 1}[rung]]
    ]


def _tried(number: int, candidate: Candidate, rung: int, measured: Measured) -> Tried:
    about = {each.name: getattr(measured, each.name) for each in fields(measured)}
    recordings = int(np.count_nonzero(measured.tried))
    right = accuracy(measured)
    low, high = wilson(right * recordings, recordings)
    about |= {"number": number, "candidate": candidate, "rung": rung}
    return Tried(**about, accuracy=right, low=low, high=high)


def accuracy(measured: Measured) -> float:
    """Share of right decisions, over recordings that were decided at all, each with the same weight."""
    return float(np.nanmean(measured.shares)) if any(measured.tried) else 0.0


def _beside(each: Tried, best: Tried, tried: Sequence[Tried]) -> Tried:
    """A candidate with what the best has ahead of it, and whether it is on the front of those that came as far."""
    behind, error = lead(best.shares, each.shares)
    peers = [
        other
        for other in tried
        if min(other.rung, RUNGS) == min(each.rung, RUNGS) and other.costs is not None
    ]
    marks = front([other.accuracy for other in peers], [energy(other) for other in peers])
    on = any(mark and other.number == each.number for mark, other in zip(marks, peers, strict=True))
    return replace(each, behind=behind, behind_error=error, front=on)


def promote(
    tried: Iterable[Tried], rung: int, budgets: Sequence[Budget] = (), weight: float = BEST
) -> list[Tried]:
    """Those that may still be chosen: least behind a cheaper one, or, which has less `weight`, behind the best.

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
        return cheaper - each.accuracy + (top - each.accuracy) / weight

    return sorted(able, key=lambda each: (lag(each), energy(each)))[: KEPT[rung]]


def energy(tried: Tried, table: str | None = None) -> float:
    """Joules of a mean inference, by the first table unless another is named; operations where none prices them."""
    assert tried.costs is not None, "what the chip does not hold has no price"
    return tried.costs.least if table is None else tried.costs.energy_j[table]


def pick(tried: Sequence[Tried], budgets: Sequence[Budget]) -> Choice:
    """The cheapest of the last rung, by each table, that fits the budgets and is about as accurate as the best.

    Its accuracy may be lower by `MARGIN`, and is not shown to be lower by a paired test, recording by recording.
    Where an accuracy is wanted, all that reach it are good enough. Where no candidate of the last rung fits,
    earlier ones may.
    """
    priced = [each for each in tried if each.costs is not None]
    if not priced:
        raise OptionError(f"no candidate can be had; {tried[0].candidate.name}: {tried[0].refused}")
    pool = [each for each in priced if each.rung >= RUNGS]
    selection = choose(pool, values, worse, budgets)
    if not selection.fitting:
        earlier = choose(priced, values, worse, budgets)
        selection = earlier if earlier.fitting else selection
    allowed = selection.allowed
    assert selection.best.costs is not None, "all of these are priced"
    tables = list(selection.best.costs.energy_j)
    cheapest = {table: _cheapest(allowed, table).number for table in tables}
    chosen = next(each for each in allowed if each.number == cheapest[tables[0]])
    above = [each for each in pool if each.accuracy >= chosen.accuracy + POINT - NEAR]
    return Choice(
        budgets=tuple(budget.words for budget in budgets),
        fits=bool(selection.fitting),
        best=selection.best.number,
        cheapest=cheapest,
        allowed=tuple(each.number for each in allowed),
        ahead=min(above, key=energy).number if above else None,
        cheaper=_cheaper(pool, chosen),
    )


def _cheapest(allowed: Sequence[Tried], table: str) -> Tried:
    """The most accurate of those whose energy is about the least."""
    most = (1 + ALIKE) * min(energy(each, table) for each in allowed)
    cheap = [each for each in allowed if energy(each, table) <= most]
    return max(cheap, key=lambda each: (each.accuracy, -energy(each, table)))


def _cheaper(pool: Sequence[Tried], chosen: Tried) -> int | None:
    """The most accurate that takes two thirds of the energy at most."""
    below = [each for each in pool if 3 * energy(each) <= 2 * energy(chosen)]
    return max(below, key=lambda each: (each.accuracy, -energy(each))).number if below else None


def worse(best: Tried, other: Tried) -> bool:
    """Whether one is more than the margin less accurate than another, or shown to be so, recording by recording."""
    ahead, error = lead(best.shares, other.shares)
    return ahead > min(MARGIN, CONFIDENT * error) + NEAR


def values(tried: Tried) -> dict[str, float]:
    """What budgets limit."""
    costs = tried.costs
    assert costs is not None, "what the chip does not hold has no price"
    known = {"energy": costs.least, "operations": costs.operations, "cores": float(costs.cores)}
    known |= {"accuracy": tried.accuracy, "certified": tried.certified or 0.0}
    return known | ({"time": next(iter(costs.time_s.values()))} if costs.time_s else {})
