"""One candidate by cross-validation inside the training split, and what it costs; work that crosses process borders."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from spikeloom.compiler import __version__
from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.counters import Counters
from spikeloom.compiler.errors import CapacityError, DataError, ModelError
from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.types import FloatArray, IntArray, JsonObject
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
from spikeloom.runtime.studies.smallest.baselines import LINEAR, RBF
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.smallest.trained import Sensor, plan_of, without

FORMAT = 3
"""Of what is measured; goes up when a figure means something else."""

PRICED = 48
"""Training recordings that a candidate is priced on, evenly spaced."""

RUNGS = 3
"""What comes to the last one may be chosen."""

ROUNDS = 5
"""Of cross-validation on the last rung."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(Job):
    """A candidate on a rung, on the training split; the last one takes the `setting` that the one before has chosen."""

    candidate: Candidate
    rung: int  # From 1
    setting: float | None
    data: Data
    sensor: Sensor
    target: str
    certify: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """How often each training recording was decided, and rightly; the costs of a mean inference, where it is priced.

    Costs are those until the decision is proven; `whole` are those to the end, where they are others.
    """

    right: tuple[int, ...]
    tried: tuple[int, ...]
    setting: float  # Strength of the rule
    costs: NetlistCosts | None = field(default=None, metadata=OPTIONAL)
    whole: NetlistCosts | None = field(default=None, metadata=OPTIONAL)
    refused: str | None = field(default=None, metadata=OPTIONAL)  # Why the chip does not hold it
    processor: Processor | None = field(default=None, metadata=OPTIONAL)  # Costs of a baseline
    certified: float | None = field(
        default=None, metadata=OPTIONAL
    )  # Share that no event alters, of some left out

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
    data: Data,
    sensor: Sensor,
    target: str,
    *,
    certify: bool,
) -> Trial:
    """Work whose key is of everything that decides the result; on the last rung it may `certify`."""
    graph = arrays_digest({"edges": sensor.graph.edges, "coordinates": sensor.graph.coordinates})
    about = {
        "format": FORMAT,
        "spikeloom": __version__,
        "data": data.sha256,
        "bin_s": data.bin_s,
        "graph": graph,
    }
    about |= {"target": target, "candidate": encode(candidate), "rung": rung, "setting": setting}
    if certify := certify and rung == RUNGS:
        about |= {"certified": True}
    own: dict[str, Any] = {
        "candidate": candidate,
        "rung": rung,
        "setting": setting,
        "data": data,
        "sensor": sensor,
    }
    return Trial(key=content_key(about), label=candidate.name, target=target, certify=certify, **own)


def measure(work: Trial) -> JsonObject:
    """Do one piece of work; the JSON of a :class:`Measured`."""
    kinds = {COUNTING: _counting, LINEAR: _baseline, RBF: _baseline}
    training = _training(work.data, len(work.sensor.graph.coordinates))
    found: JsonObject = encode(kinds.get(work.candidate.system, _network)(work, training))
    return found


@lru_cache(maxsize=1)
def _training(data: Data, taxels: int) -> Recordings:
    return recordings(
        data.path, "train", classes=None, taxels=taxels, bin_s=data.bin_s, labels_for="training"
    )


def some(data: Recordings) -> Recordings:
    """The recordings that are priced."""
    return data.part(np.unique(np.linspace(0, len(data) - 1, PRICED).astype(np.int64)))


def _counting(work: Trial, training: Recordings) -> Measured:
    """A counting network: its strength, its decisions, its costs."""
    plan = work.candidate.plan({1: STRENGTHS[2:3], 2: STRENGTHS}.get(work.rung, (work.setting or 0.0,)))
    classes, data = int(training.labels.max()) + 1, run_counters(training, plan)
    right, seeds = np.zeros(len(training), np.int64), range(1, ROUNDS + 1) if work.rung == RUNGS else (0,)
    for seed in seeds:
        decided, strength, lowest = cross_validated(data, classes, training, seed)
        right += decided == training.labels

    def compiled(data: Counted) -> tuple[Counters, Any]:
        rule = fit_rules(data, classes, [strength])[strength]
        made = counters_of(
            data, Fitted(rule=rule, strength=strength, accuracy={}, lowest=lowest), training, classes
        )
        return made, backend_of(work.target).lower_counters(made)

    costs: dict[str, Any]
    certified, held = None, split_folds(data.labels, FOLDS, np.random.default_rng(0)) == 0
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
    rounds = (len(seeds),) * len(right)
    return Measured(
        right=tuple(right.tolist()), tried=rounds, setting=strength, certified=certified, **costs
    )


def _network(work: Trial, training: Recordings) -> Measured:
    """A network that is trained by gradients: decisions on one part, on the last rung on all; costs of the first."""
    plan, target = plan_of(work.candidate, work.sensor, training), load_target(work.target)
    epochs = work.candidate.options["epochs"] // (2 if work.rung == 1 else 1)
    fold = split_folds(training.labels, FOLDS, np.random.default_rng(0))
    right, tried = np.zeros((2, len(training)), np.int64)
    costs: dict[str, Any] = {}
    certified = None
    steps = joined_bins(training, plan.bins)
    for part in range(FOLDS if work.rung == RUNGS else 1):
        held = fold == part
        try:
            netlist = without(plan, training, held, epochs, target, work.candidate.storage)
        except (CapacityError, ModelError) as error:
            right[:], tried[:], costs = 0, 0, {"refused": str(error).splitlines()[0]}
            break
        costs = costs or costs_of(netlist, some(steps))
        if work.certify and not part:
            certified = share_robust_to_one_event(machine_of(netlist), some(training.part(held)))
        right[held], tried[held] = decisions_on_chip(netlist, steps.part(held)) == training.labels[held], 1
    decided, rounds = tuple(right.tolist()), tuple(tried.tolist())
    return Measured(right=decided, tried=rounds, setting=epochs, certified=certified, **costs)


def _baseline(work: Trial, training: Recordings) -> Measured:
    """A support vector machine: its constant, its decisions, its costs."""
    system, labels, rung = work.candidate.system, training.labels, work.rung
    strengths = baselines.STRENGTHS[system]
    tried = {1: strengths[:1], 2: sorted(strengths)}.get(rung, (work.setting or 0.0,))
    seen, seeds = (
        baselines.features(training, work.candidate),
        range(1, ROUNDS + 1) if rung == RUNGS else (0,),
    )
    right = {strength: np.zeros(len(training), np.int64) for strength in tried}
    for strength, seed in product(right, seeds):
        fold = split_folds(labels, FOLDS, np.random.default_rng(seed))
        right[strength] += baselines.decided(system, strength, seen, labels, fold) == labels
    best = max(right, key=lambda strength: right[strength].sum())
    costs, rounds = baselines.priced(system, best, training, work.candidate), (len(seeds),) * len(training)
    return Measured(right=tuple(right[best].tolist()), tried=rounds, setting=best, processor=costs)


def cross_validated(
    data: Counted, classes: int, sensor: Recordings, seed: int
) -> tuple[IntArray, float, float]:
    """Class of each recording by a network that did not see it, the strength of all of them, and the least winning sum.

    The strength is chosen as ``train`` chooses it; `sensor` has the shape of the recordings.
    """
    fold = split_folds(data.labels, FOLDS, np.random.default_rng(seed))
    rules = [fit_rules(data.part(fold != held), classes, data.plan.strengths) for held in range(FOLDS)]
    sums = {strength: np.zeros((len(fold), classes)) for strength in sorted(data.plan.strengths)}
    for strength, held in ((strength, held) for strength in sums for held in range(FOLDS)):
        sums[strength][fold == held] = rules[held][strength].sums(data.part(fold == held))
    best = max(sums, key=lambda strength: np.mean(sums[strength].argmax(axis=1) == data.labels))
    top, decided = sums[best].max(axis=1), np.zeros(len(fold), np.int64)
    for held in range(FOLDS):
        lowest = float(top[fold != held].min())
        fitted = Fitted(rule=rules[held][best], strength=best, accuracy={}, lowest=lowest)
        made = counters_of(data.part(fold != held), fitted, sensor, classes)
        decided[fold == held] = decisions(made, data.part(fold == held))
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
