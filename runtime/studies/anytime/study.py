"""What stopping early saves and changes, for each rule of :mod:`exits`, from one run of the recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.machines.capabilities import Cumulative, Stoppable
from spikeloom.runtime.report.encode import INLINE, OPTIONAL
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.anytime import exits
from spikeloom.runtime.studies.search.results import Costs

WINDOWS = tuple(range(5, 101, 5))
"""Percent of the steps of each recording that are run, those of a read-out among them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppedCosts(Costs):
    """The same, and the chip steps."""

    chip_steps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Full:
    """Where nothing is stopped; right decisions are None without labels."""

    costs: StoppedCosts = field(metadata=INLINE)
    correct: int | None


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
    """A rule and what it comes to: `mean` is what is spent up to the stop.

    Decisions that differ from those at the end, right ones, and those that stopping makes right or wrong.
    """

    stop: exits.Calibrated = field(metadata=INLINE)
    mean: StoppedCosts
    differ: int
    correct: int | None
    gained: int
    lost: int
    samples: Samples


@dataclass(frozen=True, slots=True, kw_only=True)
class Right:
    """Right decisions, and the 95 % interval of their share."""

    correct: int
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Decisions after the first part of the steps of each recording, and those by which the layer that votes lags."""

    percent: int
    bins: float
    chip: Right


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Anytime(Shown):
    """How early decisions could be taken.

    `bins` are those of the longest recording, `least_interval` the least steps from one spike of an output
    neuron to its next. Windows are empty without labels; the first rule is the proof; `chosen` is the index
    of the user's.
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
    calibrated_on: str | None = field(default=None, metadata=OPTIONAL)
    held_out: bool = False
    chosen: int | None = field(default=None, metadata=OPTIONAL)


def study(
    machine: Stoppable,
    data: Recordings,
    ran: Cumulative,
    calibrated: Sequence[exits.Calibrated] = (),
    *,
    calibrated_on: str | None = None,
    held_out: bool = False,
    chosen: int | None = None,
) -> Anytime:
    """Apply the proof and calibrated rules to recordings and their run."""
    at = exits.standing(ran.votes, ran.lengths)
    sure = exits.proven(ran.votes, at, exits.most_votes(machine, data.steps), exits.steady_classes(machine))
    labelled = int(np.count_nonzero(data.labels != UNLABELLED))
    return Anytime(
        samples=len(data),
        labelled=labelled,
        source=data.source,
        split=data.split,
        bins=data.steps,
        least_interval=int(machine.least_intervals.min(initial=1)),
        full=Full(costs=_costs(ran, ran.chip_steps - 1), correct=_correct(at.decision, data.labels)),
        windows=tuple(_window(share, data.labels, ran, at) for share in WINDOWS) if labelled else (),
        files=tuple(data.files),
        labels=data.labels.tolist(),
        decisions=at.decision.tolist(),
        chip_steps=ran.chip_steps.tolist(),
        rules=tuple(_rule(rule, ran, at, sure, data.labels) for rule in (exits.PROOF, *calibrated)),
        calibrated_on=calibrated_on,
        held_out=held_out,
        chosen=chosen,
    )


def _rule(
    rule: exits.Calibrated, ran: Cumulative, at: exits.Standing, sure: BoolArray, labels: IntArray
) -> Rule:
    ends = exits.exits(sure, at, rule.factor)
    last = ran.chip_steps - 1
    index = np.where(ends == ran.lengths - 1, last, np.minimum(ends + ran.depth, last))
    rows = np.arange(len(ends))
    early = at.leader[rows, ends]
    late = at.decision
    known = labels != UNLABELLED

    def saved(sums: FloatArray) -> list[float]:
        return [float(each) for each in sums[rows, last] - sums[rows, index]]

    return Rule(
        stop=rule,
        mean=_costs(ran, index),
        differ=int(np.count_nonzero(early != late)),
        correct=_correct(early, labels),
        gained=int(np.count_nonzero(known & (early == labels) & (late != labels))),
        lost=int(np.count_nonzero(known & (early != labels) & (late == labels))),
        samples=Samples(
            chip_steps=(index + 1).tolist(),
            decisions=early.tolist(),
            saved_operations=saved(ran.operations),
            saved_energy_j={name: saved(each) for name, each in ran.energy.items()},
            saved_time_s={name: saved(each) for name, each in ran.time.items()},
        ),
    )


def _correct(decisions: IntArray, labels: IntArray) -> int | None:
    known = labels != UNLABELLED
    return int(np.count_nonzero(known & (decisions == labels))) if known.any() else None


def _costs(ran: Cumulative, index: IntArray) -> StoppedCosts:
    """Means up to and with a chip step of each recording."""
    rows = np.arange(len(index))
    energies = {name: joules[rows, index] for name, joules in ran.energy.items()}
    times = {name: seconds[rows, index] for name, seconds in ran.time.items()}
    return StoppedCosts.mean(
        ran.operations[rows, index], energies, times, chip_steps=float(np.mean(index + 1))
    )


def _window(percent: int, labels: IntArray, ran: Cumulative, at: exits.Standing) -> Window:
    steps = np.maximum(ran.lengths * percent // 100, 1)
    correct = _correct(at.leader[np.arange(len(steps)), steps - 1], labels) or 0
    interval = wilson(correct, int(np.count_nonzero(labels != UNLABELLED)))
    return Window(percent=percent, bins=float(steps.mean()), chip=Right(correct=correct, interval=interval))
