"""Train counting networks: a linear rule on what counters say, rounded to whole weights.

Every recording becomes the spikes of a few hundred counters (:mod:`formats.counters`); a linear support
vector machine (one class against the rest, squared hinge [1]_, by Newton steps [2]_) on these is the weights
of the sums. Its strength is chosen by cross-validation inside the training recordings.

References
----------
.. [1] R.-E. Fan et al., "LIBLINEAR: A Library for Large Linear Classification", JMLR 9, 2008: L2-loss SVC.
.. [2] O. Chapelle, "Training a Support Vector Machine in the Primal", Neural Computation 19, 2007.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.counters import BLOCK, Counters
from spikeloom.compiler.dynamics import MOST_CLOCKS
from spikeloom.compiler.errors import DataError, OptionError, require_least
from spikeloom.compiler.passes.rounding import round_in_turn, shares
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.events import joined_bins
from spikeloom.models.recordings.evtouch import WHOLE, Recordings

THRESHOLDS = (1, 4, 16, 64)
"""Events at which the counters of a channel spike, unless others are asked for."""

STRENGTHS = (0.01, 0.03, 0.1, 0.3)
"""Weight of a training error against that of large weights, of which cross-validation chooses one."""

FOLDS = 5
LEAST = 3
"""Recordings in which a counter must spike, and in which it must not, to be worth a neuron."""

MOST = 64
"""Thresholds at most."""

TOGETHER = 64
"""Recordings whose sums after each step are held at once."""

THING = 3
"""Gain of the rules for objects over those for boundaries between their levels."""

MOST_ALIKE = 2000
"""Recordings up to which each pair of them is compared, 64 MB of numbers."""

NEWTON_STEPS = 100
LEAST_STEP = 1e-6
"""Steps at most, of which a class takes three to ten, and the least part of one that is tried."""

BITS = range(2, 9)
"""Widths of a weight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a counting network is to be."""

    thresholds: tuple[int, ...] = THRESHOLDS
    parts: int = 1  # Equal parts of the recording that are counted apart
    bins: int = 1  # Bins of the recordings that a step joins
    window: int = 100  # Per cent of the recording that counts
    ramp: int = 32  # Steps of the read-out
    bits: int = 8  # Width of a weight
    levels: int = 1  # Classes in a row that are levels of one thing, as 0 to 100 % of a container
    strengths: tuple[float, ...] = STRENGTHS

    def require_possible(self) -> None:
        """Refuse numbers that no network has."""
        require_least({"levels": self.levels, "ramp": self.ramp}, levels=1, ramp=1)
        if not 1 <= self.parts <= MOST_CLOCKS:
            raise OptionError(f"--parts {self.parts}: allowed are 1 to {MOST_CLOCKS}; choose another")
        if not 1 <= self.window <= WHOLE:
            raise OptionError(f"--window {self.window}: allowed are 1 to {WHOLE} per cent; choose another")
        if not 1 <= len(set(self.thresholds)) == len(self.thresholds) <= MOST or min(self.thresholds) < 1:
            words = ",".join(map(str, self.thresholds))
            raise OptionError(
                f"--thresholds {words}: give up to {MOST} different numbers from 1, as in 1,4,16,64"
            )
        if self.bits not in BITS:
            raise OptionError(
                f"--weight-bits {self.bits}: allowed are {BITS[0]} to {BITS[-1]}; choose another"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counted:
    """Spikes of all counters of a plan that a sensor could have, step by step."""

    plan: Plan
    steps: int
    counter: IntArray  # (counters, 3) int64; see :class:`Counters`
    spikes: NDArray[np.int16]  # (samples, counters); how often each has spiked in the end
    at: NDArray[np.int32]  # (samples, counters); step of the first spike, `steps` where there is none
    labels: IntArray

    def part(self, rows: Any) -> Self:
        """Some of the recordings."""
        return replace(self, spikes=self.spikes[rows], at=self.at[rows], labels=self.labels[rows])


def run_counters(data: Recordings, plan: Plan, steps: int | None = None) -> Counted:
    """Run the counters on recordings; `steps` of the training recordings, where these are others."""
    plan.require_possible()
    events = joined_bins(data, plan.bins).events
    if steps is None:
        steps = max(1, math.ceil(events.shape[-1] * plan.window / 100))
    flat = events.reshape(len(events), -1, events.shape[-1])[..., :steps]
    length = -(-steps // plan.parts)
    if (plan.parts - 1) * length >= steps:
        raise OptionError(
            f"--parts {plan.parts}: a recording has {steps} steps, the last part none; give fewer"
        )
    rows = []
    kinds = []
    counts: type[np.signedinteger[Any]] = np.int16 if length <= np.iinfo(np.int16).max else np.int32
    for part in range(plan.parts):
        first = part * length
        total = np.cumsum(flat[..., first : first + length], axis=-1, dtype=counts)
        for threshold in plan.thresholds:
            fired = total >= threshold
            last = total[..., -1].astype(np.int64)
            times = np.where(last >= threshold, 1 + (last - threshold) // (threshold + BLOCK), 0)
            when = np.where(fired[..., -1], first + fired.argmax(axis=-1), steps)
            rows.append((times, when))
            kinds.append([(channel, part, threshold) for channel in range(flat.shape[1])])
    return Counted(
        plan=plan,
        steps=steps,
        counter=np.array(kinds, np.int64).reshape(-1, 3),
        spikes=np.concatenate([times for times, _ in rows], axis=1).astype(np.int16),
        at=np.concatenate([when for _, when in rows], axis=1).astype(np.int32),
        labels=data.labels,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rule:
    """A linear rule on counters: the class of the largest sum of weights of those that spiked."""

    used: IntArray  # Counters that it looks at
    weight: FloatArray  # (classes, used)

    def right(self, data: Counted) -> BoolArray:
        """Which recordings it classifies correctly; (samples,)."""
        return np.asarray(self.sums(data).argmax(axis=1) == data.labels)

    def sums(self, data: Counted) -> FloatArray:
        """Sums of each class in the end; (samples, classes)."""
        return np.asarray(data.spikes[:, self.used] @ self.weight.T)

    def highest(self, data: Counted) -> float:
        """Largest sum that any class ever has after a step; second spikes count as the first.

        Weights are whole numbers here, so that sums are exact in any order.
        """
        highest = -math.inf
        for first in range(0, len(data.spikes), TOGETHER):
            some = slice(first, first + TOGETHER)
            spikes = data.spikes[some, self.used]
            sample, counter = np.nonzero(spikes)
            begin = np.arange(len(spikes) + 1) * data.steps  # of each recording
            at = begin[sample] + data.at[some, self.used][sample, counter]
            steps, row = np.unique(at, return_inverse=True)  # in which anything spikes
            entries = spikes[sample, counter], (row, counter)
            gains = sparse.csr_array(entries, (len(steps), len(self.used))) @ self.weight.T
            sums = np.vstack([np.zeros(len(self.weight)), gains]).cumsum(axis=0)
            rows = np.searchsorted(steps, begin)
            sums[1:] -= np.repeat(sums[rows[:-1]], np.diff(rows), axis=0)
            least = 0.0 if np.setdiff1d(begin[:-1], steps).size else -math.inf  # where step 0 has no spike
            highest = max(highest, float(sums[1:].max(initial=least)))
        return highest


def require_levels(levels: int, classes: int) -> None:
    """Refuse levels that do not divide the classes; OptionError."""
    if classes % levels:
        raise OptionError(f"--levels {levels}: {classes} classes are no multiple of it; give another")


def fit_rules(data: Counted, classes: int, strengths: Iterable[float]) -> dict[float, Rule]:
    """For each strength a support vector machine without bias, one class against the rest.

    It looks at the counters that spike now and then. Weights are sums of recordings, of which each class has
    shares. Where classes are levels, the first of each thing is trained as the thing against the rest, and
    the others as the boundary below them, on recordings of the thing alone; what a class weighs is the sum
    of all up to it.
    """
    levels = data.plan.levels
    require_levels(levels, classes)
    used = np.flatnonzero((data.spikes > 0).sum(axis=0) >= LEAST)
    if not len(used):
        raise DataError("counters: none of them spikes; give other --thresholds, or recordings with events")
    spikes = data.spikes[:, used].astype(np.float32)
    label = data.labels[:, None]
    each = np.arange(classes)
    here = label // levels == each // levels
    sign = np.where(here & (label >= each), 1.0, np.where(here | (each % levels == 0), -1.0, 0.0))
    ordered = sorted(strengths)  # so that each starts at what the one before has found
    weights = _by_weights if len(spikes) > max(MOST_ALIKE, len(used)) else _by_shares
    rules = {}
    for strength, flat in zip(ordered, weights(spikes, sign, ordered), strict=True):
        weight = flat.reshape(-1, levels, len(used))
        if levels > 1:
            weight[:, 0] *= THING
        rules[strength] = Rule(used=used, weight=weight.cumsum(axis=1).reshape(classes, -1))
    return rules


def _by_shares(
    spikes: NDArray[np.float32], sign: FloatArray, strengths: Sequence[float]
) -> Iterator[FloatArray]:
    """Weights (classes, counters) for each strength, of the shares of recordings."""
    alike = (spikes @ spikes.T).astype(np.float64)  # exact, as spikes are whole numbers
    share = _least_squares(alike, sign, strengths[0])
    for strength in strengths:
        starts = zip(sign.T, share.T, strict=True)
        share = np.stack([_newton(alike, one, start, strength) for one, start in starts], axis=1)
        yield share.T @ spikes


def _by_weights(
    spikes: NDArray[np.float32], sign: FloatArray, strengths: Sequence[float]
) -> Iterator[FloatArray]:
    """The same where recordings are many: no table of pairs of them, and equations of the counters alone."""
    weight = np.zeros((sign.shape[1], spikes.shape[1]))
    for strength in strengths:
        starts = zip(sign.T, weight, strict=True)
        weight = np.stack([_newton_of_weights(spikes, one, start, strength) for one, start in starts])
        yield weight


def _newton_of_weights(
    spikes: NDArray[np.float32], sign: FloatArray, weight: FloatArray, strength: float
) -> FloatArray:
    """As :func:`_newton`, for the weights of one class."""

    def loss(weight: FloatArray) -> float:
        missing = np.where(sign == 0, 0.0, np.maximum(1 - sign * (spikes @ weight), 0))
        return float(0.5 * weight @ weight + strength * (missing**2).sum())

    before = None
    for _ in range(NEWTON_STEPS):
        short = _short(sign, spikes @ weight)
        if before is not None and np.array_equal(short, before):
            break
        pull = spikes[short]
        ridge = (pull.T @ pull).astype(np.float64) + np.eye(len(weight)) / (2 * strength)
        goal = cho_solve(cho_factor(ridge, overwrite_a=True, check_finite=False), sign[short] @ pull)
        step = 1.0
        while step > LEAST_STEP and loss(weight + step * (goal - weight)) > loss(weight):
            step /= 2
        weight = weight + step * (goal - weight)
        before = short if step == 1.0 else None
    return weight


def _least_squares(alike: FloatArray, sign: FloatArray, strength: float) -> FloatArray:
    """Shares of recordings if all of them pull, as those short of the margin do."""
    ridge = alike.copy().T  # the same, as it is symmetric, in the order that LAPACK wants
    np.einsum("ii->i", ridge)[:] += 1 / (2 * strength)
    return np.asarray(
        cho_solve(cho_factor(ridge, overwrite_a=True, check_finite=False), sign, check_finite=False)
    )


def _short(sign: FloatArray, sums: FloatArray) -> BoolArray:
    """Which recordings are short of the margin; those without a sign are not looked at."""
    return np.asarray((sign * sums < 1) & (sign != 0))


def _newton(alike: FloatArray, sign: FloatArray, share: FloatArray, strength: float) -> FloatArray:
    """Solve for those short of the margin, until these are the same; a step that does not lower the loss is halved."""

    def loss(share: FloatArray, sums: FloatArray) -> float:
        return float(0.5 * share @ sums + strength * (np.maximum(1 - sign * sums, 0) ** 2).sum())

    sums = alike @ share
    for _ in range(NEWTON_STEPS):
        short = np.flatnonzero(_short(sign, sums))
        pull = alike[short]
        goal = np.zeros_like(share)
        goal[short] = _least_squares(pull[:, short], sign[short], strength)
        ahead = goal[short] @ pull - sums
        step = 1.0
        if np.array_equal(np.flatnonzero(_short(sign, sums + ahead)), short):
            return goal
        here = loss(share, sums)
        while step > LEAST_STEP and loss(share + step * (goal - share), sums + step * ahead) > here:
            step /= 2
        share = share + step * (goal - share)
        sums = sums + step * ahead
    return share


def split_folds(labels: IntArray, parts: int, rng: np.random.Generator) -> IntArray:
    """Part of each recording, so that all parts have the same share of every class; (samples,)."""
    fold = np.empty(len(labels), np.int64)
    first = 0
    for each in np.unique(labels):
        members = rng.permutation(np.flatnonzero(labels == each))
        fold[members] = (np.arange(len(members)) + first) % parts
        first += len(members)
    return fold


def cross_validate(data: Counted, classes: int, *, seed: int = 0) -> dict[float, FloatArray]:
    """For each strength of the plan sums of each class, (samples, classes), by rules that did not see the recording."""
    fold = split_folds(data.labels, FOLDS, np.random.default_rng(seed))
    sums = {strength: np.zeros((len(fold), classes)) for strength in sorted(data.plan.strengths)}
    for left_out in range(FOLDS):
        outside = fold == left_out
        for strength, rule in fit_rules(data.part(~outside), classes, sums).items():
            sums[strength][outside] = rule.sums(data.part(outside))
    return sums


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fitted:
    """A rule, and what cross-validation said."""

    rule: Rule
    strength: float  # The weakest of those that did best
    accuracy: Mapping[float, float]  # Of each strength
    lowest: float  # Largest sum of the recording in which it is least, by rules that did not see it


def fit(data: Counted, classes: int) -> Fitted:
    """Fit the rule on all recordings, at the strength that cross-validation chooses."""
    sums = cross_validate(data, classes)
    accuracy = {
        strength: float(np.mean(each.argmax(axis=1) == data.labels)) for strength, each in sums.items()
    }
    best = max(accuracy, key=accuracy.__getitem__)
    rule = fit_rules(data, classes, [best])[best]
    return Fitted(rule=rule, strength=best, accuracy=accuracy, lowest=float(sums[best].max(axis=1).min()))


def round_weights(weight: FloatArray, spikes: FloatArray, most: int) -> FloatArray:
    """Whole weights (classes, counters) of at most a magnitude, whose sums over spikes (samples, counters) stay.

    One counter after the other is rounded, those that spike most first, see :mod:`passes.rounding`.
    """
    together = spikes.T @ spikes
    order = np.argsort(-np.diag(together), kind="stable")
    whole = np.empty_like(weight)
    whole[:, order] = round_in_turn(weight[:, order], shares(together[order[:, None], order]), most)
    return whole


def counter_spikes(made: Counters, data: Counted) -> NDArray[np.int16]:
    """How often each counter of a network has spiked in the end; (samples, counters)."""
    place = {tuple(each): index for index, each in enumerate(data.counter.tolist())}
    return data.spikes[:, [place[tuple(each)] for each in made.counter.tolist()]]


def counters_of(data: Counted, fitted: Fitted, recordings: Recordings, classes: int) -> Counters:
    """The network of a rule in whole weights; counters whose weights are all zero are left out.

    Half of its ramp leads from the largest sum that the training recordings ever reach down to the lowest
    that may win. The other half is for lower ones: noise lowers all sums.
    """
    plan = data.plan
    most = (1 << (data.plan.bits - 1)) - 1
    unit = float(np.abs(fitted.rule.weight).max()) / most
    weight = np.rint(fitted.rule.weight / unit)
    if plan.bits < BITS[-1]:  # as few levels as these need to make up for each other
        weight = round_weights(
            fitted.rule.weight / unit, data.spikes[:, fitted.rule.used].astype(np.float64), most
        )
    kept = weight.any(axis=0)
    rule = Rule(used=fitted.rule.used[kept], weight=weight[:, kept])
    highest = rule.highest(data)
    slope = math.ceil((highest - fitted.lowest / unit) / max(plan.ramp // 2 - 2, 1))
    return Counters(
        taxels=recordings.taxels,
        polarities=recordings.events.shape[2],
        classes=classes,
        bins=plan.bins,
        steps=data.steps,
        parts=plan.parts,
        ramp=plan.ramp,
        counter=read_only(data.counter[rule.used]),
        weight=read_only(np.ascontiguousarray(rule.weight, np.int64)),
        slope=float(slope),
        threshold=highest + slope * data.steps + 0.5,
    )
