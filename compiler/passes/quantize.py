"""Round a network to chip integers: one scale per population.

Spikes change. Which scale is best is decided on the calibration recordings: first by the spikes of a layer that differ
from the float64 model's when it gets the float model's own input; among the few best by how far the class counts of
the whole integer network move. Without calibration the weights alone decide.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from compiler.errors import ModelError, OptionError
from compiler.fixedpoint import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    THRESHOLD_MANTISSA_MAX,
    encode_bias,
    quantise_weights,
    weight_step,
)
from compiler.interpret import BATCH, integer_recurrence, integer_sums, product, run_integer
from compiler.ir import IntegerNetwork, IntegerPopulation, IntegerProjection, Network, Population, Projection
from compiler.passes.calibrate import Calibration
from compiler.targets import Target

CLIPPING = tuple(2 ** (k / 4) for k in range(13))
"""Factors by which a scale may exceed the one that just holds the largest weight; larger weights are clipped."""

WORTHWHILE = 0.95
"""The largest exponent that leaves this share of the finest weight scale is taken: each step up lets threshold and
bias round twice as finely (a proof at exponent 0 costs fc1 of the released networks two percent of scale)."""

SCALE_STEPS = 1024
"""A scale that the accumulator limits is the finest to one part in this many."""

SHORTLIST, SHORTLIST_RATIO = 3, 1.25
"""Scales of a layer that are compared within the whole network, and by how much they may exceed the fewest flips."""

RANGES = ("proven", "observed")
"""How a scale is kept from overflowing the accumulator; ``observed`` trusts the calibration recordings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The scale that was chosen for one population, and why.

    Parameters
    ----------
    layer : str
        Population.
    scale : float
        Weight units (mantissa times 2**exponent) per membrane unit of the model.
    exponent : int
        Weight exponent.
    clipped : int
        Weights that the range cuts off.
    candidates : int
        Scales that were compared.
    flips, spikes : int or None
        Calibration spikes that differ from float64, and how many the float64 model has; None without calibration.
    headroom : float
        Share of the accumulator that the worst case (proven) or the largest observed step leaves free.
    """

    layer: str
    scale: float
    exponent: int
    clipped: int
    candidates: int
    flips: int | None
    spikes: int | None
    headroom: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """One population with its synapses at one candidate scale."""

    population: IntegerPopulation
    projections: tuple[IntegerProjection, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Candidate:
    """A layer at one scale, its largest one-sided sum, its calibration flips, and how many scales were compared."""

    layer: _Layer
    reached: float
    flips: int | None
    tried: int


def decay_registers(beta: float) -> tuple[int, int]:
    """Registers of a current-less neuron: ``decay_u`` that forgets all, and the ``decay_v`` nearest to `beta`.

    Examples
    --------
    >>> decay_registers(0.2)
    (4095, 3277)
    """
    return 4095, min(4095, max(0, round(4096 * (1 - beta))))


def _round_layer(
    population: Population, projections: tuple[Projection, ...], mantissa_scale: float, exponent: int, bits: int
) -> _Layer | None:
    """Integers of one population at a scale, or None where threshold or bias have no register value."""
    scale = mantissa_scale * 2.0**exponent
    threshold = round(population.theta * scale)
    if not 1 <= threshold <= THRESHOLD_MANTISSA_MAX:
        return None
    try:
        mantissa, bias_exponent = encode_bias(population.bias * scale * (1 << MEMBRANE_SHIFT))
    except ValueError:
        return None
    rounded = []
    for projection in projections:
        weight = projection.weight.astype(np.int64)
        weight.data = quantise_weights(projection.weight.data, mantissa_scale, bits)
        rounded.append(
            IntegerProjection(pre=projection.pre, post=projection.post, weight=weight, exponent=exponent, bits=bits)
        )
    decay_u, decay_v = decay_registers(population.beta)
    return _Layer(
        population=IntegerPopulation(
            name=population.name,
            beta=population.beta,
            theta=population.theta,
            scale=scale,
            decay_u=decay_u,
            decay_v=decay_v,
            threshold=np.full(population.size, threshold, np.int64),
            bias_mantissa=mantissa,
            bias_exponent=bias_exponent,
        ),
        projections=tuple(rounded),
    )


def _proven_sum(layer: _Layer) -> float:
    """Largest one-sided synaptic sum that any input can bring, weight units."""
    positive = sum(np.asarray(p.weight.maximum(0).sum(axis=1), np.float64) for p in layer.projections)
    negative = sum(np.asarray(p.weight.minimum(0).sum(axis=1), np.float64) for p in layer.projections)
    return float(np.maximum(positive, -negative).max(initial=0)) * 2.0 ** layer.projections[0].exponent


def _observed_sum(projections: tuple[Projection, ...], calibration: Calibration) -> float:
    """Largest one-sided synaptic sum of the float model on the calibration recordings, membrane units."""

    def largest(part: slice) -> float:
        up = sum(product(p.weight.maximum(0), calibration.source(p.pre)[part], np.float64) for p in projections)
        down = sum(product(p.weight.minimum(0), calibration.source(p.pre)[part], np.float64) for p in projections)
        return max(float(np.max(up)), float(-np.min(down)))

    return max(_in_batches(calibration, largest))


def _count_flips(layer: _Layer, post: int, calibration: Calibration) -> int:
    def flips(part: slice) -> int:
        sums = sum(integer_sums(p.effective(), calibration.source(p.pre)[part]) for p in layer.projections)
        spikes, _ = integer_recurrence(layer.population, np.asarray(sums))
        return int(np.count_nonzero(spikes != calibration.spikes[post][part]))

    return int(sum(_in_batches(calibration, flips)))


def _in_batches(calibration: Calibration, measure: Callable[[slice], float]) -> list[float]:
    parts = [slice(start, start + BATCH) for start in range(0, len(calibration.events), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(measure, parts))


def _fit(
    population: Population,
    projections: tuple[Projection, ...],
    bits: int,
    mantissa_scale: float,
    exponent: int,
    observed: float | None,
) -> tuple[_Layer, float] | None:
    """Layer with the finest scale up to `mantissa_scale` that stays within the accumulator, and its one-sided sum.

    A threshold is a whole number of weight units. Only scales at which it is one exactly are tried, so it carries
    no rounding at all; that costs at most one unit of scale in ``theta * scale``. Rounded weights, and so their sum,
    never shrink when the scale grows: the finest scale (to one part in ``SCALE_STEPS``) is closed in from both sides.
    """

    def tried(units: int) -> tuple[_Layer | None, float]:
        layer = _round_layer(population, projections, units / (population.theta * 2.0**exponent), exponent, bits)
        if layer is None:
            return None, np.inf  # a bias that rounds just out of its register
        return layer, _proven_sum(layer) if observed is None else observed * layer.population.scale

    bias_limit = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    bias_peak = float(np.abs(population.bias).max(initial=0)) * (1 << MEMBRANE_SHIFT)
    biggest = min(THRESHOLD_MANTISSA_MAX, bias_limit * population.theta / bias_peak if bias_peak else np.inf)
    high = int(min(population.theta * mantissa_scale * 2.0**exponent, biggest))
    if high < 1:
        return None
    layer, reached = tried(high)
    if reached <= ONE_STEP_SUM_MAX and layer is not None:
        return layer, reached
    low, best, over = 0, None, reached
    narrowed = True
    while high - low > max(1, low // SCALE_STEPS):
        # in proportion as long as that narrows well, else in the middle: sums of few coarse weights grow in leaps
        under = best[1] if best is not None else 0.0
        share = (ONE_STEP_SUM_MAX - under) / (over - under) if narrowed and np.isfinite(over) else 0.5
        units = min(max(low + int(share * (high - low)), low + 1), high - 1)
        before = high - low
        layer, reached = tried(units)
        if layer is not None and reached <= ONE_STEP_SUM_MAX:
            low, best = units, (layer, reached)
        else:
            high, over = units, reached
        narrowed = not narrowed or 2 * (high - low) <= before
    return best


def _candidate(
    population: Population,
    projections: tuple[Projection, ...],
    bits: int,
    mantissa_scale: float,
    exponents: tuple[int, ...],
    observed: float | None,
) -> tuple[_Layer, float] | None:
    """Best compromise between a fine weight scale and a fine threshold, see ``WORTHWHILE``."""
    chosen: tuple[_Layer, float] | None = None
    finest = 0.0
    for exponent in sorted(exponents):
        fitted = _fit(population, projections, bits, mantissa_scale, exponent, observed)
        if fitted is None and chosen is None:
            continue  # the threshold is less than a unit, a larger exponent makes it more
        if fitted is None or _mantissa_scale(fitted[0]) < WORTHWHILE * finest:
            break
        finest = max(finest, _mantissa_scale(fitted[0]))
        chosen = fitted
    return chosen


def _mantissa_scale(layer: _Layer) -> float:
    return layer.population.scale / 2.0 ** layer.projections[0].exponent


def _shortlist(
    network: Network,
    post: int,
    bits: int,
    exponents: tuple[int, ...],
    calibration: Calibration | None,
    observed: float | None,
) -> list[_Candidate]:
    """Scales of one population worth a closer look, best first; a single one without calibration."""
    population = network.populations[post]
    projections = tuple(p for p in network.projections if p.post == post)
    peak = max(float(np.abs(p.weight.data).max(initial=0)) for p in projections)
    full = (256 - weight_step(bits)) / peak if peak else 1.0 / population.theta
    factors = CLIPPING if calibration is not None else (1.0,)
    fitted = [_candidate(population, projections, bits, full * f, exponents, observed) for f in factors]
    # one scale at two exponents is two candidates: mantissas and clipping differ
    found = list({(_mantissa_scale(c[0]), c[0].population.scale): c for c in fitted if c is not None}.values())
    if not found:
        raise ModelError(
            f"{population.name}: no scale at {bits} bits keeps its threshold of at least one unit within the "
            f"accumulator ({ONE_STEP_SUM_MAX} units a step); use more bits or smaller weights"
        )
    if calibration is None:
        return [_Candidate(layer=found[0][0], reached=found[0][1], flips=None, tried=1)]
    counted = [
        _Candidate(layer=layer, reached=reached, flips=_count_flips(layer, post, calibration), tried=len(found))
        for layer, reached in found
    ]
    counted.sort(key=lambda candidate: candidate.flips or 0)
    worst = SHORTLIST_RATIO * (counted[0].flips or 0)
    return [candidate for candidate in counted[:SHORTLIST] if (candidate.flips or 0) <= worst]


def _settle(network: Network, shortlists: list[list[_Candidate]], calibration: Calibration) -> list[_Candidate]:
    """Pick one scale per population, in order, by how far the whole network's class counts move from float64."""
    wanted = calibration.spikes[network.readout.population].sum(axis=1, dtype=np.int64)
    chosen = [candidates[0] for candidates in shortlists]
    for post, candidates in enumerate(shortlists):
        if len(candidates) > 1:
            distances = []
            for candidate in candidates:
                trial = _assemble(network, [candidate if i == post else kept for i, kept in enumerate(chosen)])
                spikes = run_integer(trial, calibration.events).spikes[network.readout.population]
                distances.append(int(np.abs(spikes.sum(axis=1, dtype=np.int64) - wanted).sum()))
            chosen[post] = candidates[distances.index(min(distances))]
    return chosen


def _assemble(network: Network, chosen: list[_Candidate]) -> IntegerNetwork:
    return IntegerNetwork(
        input=network.input,
        populations=tuple(candidate.layer.population for candidate in chosen),
        projections=tuple(projection for candidate in chosen for projection in candidate.layer.projections),
        readout=network.readout,
        classes=network.classes,
    )


def _explain(network: Network, post: int, chosen: _Candidate, bits: int, calibration: Calibration | None) -> Choice:
    limit = (256 - weight_step(bits)) / _mantissa_scale(chosen.layer) * (1 + 1e-12)
    incoming = [p for p in network.projections if p.post == post]
    return Choice(
        layer=network.populations[post].name,
        scale=chosen.layer.population.scale,
        exponent=chosen.layer.projections[0].exponent,
        clipped=int(sum(np.count_nonzero(np.abs(p.weight.data) > limit) for p in incoming)),
        candidates=chosen.tried,
        flips=chosen.flips,
        spikes=None if calibration is None else int(np.count_nonzero(calibration.spikes[post])),
        headroom=1 - chosen.reached / ONE_STEP_SUM_MAX,
    )


def quantize(
    network: Network,
    target: Target,
    *,
    bits: int = 8,
    calibration: Calibration | None = None,
    ranges: str = "proven",
    margin: float = 0.1,
) -> tuple[IntegerNetwork, tuple[Choice, ...]]:
    """Choose one scale per population and round weights, thresholds, biases and decays.

    Parameters
    ----------
    network : Network
        Float stage.
    target : Target
        Permitted widths and exponents.
    bits : int
        Storage width of the weights.
    calibration : Calibration, optional
        Float spikes on training recordings; without it scales come from the weights and the proven bounds alone.
    ranges : {"proven", "observed"}
        ``proven`` keeps the accumulator in range for any input; ``observed`` only for what the calibration
        recordings bring, plus `margin`, and leaves the check to the simulator.
    margin : float
        Share added to an observed range.

    Returns
    -------
    IntegerNetwork
        Integer stage.
    tuple of Choice
        One per population.

    Raises
    ------
    OptionError
        If `bits` or `ranges` does not exist, or ``observed`` lacks a calibration.
    ModelError
        If a population has no usable scale.
    """
    allowed = target.choices["synapse.weight_bits"]
    if bits not in allowed:
        raise OptionError(
            f"--weight-bits {bits}: {target.title} does not store that width; allowed: {', '.join(map(str, allowed))}"
        )
    if ranges not in RANGES:
        raise OptionError(f"--ranges {ranges}: unknown; allowed: {', '.join(RANGES)}")
    if ranges == "observed" and calibration is None:
        raise OptionError("--ranges observed: nothing was observed; give --calibrate, or use --ranges proven")
    exponents = target.choices["synapse.exponent"]
    shortlists = []
    for post in range(len(network.populations)):
        incoming = tuple(p for p in network.projections if p.post == post)
        observed = None
        if ranges == "observed" and calibration is not None:
            observed = _observed_sum(incoming, calibration) * (1 + margin)
        shortlists.append(_shortlist(network, post, bits, exponents, calibration, observed))
    if calibration is None:
        chosen = [candidates[0] for candidates in shortlists]
    else:
        chosen = _settle(network, shortlists, calibration)
    choices = tuple(_explain(network, post, candidate, bits, calibration) for post, candidate in enumerate(chosen))
    return _assemble(network, chosen), choices
