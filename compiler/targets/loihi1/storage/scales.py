"""Scales of one population: the finest that the accumulator allows, one for all neurons or one for each group.

Nothing here looks at the rest of the network; :mod:`storage.quantize` chooses among what is found here.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    CURRENT_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    THRESHOLD_MANTISSA_MAX,
    FloatArray,
    IntArray,
    plane_distance,
    reach,
    step_units,
    weight_step,
)
from spikeloom.compiler.interpret import BATCH, integer_recurrence, integer_sums, lasting_currents, product
from spikeloom.compiler.ir import Form, IntegerPopulation, IntegerProjection, Population, Projection, Sparse
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, round_population

WORTHWHILE = 0.95
"""The largest exponent that leaves this share of the finest weight scale is taken: each step up lets threshold and
bias round twice as finely (a proof at exponent 0 costs fc1 of the released networks two percent of scale)."""

SCALE_STEPS = 1024
"""A scale that the accumulator limits is the finest to one part in this many."""

LEVELS = 24
"""Thresholds that are tried on the calibration recordings where neurons are grouped by the spikes that they keep."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rounded:
    """One population, with its synapses, in chip integers.

    Parameters
    ----------
    form : Form
        How it is stored.
    population : IntegerPopulation
    projections : tuple of IntegerProjection
    reached : float
        Largest one-sided sum of one step, weight units: proven, or observed with its margin. A current that outlasts
        its step counts as the sum that fills the accumulator as far as it fills its own register.
    """

    form: Form
    population: IntegerPopulation
    projections: tuple[IntegerProjection, ...]
    reached: float


def rounded(
    population: Population, projections: tuple[Projection, ...], form: Form, observed: FloatArray | None = None
) -> Rounded | None:
    """Round one population, or None where a bias has no register value or a relay would miss its clock.

    Parameters
    ----------
    observed : (neurons,) float64, optional
        Largest sums that were observed, membrane units, see :func:`observed_sums`; without it the proven ones count.
    """
    try:
        integer, planes = round_population(population, projections, form)
    except ValueError:
        return None
    if population.relays and not _relays_follow(population, integer, planes):
        return None
    sums = loads(integer, planes) if observed is None else observed * integer.scale
    return Rounded(form=form, population=integer, projections=planes, reached=float(np.max(sums, initial=0)))


def _relays_follow(population: Population, integer: IntegerPopulation, planes: tuple[IntegerProjection, ...]) -> bool:
    """Whether the one synapse of every relay crosses its threshold."""
    last = slice(population.size - population.relays, population.size)
    weight = sum(np.asarray(plane.effective()[last].sum(axis=1)) for plane in planes)
    return bool(np.all(weight > integer.threshold[last]))


def in_batches(calibration: Calibration, measure: Callable[[slice], IntArray | FloatArray]) -> list[FloatArray]:
    """Measure something on batches of calibration recordings, on all cores."""
    parts = [slice(start, start + BATCH) for start in range(0, len(calibration.events), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return [np.asarray(part, np.float64) for part in pool.map(measure, parts)]


def observed_sums(
    population: Population, projections: tuple[Projection, ...], post: int, calibration: Calibration
) -> FloatArray:
    """Largest one-sided sum of each neuron of the float model on the calibration recordings, membrane units.

    A current that outlasts its step counts, too, by the share of its register that it fills.
    """
    narrower = ONE_STEP_SUM_MAX * (1 << MEMBRANE_SHIFT) / CURRENT_MAX

    def largest(part: slice) -> FloatArray:
        up = sum(product(p.weight.maximum(0), calibration.source(p.pre, post)[part], np.float64) for p in projections)
        down = sum(product(p.weight.minimum(0), calibration.source(p.pre, post)[part], np.float64) for p in projections)
        both: FloatArray = np.maximum(np.max(up, axis=(0, 1)), -np.min(down, axis=(0, 1)))
        if population.alpha:
            lasting = lasting_currents(np.asarray(up + down), population.alpha)
            both = np.maximum(both, np.abs(lasting).max(axis=(0, 1)) * narrower)
        return both

    found: FloatArray = np.max(in_batches(calibration, largest), axis=0)
    return found


def flips(layer: Rounded, post: int, calibration: Calibration) -> IntArray:
    """Calibration spikes of each neuron that differ from float64, the layer given the float model's own input."""
    merged: dict[int, Sparse] = {}  # planes of one source carry the same spikes
    for p in layer.projections:
        merged[p.pre] = merged[p.pre] + p.effective() if p.pre in merged else p.effective()

    def moved(part: slice) -> IntArray:
        sums = sum(integer_sums(weight, calibration.source(pre, post)[part]) for pre, weight in merged.items())
        spikes, _ = integer_recurrence(layer.population, np.asarray(sums))
        differ: IntArray = np.count_nonzero(spikes != calibration.spikes[post][part], axis=(0, 1))
        return differ

    total: IntArray = np.sum(in_batches(calibration, moved), axis=0).astype(np.int64)
    return total


def planes_from(exponent: int, bits: int, planes: int, exponents: tuple[int, ...]) -> tuple[int, ...]:
    """Exponents of up to `planes` planes from a finest one, as far apart as leaves no gap.

    Examples
    --------
    >>> planes_from(-1, 8, 2, tuple(range(-1, 8))), planes_from(3, 8, 3, tuple(range(-1, 8)))
    ((-1, 6), (3, 7))
    """
    found = [exponent]
    while len(found) < planes and found[-1] < max(exponents):
        found.append(min(found[-1] + plane_distance(bits), max(exponents)))
    return tuple(found)


def full_scale(
    population: Population, projections: tuple[Projection, ...], bits: int, planes: tuple[int, ...]
) -> float:
    """Mantissa units per membrane unit at which the planes just hold the largest weight."""
    peak = max(float(np.abs(p.weight.data).max(initial=0)) for p in projections)
    return reach(bits, planes) * weight_step(bits) / peak if peak else 1.0 / population.theta


def _largest_threshold(population: Population) -> float:
    """Threshold, in weight units, up to which its own register and that of the largest bias hold."""
    bias_limit = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    bias_peak = float(np.abs(population.bias).max(initial=0)) * (1 << MEMBRANE_SHIFT)
    return min(THRESHOLD_MANTISSA_MAX, bias_limit * population.theta / bias_peak if bias_peak else np.inf)


def fit(
    population: Population,
    projections: tuple[Projection, ...],
    bits: int,
    mantissa_scale: float,
    exponents: tuple[int, ...],
    observed: FloatArray | None,
) -> Rounded | None:
    """Population with the finest scale up to `mantissa_scale` that stays within the accumulator.

    A threshold is a whole number of weight units. Only scales at which it is one exactly are tried, so it carries
    no rounding at all; that costs at most one unit of scale in ``theta * scale``. Rounded weights, and so their sum,
    never shrink when the scale grows: the finest scale (to one part in ``SCALE_STEPS``) is closed in from both sides.
    """

    def tried(units: int) -> tuple[Rounded | None, float]:
        form = Form(bits=bits, exponents=exponents, threshold=np.full(population.size, units, np.int64))
        layer = rounded(population, projections, form, observed)
        # None: a bias that rounds just out of its register, or a relay whose clipped weight no longer reaches
        return layer, np.inf if layer is None else layer.reached

    high = int(min(population.theta * mantissa_scale * 2.0 ** exponents[0], _largest_threshold(population)))
    if high < 1:
        return None
    layer, reached = tried(high)
    if reached <= ONE_STEP_SUM_MAX and layer is not None:
        return layer
    low, best, over = 0, None, reached
    narrowed = True
    while high - low > max(1, low // SCALE_STEPS):
        # in proportion as long as that narrows well, else in the middle: sums of few coarse weights grow in leaps
        under = best.reached if best is not None else 0.0
        share = (ONE_STEP_SUM_MAX - under) / (over - under) if narrowed and np.isfinite(over) else 0.5
        units = min(max(low + int(share * (high - low)), low + 1), high - 1)
        before = high - low
        layer, reached = tried(units)
        if layer is not None and reached <= ONE_STEP_SUM_MAX:
            low, best = units, layer
        else:
            high, over = units, reached
        narrowed = not narrowed or 2 * (high - low) <= before
    return best


def mantissa_scale(layer: Rounded) -> float:
    """Mantissa units per membrane unit in the finest plane, of the coarsest neuron."""
    return float(layer.population.scale.min()) / 2.0 ** layer.form.exponents[0]


def candidate(
    population: Population,
    projections: tuple[Projection, ...],
    bits: int,
    planes: int,
    factor: float,
    exponents: tuple[int, ...],
    observed: FloatArray | None,
) -> Rounded | None:
    """Best compromise between a fine weight scale and a fine threshold, see ``WORTHWHILE``.

    `factor` says how far the scale may exceed the one that just holds the largest weight; the rest is clipped.
    """
    chosen: Rounded | None = None
    finest = 0.0
    for exponent in sorted(exponents):
        stored = planes_from(exponent, bits, planes, exponents)
        scale = full_scale(population, projections, bits, stored) * factor
        fitted = fit(population, projections, bits, scale, stored, observed)
        if fitted is None and chosen is None:
            continue  # the threshold is less than a unit, a larger exponent makes it more
        if fitted is None or mantissa_scale(fitted) < WORTHWHILE * finest:
            break
        finest = max(finest, mantissa_scale(fitted))
        chosen = fitted
    return chosen


# -- a scale for each group of neurons ---------------------------------------------------------------------------------


def finest_thresholds(
    population: Population,
    projections: tuple[Projection, ...],
    bits: int,
    exponents: tuple[int, ...],
    factor: float,
    observed: FloatArray | None,
) -> IntArray:
    """Largest threshold of each neuron that accumulator and registers allow, and `factor` beyond its largest weight.

    Returns
    -------
    (neurons,) int64
        0 where there is none.
    """
    peak = np.zeros(population.size)
    for projection in projections:
        row = np.repeat(np.arange(population.size), np.diff(projection.weight.indptr))
        np.maximum.at(peak, row, np.abs(projection.weight.data))
    with np.errstate(divide="ignore"):
        held = population.theta * reach(bits, exponents) * step_units(bits, exponents) * factor / peak
    high = np.minimum(held, _largest_threshold(population)).astype(np.int64) + 1  # one more than allowed
    low = np.zeros(population.size, np.int64)
    while np.any(high - low > np.maximum(1, low // SCALE_STEPS)):
        middle = (low + high + 1) // 2
        middle = np.where(high - low > 1, middle, np.maximum(low, 1))
        form = Form(bits=bits, exponents=exponents, threshold=np.maximum(middle, 1))
        integer, planes = round_population(population, projections, form)
        sums = loads(integer, planes) if observed is None else observed * integer.scale
        good = sums <= ONE_STEP_SUM_MAX
        low, high = np.where(good & (high - low > 1), middle, low), np.where(good | (high - low <= 1), high, middle)
    return low


def group_by_fineness(finest: IntArray, groups: int) -> IntArray:
    """Give neurons at most `groups` thresholds, none above its own finest, so that ``sum(1 / threshold)`` is least.

    Rounding errors grow with ``1 / threshold``. Sorted by what they allow, the neurons of a group are neighbours and
    share the smallest: an optimal cut is found by dynamic programming.

    Examples
    --------
    >>> group_by_fineness(np.array([10, 100, 11, 90, 12]), 2).tolist()
    [10, 90, 10, 90, 10]
    """
    value, count = np.unique(finest, return_counts=True)
    size = len(value)
    before = np.concatenate([[0], np.cumsum(count)])
    # cost[k][j]: least sum over the first j distinct values in k groups
    cost = np.full(size + 1, np.inf)
    cost[0] = 0
    cuts = []
    for _ in range(min(groups, size)):
        last = np.zeros(size + 1, np.int64)
        more = np.full(size + 1, np.inf)
        for j in range(1, size + 1):
            options = cost[:j] + (before[j] - before[:j]) / value[:j]
            last[j] = int(np.argmin(options))
            more[j] = options[last[j]]
        cuts.append(last)
        cost = more
    shared = np.empty(size, np.int64)
    end = size
    for last in reversed(cuts):
        if end:
            shared[last[end] : end] = value[last[end]]
            end = int(last[end])
    return shared[np.searchsorted(value, finest)]


def choose_levels(cost: FloatArray, groups: int) -> IntArray:
    """Pick at most `groups` columns so that the sum over rows of the cheapest picked entry is least, by exchange.

    Parameters
    ----------
    cost : (neurons, levels) float64
        Infinite where a level is not allowed; the first level is allowed for every row.

    Examples
    --------
    >>> choose_levels(np.array([[1.0, 0.0, np.inf], [2.0, 2.0, 0.0], [0.0, 5.0, 5.0]]), 2).tolist()
    [0, 2]
    """
    picked = [0]
    best = cost[:, 0]
    while len(picked) < min(groups, cost.shape[1]):
        gains = np.minimum(best[:, None], cost).sum(axis=0)
        level = int(np.argmin(gains))
        if gains[level] >= best.sum():
            break
        picked.append(level)
        best = np.minimum(best, cost[:, level])
    improved = True
    while improved:
        improved = False
        for i in range(len(picked)):
            others = cost[:, picked[:i] + picked[i + 1 :]].min(axis=1, initial=np.inf)
            sums = np.minimum(others[:, None], cost).sum(axis=0)
            level = int(np.argmin(sums))
            if sums[level] < cost[:, picked].min(axis=1).sum():
                picked[i], improved = level, True
    return np.array(sorted(set(picked)))


def grouped(
    population: Population,
    projections: tuple[Projection, ...],
    post: int,
    uniform: Rounded,
    groups: int,
    clipping: tuple[float, ...],
    calibration: Calibration | None,
    observed: FloatArray | None,
) -> Rounded | None:
    """Population with up to `groups` thresholds, stored with the width and planes of a `uniform` one.

    With several planes, or without calibration, neurons are grouped by the finest threshold that each allows; else
    by the calibration spikes that each keeps under ``LEVELS`` thresholds. None where some neurons relay clocks: these
    bind the threshold of all.
    """
    if population.relays:
        return None
    form = uniform.form
    finest = finest_thresholds(population, projections, form.bits, form.exponents, clipping[-1], observed)
    floor = int(uniform.form.threshold[0])
    finest = np.maximum(finest, floor)
    if calibration is None or len(form.exponents) > 1:
        exact = finest_thresholds(population, projections, form.bits, form.exponents, 1.0, observed)
        threshold = group_by_fineness(np.maximum(exact, floor), groups)
    else:
        unclipped = finest_thresholds(population, projections, form.bits, form.exponents, 1.0, observed)
        bottom = min(floor, int(unclipped.min()))
        ladder = np.unique(np.geomspace(max(bottom, 1), finest.max(), LEVELS).astype(np.int64))
        cost = np.empty((population.size, len(ladder)))
        for column, level in enumerate(ladder):
            layer = rounded(
                population,
                projections,
                Form(bits=form.bits, exponents=form.exponents, threshold=np.minimum(level, finest)),
                observed,
            )
            assert layer is not None, "finest thresholds hold every bias"
            cost[:, column] = np.where(level <= finest, flips(layer, post, calibration), np.inf)
        picked = choose_levels(cost, groups)
        # among equals the finest, which is the last
        best = len(picked) - 1 - np.argmin(cost[:, picked][:, ::-1], axis=1)
        threshold = ladder[picked][best]
    return rounded(
        population, projections, Form(bits=form.bits, exponents=form.exponents, threshold=threshold), observed
    )
