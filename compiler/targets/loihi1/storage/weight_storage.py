"""How a population is stored: width and exponents of its weights, threshold of each neuron; and rounding to that.

This is the one place where weights become mantissas, for the compiler and for quantisation-aware training
alike.

A scale is never stored beside a threshold: a neuron whose threshold is ``T`` weight units has ``T / theta``
weight units to each membrane unit of the float model, so the threshold carries no rounding at all.

*Planes.* A synapse may be stored several times, with different exponents; the chip adds them up. Two planes of eight
bits are one weight of up to 16 bits. Only a weight that the finest plane cannot hold uses the next one.
"""

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler import ir
from spikeloom.compiler.targets.loihi1.bounds import extreme_membranes, largest_current, one_sided
from spikeloom.compiler.targets.loihi1.integers import MANTISSA, IntegerPopulation, IntegerProjection
from spikeloom.compiler.targets.loihi1.registers import (
    CURRENT_MAX,
    DECAY_ONE,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    decay_registers,
    encode_bias,
    round_steps,
    split_planes,
)
from spikeloom.compiler.types import AnyArray, FloatArray, IntArray

FORGETS = DECAY_ONE - 1
"""`decay_u` of a current that forgets everything in one step."""


def scales(population: ir.Population, form: ir.Form) -> FloatArray:
    """Weight units per membrane unit of the float model; shape (neurons,)."""
    return form.threshold / population.theta


def store_steps(projection: ir.Projection, steps: IntArray, form: ir.Form) -> tuple[IntegerProjection, ...]:
    """One integer projection for each plane in use; the finest holds every structural synapse."""
    pre = projection.pre
    post = projection.post
    stored = list[IntegerProjection]()
    for exponent, mantissa in zip(
        form.exponents, split_planes(steps, form.bits, form.exponents), strict=True
    ):
        weight = ir.with_data(projection.weight, mantissa.astype(MANTISSA, copy=False))
        if stored:
            weight = weight.copy()
            weight.eliminate_zeros()
        if weight.nnz or not stored:
            stored.append(
                IntegerProjection(pre=pre, post=post, weight=weight, exponent=exponent, bits=form.bits)
            )
    return tuple(stored)


def nearest_steps(population: ir.Population, projection: ir.Projection, form: ir.Form) -> IntArray:
    """Weights of a projection in whole steps of the finest plane, each rounded to the nearest; shape (synapses,)."""
    weight = projection.weight
    scale = scales(population, form)
    alike = len(scale) > 0 and np.ptp(scale) == 0
    steps = np.empty(weight.nnz, MANTISSA if len(form.exponents) == 1 else np.int32)
    for rows in ir.row_parts(weight):
        entries = slice(weight.indptr[rows.start], weight.indptr[rows.stop])
        ends = weight.indptr[rows.start : rows.stop + 1]
        each = scale[0] if alike else np.repeat(scale[rows], np.diff(ends))
        steps[entries] = round_steps(weight.data[entries], each, form.bits, form.exponents)
    return steps


def round_population(
    population: ir.Population,
    projections: tuple[ir.Projection, ...],
    form: ir.Form,
    steps: Sequence[IntArray] | None = None,
    bias: FloatArray | None = None,
) -> tuple[IntegerPopulation, tuple[IntegerProjection, ...]]:
    """Registers of one population and its synapses, every weight rounded to the nearest.

    Where `steps` are given, an array for each projection, they are taken instead of the weights; a `bias`
    (neurons,), in model units, instead of the population's. ValueError if one has no register value.
    """
    scale = scales(population, form)
    wanted = population.bias if bias is None else bias
    mantissa, exponent = encode_bias(wanted * scale * (1 << MEMBRANE_SHIFT))
    decay_u, decay_v = decay_registers(population.beta, population.alpha)
    integer = IntegerPopulation(
        name=population.name,
        beta=population.beta,
        theta=population.theta,
        alpha=population.alpha,
        scale=scale,
        decay_u=decay_u,
        decay_v=decay_v,
        threshold=form.threshold,
        bias_mantissa=mantissa,
        bias_exponent=exponent,
    )
    steps = steps or [nearest_steps(population, p, form) for p in projections]
    pairs = zip(projections, steps, strict=True)
    return integer, tuple(plane for p, data in pairs for plane in store_steps(p, data, form))


def current_load(decay_u: int) -> float:
    """Share of its register that a current can fill, against that of the accumulator which a sum of one step fills.

    A current that loses ``(decay_u + 1) / 4096`` a step adds up to ``4096 / (decay_u + 1)`` sums, in a
    register four times as wide. At least 1: the accumulator comes first.
    """
    return max(1.0, ONE_STEP_SUM_MAX * (4096 / (decay_u + 1)) * (1 << MEMBRANE_SHIFT) / CURRENT_MAX)


def loads(population: IntegerPopulation, projections: tuple[IntegerProjection, ...]) -> FloatArray:
    """One-sided sums, or more where a current that outlasts its step fills a register sooner; shape (neurons,).

    What is within ``ONE_STEP_SUM_MAX`` overflows neither accumulator nor current, whatever the input. Nor
    does it saturate a membrane, unless that keeps more than half of itself: the scale would then be too
    coarse.
    """
    return fullest(population, *one_sided(projections, population.size))


def fullest(population: IntegerPopulation, up: AnyArray, down: AnyArray) -> FloatArray:
    """What :func:`loads` gives, from the largest positive and negative sum of a step, (neurons,) in weight units."""
    filled: FloatArray = np.maximum(up, down).astype(np.float64)
    if population.decay_u == FORGETS:
        return filled
    filled *= current_load(population.decay_u)
    if 2 * population.decay_v >= DECAY_ONE:
        currents = (largest_current(sums, population.decay_u) for sums in (up, down))
        ends = extreme_membranes(population.threshold, population.bias, population.decay_v, *currents)
        filled = np.maximum(filled, np.maximum(*ends) * (ONE_STEP_SUM_MAX / MEMBRANE_MAX))
    return filled
