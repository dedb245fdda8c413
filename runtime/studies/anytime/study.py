"""What stopping early saves and changes, for each rule of :mod:`exits`, from one run of the recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.machines.integer import Cumulative, IntegerMachine
from spikeloom.runtime.report.encode import INLINE, OPTIONAL, key
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.anytime import exits

WINDOWS = tuple(range(5, 101, 5))
"""Percent of each recording that is observed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Of a mean recording, or shares of them: chip steps, synaptic operations, joules and seconds by table."""

    chip_steps: float
    operations: float
    energy_j: Mapping[str, float]
    time_s: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Full:
    """Where nothing is stopped; right decisions are None without labels."""

    costs: Costs = field(metadata=INLINE)
    correct: int | None
    float_correct: int | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Decisions that differ from those at the end, right ones, and those that stopping makes right or wrong."""

    differ: int
    correct: int | None
    gained: int
    lost: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """What a rule comes to for every recording."""

    chip_steps: list[int]
    decisions: list[int]
    saved_operations: list[float]
    saved_energy_j: Mapping[str, list[float]]
    saved_time_s: Mapping[str, list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """A rule and what it comes to: `mean` is what is spent up to the stop, `saved` the shares that are not."""

    stop: exits.Calibrated = field(metadata=INLINE)
    mean: Costs
    saved: Costs
    changes: Changes = field(metadata=INLINE)
    samples: Samples


@dataclass(frozen=True, slots=True, kw_only=True)
class Right:
    """Right decisions, and the 95 % interval of their share."""

    correct: int
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Decisions of which only the first part of each recording is observed; the read-out still runs to its end."""

    percent: int
    bins: float
    chip: Right
    model: Right | None = field(default=None, metadata={**key("float"), **OPTIONAL})


@dataclass(frozen=True, slots=True, kw_only=True)
class Anytime:
    """How early decisions could be taken.

    `bins` are those of the longest recording, `least_interval` the least steps from one spike of an output neuron to
    its next. Windows are empty without labels; the first rule is the proof; `savings` is the index of the rule that
    saves most with ``identical`` decisions, or with at most ``one_lost``; `chosen` that of the rule that the user
    chose.
    """

    samples: int
    labelled: int
    source: str
    split: str
    bins: int
    least_interval: int
    full: Full
    windows: tuple[Window, ...]
    files: tuple[str, ...]
    labels: list[int]
    decisions: list[int]
    chip_steps: list[int]
    rules: tuple[Rule, ...]
    savings: Mapping[str, int]
    calibrated_on: str | None = field(default=None, metadata=OPTIONAL)
    chosen: int | None = field(default=None, metadata=OPTIONAL)


def study(
    machine: IntegerMachine,
    data: Recordings,
    ran: Cumulative,
    calibrated: Sequence[exits.Calibrated] = (),
    *,
    model_votes: IntArray | None = None,
    calibrated_on: str | None = None,
    chosen: int | None = None,
) -> Anytime:
    """Apply the proof and calibrated rules to recordings and their run; the float model's votes are for the windows."""
    at = exits.standing(ran.votes, ran.lengths)
    sure = exits.proven(ran.votes, at, exits.most_votes(machine, data.steps))
    model = None if model_votes is None else exits.standing(model_votes, ran.lengths)
    rules = tuple(_rule(rule, ran, at, sure, data.labels) for rule in (exits.PROOF, *calibrated))
    right = _correct(at.decision, data.labels)
    labelled = int(np.count_nonzero(data.labels != UNLABELLED))
    return Anytime(
        samples=len(data),
        labelled=labelled,
        source=data.source,
        split=data.split,
        bins=data.steps,
        least_interval=int(machine.least_intervals.min(initial=1)),
        full=Full(
            costs=_costs(ran, ran.chip_steps - 1),
            correct=right,
            float_correct=None if model is None else _correct(model.decision, data.labels),
        ),
        windows=tuple(_window(share, data, ran, at, model) for share in WINDOWS) if labelled else (),
        files=tuple(data.files),
        labels=data.labels.tolist(),
        decisions=at.decision.tolist(),
        chip_steps=ran.chip_steps.tolist(),
        rules=rules,
        savings=_savings(rules, right),
        calibrated_on=calibrated_on,
        chosen=chosen,
    )


def _rule(
    rule: exits.Calibrated,
    ran: Cumulative,
    at: exits.Standing,
    sure: BoolArray,
    labels: IntArray,
) -> Rule:
    ends, last = exits.exits(sure, at, rule.factor), ran.chip_steps - 1
    index = np.where(ends == ran.lengths - 1, last, np.minimum(ends + ran.depth, last))
    rows = np.arange(len(ends))
    mean, whole = _costs(ran, index), _costs(ran, last)

    def saved(sums: FloatArray) -> list[float]:
        return [float(each) for each in sums[rows, last] - sums[rows, index]]

    return Rule(
        stop=rule,
        mean=mean,
        saved=Costs(
            chip_steps=_share(mean.chip_steps, whole.chip_steps),
            operations=_share(mean.operations, whole.operations),
            energy_j={name: _share(each, whole.energy_j[name]) for name, each in mean.energy_j.items()},
            time_s={name: _share(each, whole.time_s[name]) for name, each in mean.time_s.items()},
        ),
        changes=_changes(at, ends, labels),
        samples=Samples(
            chip_steps=(index + 1).tolist(),
            decisions=at.leader[rows, ends].tolist(),
            saved_operations=saved(ran.operations),
            saved_energy_j={name: saved(each) for name, each in ran.energy.items()},
            saved_time_s={name: saved(each) for name, each in ran.time.items()},
        ),
    )


def _share(kept: float, whole: float) -> float:
    """What is saved of the whole."""
    return 1 - kept / whole if whole else 0.0


def _correct(decisions: IntArray, labels: IntArray) -> int | None:
    known = labels != UNLABELLED
    return int(np.count_nonzero(known & (decisions == labels))) if known.any() else None


def _changes(at: exits.Standing, ends: IntArray, labels: IntArray) -> Changes:
    early, late = at.leader[np.arange(len(ends)), ends], at.decision
    known = labels != UNLABELLED
    return Changes(
        differ=int(np.count_nonzero(early != late)),
        correct=_correct(early, labels),
        gained=int(np.count_nonzero(known & (early == labels) & (late != labels))),
        lost=int(np.count_nonzero(known & (early != labels) & (late == labels))),
    )


def _costs(ran: Cumulative, index: IntArray) -> Costs:
    """Means up to and with a chip step of each recording."""
    rows = np.arange(len(index))
    return Costs(
        chip_steps=float(np.mean(index + 1)),
        operations=float(ran.operations[rows, index].mean()),
        energy_j={name: float(each[rows, index].mean()) for name, each in ran.energy.items()},
        time_s={name: float(each[rows, index].mean()) for name, each in ran.time.items()},
    )


def _window(
    percent: int, data: Recordings, ran: Cumulative, at: exits.Standing, model: exits.Standing | None
) -> Window:
    steps = np.maximum(ran.lengths * percent // 100, 1)
    known = int(np.count_nonzero(data.labels != UNLABELLED))

    def right(votes: exits.Standing) -> Right:
        correct = _correct(votes.leader[np.arange(len(steps)), steps - 1], data.labels) or 0
        return Right(correct=correct, interval=wilson(correct, known))

    return Window(
        percent=percent, bins=float(steps.mean()), chip=right(at), model=None if model is None else right(model)
    )


def _savings(rules: Sequence[Rule], right: int | None) -> dict[str, int]:
    """Rules that save most steps with the same decisions, and with at most one recording less right."""
    fitting = {"identical": [index for index, rule in enumerate(rules) if rule.changes.differ == 0]}
    if right is not None:
        fitting["one_lost"] = [i for i, rule in enumerate(rules) if (rule.changes.correct or 0) >= right - 1]
    return {name: max(found, key=lambda index: rules[index].saved.chip_steps) for name, found in fitting.items()}
