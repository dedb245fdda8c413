"""One candidate by cross-validation inside the training split, and what it costs; work that crosses process borders."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import CapacityError, DataError, ModelError
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.passes.calibrate import evenly_spaced
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray, JsonObject
from spikeloom.models.recordings.classes import renamed
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import (
    FOLDS,
    STRENGTHS,
    Counted,
    Fitted,
    counter_spikes,
    counters_of,
    fit_rules,
    run_counters,
    split_folds,
)
from spikeloom.models.training.folds import Fold, every, folds_of
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.machines.backends import backend_of, machine_of
from spikeloom.runtime.machines.capabilities import Stoppable
from spikeloom.runtime.report.encode import OPTIONAL, encode
from spikeloom.runtime.studies.anytime.study import study
from spikeloom.runtime.studies.jobs import Job, content_key
from spikeloom.runtime.studies.processor import Processor
from spikeloom.runtime.studies.robustness.exhaustive import share_robust_to_one_event
from spikeloom.runtime.studies.search.measure import decisions as decisions_on_chip
from spikeloom.runtime.studies.search.measure import measure_netlist
from spikeloom.runtime.studies.search.results import Data, NetlistCosts
from spikeloom.runtime.studies.smallest import baselines
from spikeloom.runtime.studies.smallest.baselines import LINEAR, RBF, RIDGE
from spikeloom.runtime.studies.smallest.space import MANY, Candidate, epochs_of
from spikeloom.runtime.studies.smallest.trained import Sensor, plan_of, without

FORMAT = 6
"""Of what is measured; goes up when a figure means something else."""

PRICED = 48
"""Training recordings that a candidate is priced on, evenly spaced."""

RUNGS = 3
"""What comes to this one may be chosen; a fourth is for networks whose learning curve still rises."""

FEW = {1: 2, 2: 4}
"""Folds of the first rungs, of networks that are trained by gradients."""

ROUNDS = 5
"""Of cross-validation at random, of what may be chosen; networks that are trained by gradients have one.

Of more than `MANY` recordings there are fewer.
"""

SEEN = {1: 1000, 2: 2000}
"""Recordings that the first rungs see at most, evenly spaced; networks that are trained by gradients see all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What all candidates are tried on: recordings, their groups, a sensor and a chip; `states` of trainings."""

    data: Data
    groups: str | None
    sensor: Sensor
    target: str
    states: Path
    conditions: str  # Digest of the condition of each recording
    classes: tuple[str, ...] | None  # Their names, where numbers alone do not say them

    @property
    def identity(self) -> JsonObject:
        """JSON values that tell it from others."""
        sensor = {"edges": self.sensor.graph.edges, "coordinates": self.sensor.graph.coordinates}
        return {
            "format": FORMAT,
            "spikeloom": __version__,
            "data": self.data.sha256,
            "groups": self.groups,
            "conditions": self.conditions,
            "bin_s": self.data.bin_s,
            "graph": arrays_digest(sensor),
            "target": self.target,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(Job):
    """A candidate on a rung, on the training split; the last one takes the `setting` that the one before has chosen."""

    candidate: Candidate
    rung: int  # From 1
    setting: float | None
    scene: Scene
    certify: bool
    at_random: bool  # Whatever conditions there are
    fold: int | None  # The one that is left out, of networks that are trained by gradients; else all in turn


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """How often each training recording was decided, and rightly; the costs of a mean inference, where it is priced.

    Costs are those until the decision is proven; `whole` are those to the end, where they are others.
    """

    right: tuple[int, ...]
    tried: tuple[int, ...]
    setting: float  # Strength of the rule, or epochs
    # Share of right decisions by condition that was left out
    conditions: Mapping[str, float] = field(default_factory=dict)
    costs: NetlistCosts | None = field(default=None, metadata=OPTIONAL)
    whole: NetlistCosts | None = field(default=None, metadata=OPTIONAL)
    refused: str | None = field(default=None, metadata=OPTIONAL)  # Why it cannot be had
    processor: Processor | None = field(default=None, metadata=OPTIONAL)  # Costs of a baseline
    certified: float | None = field(
        default=None, metadata=OPTIONAL
    )  # Share that no event alters, of some left out

    def suits(self, recordings: int) -> bool:
        """Whether it counts so many recordings, and none was right more often than it was decided."""
        pairs = list(zip(self.right, self.tried, strict=False))
        return len(self.right) == len(self.tried) == recordings and all(0 <= r <= t for r, t in pairs)

    @property
    def shares(self) -> FloatArray:
        """How often each recording was decided rightly; NaN where it was not decided; shape (recordings,)."""
        right, tried = np.array([self.right, self.tried], np.float64)
        shares: FloatArray = np.divide(right, tried, out=np.full(len(tried), np.nan), where=tried > 0)
        return shares


def trial(
    candidate: Candidate,
    rung: int,
    setting: float | None,
    scene: Scene,
    *,
    certify: bool,
    at_random: bool = False,
    fold: int | None = None,
) -> Trial:
    """Work whose key is of everything that decides the result; from the last rung on it may `certify`."""
    about = scene.identity | {"candidate": encode(candidate), "rung": rung, "setting": setting}
    about |= {"at random": at_random, "fold": fold}
    if fold is not None:
        about |= {"epochs": epochs_of(rung, scene.data.train)}
    if certify := certify and rung >= RUNGS:
        about |= {"certified": True}
    return Trial(
        key=content_key(about),
        label=candidate.name,
        candidate=candidate,
        rung=rung,
        setting=setting,
        scene=scene,
        certify=certify,
        at_random=at_random,
        fold=fold,
    )


def trials(
    candidate: Candidate, rung: int, scene: Scene, folds: int, *, certify: bool, at_random: bool = False
) -> list[Trial]:
    """The same for a network that is trained by gradients, fold by fold; on the first rungs a few."""
    return [
        trial(candidate, rung, None, scene, certify=certify, at_random=at_random, fold=fold)
        for fold in range(min(folds, FEW.get(rung, folds)))
    ]


def merged(parts: Sequence[Measured]) -> Measured:
    """What was measured in several folds, together."""
    return replace(
        parts[0],
        right=tuple(map(sum, zip(*(part.right for part in parts), strict=True))),
        tried=tuple(map(sum, zip(*(part.tried for part in parts), strict=True))),
        conditions={name: share for part in parts for name, share in part.conditions.items()},
        refused=next((part.refused for part in parts if part.refused), None),
    )


def measure(work: Trial) -> JsonObject:
    """Do one piece of work; the JSON of a :class:`Measured`."""
    kinds = {COUNTING: _counting, LINEAR: _baseline, RBF: _baseline, RIDGE: _baseline}
    training = _training(work.scene)
    if work.fold is not None:
        return _encoded(_network(work, training))
    rows = evenly_spaced(np.arange(len(training)), SEEN.get(work.rung, len(training)))
    measured = kinds[work.candidate.system](work, training.part(rows))
    right, tried = np.zeros((2, len(training)), np.int64)
    right[rows], tried[rows] = measured.right, measured.tried
    return _encoded(replace(measured, right=tuple(right.tolist()), tried=tuple(tried.tolist())))


def _encoded(measured: Measured) -> JsonObject:
    values: JsonObject = encode(measured)
    return values


@lru_cache(maxsize=1)
def _training_of(
    path: str,
    taxels: int,
    bin_s: float,
    groups: str | None,
    classes: tuple[str, ...] | None,
    _now: tuple[str, str],
) -> Recordings:
    known: dict[str, Any] = {"taxels": taxels, "bin_s": bin_s, "groups": groups}
    return renamed(recordings(path, "train", classes=None, labels_for="training", **known), classes)


def _training(scene: Scene) -> Recordings:
    taxels = len(scene.sensor.graph.coordinates)
    now = scene.data.sha256, scene.conditions  # other recordings at the same place are read again
    return _training_of(scene.data.path, taxels, scene.data.bin_s, scene.groups, scene.classes, now)


def some(data: Recordings) -> Recordings:
    """The recordings that are priced."""
    return data.part(np.unique(np.linspace(0, len(data) - 1, PRICED).astype(np.int64)))


def _counting(work: Trial, training: Recordings) -> Measured:
    """A counting network: its strength, its decisions, its costs."""
    plan = work.candidate.plan({1: STRENGTHS[2:3], 2: STRENGTHS}.get(work.rung, (work.setting or 0.0,)))
    classes = int(training.labels.max()) + 1
    data = run_counters(training, plan)
    right = np.zeros(len(training), np.int64)
    shares: dict[str, float] = {}
    rounds = _rounds(work, training)
    try:
        for folds in rounds:
            decided, strength, lowest = cross_validated(data, classes, training, folds)
            right += decided == training.labels
            shares |= _by_condition(folds, decided == training.labels)
    except DataError as error:  # such as that no counter spikes without some of the recordings
        none = (0,) * len(right)
        return Measured(
            right=none, tried=none, setting=work.setting or 0.0, refused=str(error).splitlines()[0]
        )

    def compiled(data: Counted) -> tuple[Counters, Any]:
        rule = fit_rules(data, classes, [strength])[strength]
        made = counters_of(
            data, Fitted(rule=rule, strength=strength, accuracy={}, lowest=lowest), training, classes
        )
        return made, backend_of(work.scene.target).lower_counters(made)

    costs: dict[str, Any]
    certified = None
    held = split_folds(data.labels, FOLDS, np.random.default_rng(0)) == 0
    try:
        made, netlist = compiled(data)
        if work.certify:
            certified = share_robust_to_one_event(
                machine_of(compiled(data.part(~held))[1]), some(training.part(held))
            )
    except (CapacityError, ModelError, DataError) as error:
        costs = {"refused": str(error).splitlines()[0]}
    else:
        costs = costs_of(netlist, of_length(joined_bins(some(training), made.bins), made.clocks.length))
    return Measured(
        right=tuple(right.tolist()),
        tried=(len(rounds),) * len(right),
        setting=strength,
        conditions=shares,
        certified=certified,
        **costs,
    )


def _rounds(work: Trial, training: Recordings) -> list[list[Fold]]:
    rounds = max(1, min(ROUNDS, round(ROUNDS * MANY / len(training))))
    return folds_of(training, rounds if work.rung >= RUNGS else 1, at_random=work.at_random)


def _by_condition(folds: Sequence[Fold], right: BoolArray) -> dict[str, float]:
    """Share of right decisions in each condition."""
    return {fold.condition: float(right[fold.held].mean()) for fold in folds if fold.condition is not None}


def _network(work: Trial, training: Recordings) -> Measured:
    """A network that is trained by gradients, without a fold: its decisions there, and its costs, of the first fold."""
    assert work.fold is not None, "these are tried fold by fold"
    fold = list(every(folds_of(training, 1, at_random=work.at_random)))[work.fold]
    epochs = epochs_of(work.rung, work.scene.data.train)
    right = np.zeros(len(training), np.int64)
    nothing = Measured(right=tuple(right.tolist()), tried=tuple(right.tolist()), setting=epochs)
    known = work.scene.identity | {"candidate": encode(work.candidate), "fold": work.fold}
    trunk = work.scene.states / content_key(known | {"at random": work.at_random})
    try:
        plan = plan_of(work.candidate, work.scene.sensor, training)
        netlist = without(plan, training, fold.held, epochs, load_target(work.scene.target), trunk)
    except (CapacityError, ModelError, DataError) as error:
        return replace(nothing, refused=str(error).splitlines()[0])
    steps = joined_bins(training, plan.bins)
    costs: dict[str, Any] = {} if work.fold else costs_of(netlist, some(steps))
    if work.certify and not work.fold:
        certified = share_robust_to_one_event(machine_of(netlist), some(training.part(fold.held)))
        costs |= {"certified": certified}
    right[fold.held] = decisions_on_chip(netlist, steps.part(fold.held)) == training.labels[fold.held]
    return replace(
        nothing,
        right=tuple(right.tolist()),
        tried=tuple(fold.held.astype(int).tolist()),
        conditions=_by_condition([fold], right == 1),
        **costs,
    )


def _baseline(work: Trial, training: Recordings) -> Measured:
    """A classifier without spikes: its constant, its decisions, its costs."""
    system = work.candidate.system
    strengths = baselines.STRENGTHS[system]
    tried = {1: strengths[:1], 2: sorted(strengths)}.get(work.rung, (work.setting or 0.0,))
    seen = baselines.features(training, work.candidate)
    rounds = _rounds(work, training)
    right = {strength: np.zeros(len(training), np.int64) for strength in tried}
    shares: dict[float, dict[str, float]] = {strength: {} for strength in tried}
    for strength, folds in product(right, rounds):
        fitting = baselines.decided(system, strength, seen, training.labels, folds) == training.labels
        right[strength] += fitting
        shares[strength] |= _by_condition(folds, fitting)
    best = max(right, key=lambda strength: right[strength].sum())
    return Measured(
        right=tuple(right[best].tolist()),
        tried=(len(rounds),) * len(training),
        setting=best,
        conditions=shares[best],
        processor=baselines.priced(system, best, training, work.candidate),
    )


def cross_validated(
    data: Counted, classes: int, sensor: Recordings, folds: Sequence[Fold]
) -> tuple[IntArray, float, float]:
    """Class of each recording by a network that did not see it, the strength of all of them, and the least winning sum.

    The strength is chosen as ``train`` chooses it; `sensor` has the shape of the recordings.
    """
    held = [fold.held for fold in folds]
    rules = [fit_rules(data.part(~each), classes, data.plan.strengths) for each in held]
    sums = {strength: np.zeros((len(data.labels), classes)) for strength in sorted(data.plan.strengths)}
    for strength, (each, rule) in product(sums, zip(held, rules, strict=True)):
        sums[strength][each] = rule[strength].sums(data.part(each))
    best = max(sums, key=lambda strength: np.mean(sums[strength].argmax(axis=1) == data.labels))
    top = sums[best].max(axis=1)
    decided = np.zeros(len(data.labels), np.int64)
    for each, rule in zip(held, rules, strict=True):
        fitted = Fitted(rule=rule[best], strength=best, accuracy={}, lowest=float(top[~each].min()))
        made = counters_of(data.part(~each), fitted, sensor, classes)
        decided[each] = decisions(made, data.part(each))
    return decided, best, float(top.min())


def decisions(made: Counters, data: Counted) -> IntArray:
    """Class of each recording as the spikes of the network decide: the first sum over the ramp, of several the lowest.

    That is exact but for a sum that exceeds all training sums before the recording ends.
    """
    sums: FloatArray = counter_spikes(made, data).astype(np.float64) @ made.weight.T
    crossing = np.floor((made.threshold - made.slope * made.steps - sums) / made.slope) + 1
    return np.asarray(np.where(crossing > made.ramp, np.inf, crossing).argmin(axis=1))


def costs_of(netlist: Any, of: Recordings) -> dict[str, NetlistCosts]:
    """`costs` of a mean inference until its decision is proven, where the chip can be stopped there, and `whole`."""
    machine = machine_of(netlist)
    costs = measure_netlist(netlist, of)[1]
    if not isinstance(machine, Stoppable):
        return {"costs": costs}
    proven = study(machine, of, machine.cumulative(of.events, of.step_counts)).rules[0].mean
    stopped = replace(costs, operations=proven.operations, energy_j=proven.energy_j, time_s=proven.time_s)
    return {"costs": stopped, "whole": costs}
