"""Scales of one population: the finest that the accumulator allows, one for all neurons or one for each group.

Nothing here looks at the rest of the network; :mod:`storage.choose_storage` chooses among what is found
here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from spikeloom.compiler.ir import Form, Network, Population, Projection, entry_parts, row_parts
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.loihi1.integers import IntegerPopulation, IntegerProjection, integer_layer
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    THRESHOLD_MANTISSA_MAX,
    plane_distance,
    reach,
    step_units,
    weight_step,
)
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, round_population
from spikeloom.compiler.types import FloatArray, IntArray

WORTHWHILE = 0.95
"""The largest exponent that leaves this share of the finest weight scale is taken: each step up lets
threshold and bias round twice as finely (a proof at exponent 0 costs fc1 of the released networks two
percent of scale)."""

SCALE_STEPS = 1024
"""A scale that the accumulator limits is the finest to one part in this many."""


@dataclass(frozen=True, kw_only=True, eq=False)  # without slots, for what is computed once
class FloatLayer:
    """One population with the synapses into it, and what is known of its activity."""

    population: Population
    projections: tuple[Projection, ...]
    post: int  # Its index in the network
    calibration: Calibration | None = None  # Spikes of the float model

    @cached_property
    def peaks(self) -> FloatArray:
        """Magnitude of the largest weight of each neuron; shape (neurons,)."""
        peaks = np.zeros(self.population.size)
        for projection in self.projections:
            for rows in row_parts(projection.weight):
                largest = abs(projection.weight[rows]).max(axis=1).toarray().ravel()
                peaks[rows] = np.maximum(peaks[rows], largest)
        return peaks

    @cached_property
    def unit(self) -> float:
        """Largest of 1, 1/2, … 1/64 of which all weights are multiples; 0 without one."""
        parts = [p.weight.data[part] for p in self.projections for part in entry_parts(p.weight)]
        units = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32, 1 / 64)
        if any(np.any(part % units[-1]) for part in parts):
            return 0.0  # as most networks, after one pass over their weights
        return next(unit for unit in units if not any(np.any(part % unit) for part in parts))


def layer_of(network: Network, post: int, calibration: Calibration | None = None) -> FloatLayer:
    """One layer of a network."""
    into = tuple(p for p in network.projections if p.post == post)
    return FloatLayer(
        population=network.populations[post], projections=into, post=post, calibration=calibration
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rounded:
    """One population, with its synapses, in chip integers."""

    form: Form  # How it is stored
    population: IntegerPopulation
    projections: tuple[IntegerProjection, ...]
    # Largest one-sided sum of one step that any input brings, weight units. A current that outlasts its step
    # counts as the sum that fills the accumulator as far as it fills its own register.
    reached: float
    # Calibration spikes of each neuron that differ from float64, and how many more there are: (2, neurons)
    # once judged
    moved: IntArray = field(default_factory=lambda: np.zeros((2, 0), np.int64))
    tried: int = 1  # Scales that were compared
    compensated: bool = False  # Whether weights were rounded so that their errors cancel

    @property
    def cost(self) -> int:
        """What candidates are compared by."""
        return int(spike_cost(self.moved).sum())

    @property
    def flips(self) -> int:
        """Calibration spikes that differ from float64."""
        return int(self.moved[0].sum())


def spike_cost(moved: IntArray) -> IntArray:
    """What each neuron loses: spikes that differ, and how many more or fewer there are, or silence would be cheap."""
    return np.asarray(moved[0] + np.abs(moved[1]))


def rounded(
    layer: FloatLayer, form: Form, steps: Sequence[IntArray] | None = None, bias: FloatArray | None = None
) -> Rounded | None:
    """Round one population, or None where a bias has no register value or a relay would miss its clock.

    `steps` and `bias` as of :func:`round_population`.
    """
    try:
        integer, planes = round_population(layer.population, layer.projections, form, steps, bias)
    except ValueError:
        return None
    if relays := layer.population.relays:  # the one synapse of each has to cross its threshold
        weight = sum(np.asarray(plane.effective()[-relays:].sum(axis=1)) for plane in planes)
        if np.any(weight <= integer.threshold[-relays:]):
            return None
    reached = float(np.max(loads(integer, planes), initial=0))
    return Rounded(form=form, population=integer, projections=planes, reached=reached)


def with_spike_errors(
    layer: Rounded, post: int, calibration: Calibration | None, parts: int | None = None
) -> Rounded:
    """A layer with its spike errors on the calibration, or its first `parts`, given what the layers before it send."""
    if calibration is None:
        return layer
    ready = integer_layer(layer.population, layer.projections, loops=False)
    return replace(layer, moved=calibration.moved(ready, post, parts))


def planes_from(exponent: int, bits: int, planes: int, largest: int) -> tuple[int, ...]:
    """Exponents of up to `planes` planes from a finest one, up to `largest`, as far apart as leaves no gap.

    >>> planes_from(-1, 8, 2, 7), planes_from(3, 8, 3, 7)
    ((-1, 6), (3, 7))
    """
    exponents = [exponent]
    while len(exponents) < planes and exponents[-1] < largest:
        exponents.append(min(exponents[-1] + plane_distance(bits), largest))
    return tuple(exponents)


def _largest_threshold(population: Population) -> float:
    """Threshold, in weight units, up to which its own register and that of the largest bias hold."""
    bias_limit = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    bias_peak = float(np.abs(population.bias).max(initial=0)) * (1 << MEMBRANE_SHIFT)
    return min(THRESHOLD_MANTISSA_MAX, bias_limit * population.theta / bias_peak if bias_peak else np.inf)


def fit(layer: FloatLayer, bits: int, exponents: tuple[int, ...], mantissa_scale: float) -> Rounded | None:
    """Population with the finest scale up to `mantissa_scale` that stays within the accumulator.

    Scales are in mantissa units of the finest plane per membrane unit. A threshold is a whole number of
    weight units. Only scales at which it is one exactly are tried, so it carries no rounding at all; that
    costs at most one unit of scale in ``theta * scale``. Rounded weights, and so their sum, never shrink
    when the scale grows: the finest scale (to one part in ``SCALE_STEPS``) is closed in from both sides.
    """
    population = layer.population

    def at(units: int) -> tuple[Rounded | None, float]:
        threshold = np.full(population.size, units, np.int64)
        stored = rounded(layer, Form(bits=bits, exponents=exponents, threshold=threshold))
        # None: a bias that rounds just out of its register, or a relay whose clipped weight no longer
        # reaches
        return stored, np.inf if stored is None else stored.reached

    finest = population.theta * mantissa_scale * 2.0 ** exponents[0]
    high = int(
        min(finest * (1 + 1e-12), _largest_threshold(population))
    )  # a product just below a whole number
    if high < 1:
        return None
    stored, over = at(high)
    if over <= ONE_STEP_SUM_MAX:
        return stored
    low = 0
    under = 0.0
    best = None
    narrowed = True
    while high - low > max(1, low // SCALE_STEPS):
        # in proportion as long as that narrows well, else in the middle: sums of few coarse weights grow in
        # leaps
        share = (ONE_STEP_SUM_MAX - under) / (over - under) if narrowed and np.isfinite(over) else 0.5
        units = min(max(low + int(share * (high - low)), low + 1), high - 1)
        before = high - low
        stored, reached = at(units)
        if reached <= ONE_STEP_SUM_MAX:
            low = units
            under = reached
            best = stored
        else:
            high = units
            over = reached
        narrowed = not narrowed or 2 * (high - low) <= before
    return best


def mantissa_scale(layer: Rounded) -> float:
    """Mantissa units per membrane unit in the finest plane, of the coarsest neuron."""
    return float(layer.population.scale.min()) / 2.0 ** layer.form.exponents[0]


def candidate(
    layer: FloatLayer, packing: Packing, factor: float, exponents: tuple[int, ...]
) -> tuple[Rounded | None, bool]:
    """Best compromise between a fine weight scale and a fine threshold, see ``WORTHWHILE``.

    Weights that are multiples of 1, 1/2, … 1/64 stay so, up to their scale. `factor` says how far the scale may
    exceed the one that just holds the largest weight; the rest is clipped. Also whether registers, not that,
    limit the scale: a larger factor gives the same.
    """
    bits = packing.bits
    peak = float(layer.peaks.max(initial=0))
    chosen = None
    limited = False
    finest = 0.0
    unit = layer.unit
    worthwhile = 1.0 if unit else WORTHWHILE
    for exponent in sorted(exponents):
        stored = planes_from(exponent, bits, packing.planes, max(exponents))
        scale = reach(bits, stored) * weight_step(bits) / peak if peak else 1.0 / layer.population.theta
        if unit and scale * unit >= weight_step(bits):  # at a multiple of the step no weight is rounded
            scale -= scale % (weight_step(bits) / unit)
        fitted = fit(layer, bits, stored, scale * factor)
        if fitted is None and chosen is None:
            continue  # the threshold is less than a unit, a larger exponent makes it more
        if fitted is None or mantissa_scale(fitted) < worthwhile * finest:
            break
        chosen = fitted
        finest = max(finest, mantissa_scale(fitted))
        limited = finest < WORTHWHILE * scale * factor
    return chosen, limited


def finest_thresholds(layer: FloatLayer, bits: int, exponents: tuple[int, ...]) -> IntArray:
    """Largest threshold of each neuron that registers and its largest weight allow; 0 if none."""
    population = layer.population
    with np.errstate(divide="ignore"):
        largest = population.theta * reach(bits, exponents) * step_units(bits, exponents) / layer.peaks
    high = np.minimum(largest, _largest_threshold(population)).astype(np.int64) + 1  # one more than allowed
    low = np.zeros(population.size, np.int64)
    while np.any(high - low > np.maximum(1, low // SCALE_STEPS)):
        middle = (low + high + 1) // 2
        middle = np.where(high - low > 1, middle, np.maximum(low, 1))
        form = Form(bits=bits, exponents=exponents, threshold=np.maximum(middle, 1))
        good = loads(*round_population(population, layer.projections, form)) <= ONE_STEP_SUM_MAX
        is_open = high - low > 1
        low = np.where(good & is_open, middle, low)
        high = np.where(good | ~is_open, high, middle)
    return low


def group_by_fineness(finest: IntArray, groups: int) -> IntArray:
    """Give neurons at most `groups` thresholds, none above its own finest, so that ``sum(1 / threshold)`` is least.

    Rounding errors grow with ``1 / threshold``. Sorted by what they allow, the neurons of a group are
    neighbours and share the smallest: an optimal cut is found by dynamic programming.

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


def grouped(layer: FloatLayer, uniform: Rounded, groups: int) -> Rounded | None:
    """Population with up to `groups` thresholds, each as fine as its neurons allow, stored as a `uniform` one.

    Sums of several planes may be larger at a smaller threshold. A group in which one is too large is made
    coarser, step by step, down to the threshold of the `uniform` one, whose sums hold.

    None where some neurons relay clocks: these bind the threshold of all.
    """
    if layer.population.relays:
        return None
    finest = finest_thresholds(layer, uniform.form.bits, uniform.form.exponents)
    threshold = group_by_fineness(np.maximum(finest, uniform.form.threshold), groups)
    while (
        stored := rounded(layer, replace(uniform.form, threshold=threshold))
    ) and stored.reached > ONE_STEP_SUM_MAX:
        over = loads(stored.population, stored.projections) > ONE_STEP_SUM_MAX
        threshold = threshold - np.isin(threshold, threshold[over])
    return stored
