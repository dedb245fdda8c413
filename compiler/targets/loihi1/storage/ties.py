"""Sums that are exactly a threshold: what decides them on the chip, whose membrane cannot forget all.

Weights of a neuron that are multiples of a step add up to multiples of it, so that a bias may lie anywhere
between two of them and decides the same. A membrane that is to keep nothing keeps 1/4096, which a bias makes
up for where that is less than a step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.ir import Sparse, added_up, row_parts
from spikeloom.compiler.targets.loihi1.bounds import extreme_membranes, one_sided
from spikeloom.compiler.targets.loihi1.integers import IntegerPopulation, IntegerProjection
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    DECAY_ONE,
    MEMBRANE_SHIFT,
    encode_bias,
)
from spikeloom.compiler.targets.loihi1.storage.scales import FloatLayer, Rounded
from spikeloom.compiler.types import BoolArray, IntArray

WHOLE = 2.0**20 * 3**2 * 5 * 7 * 11 * 13
"""Real weights that are multiples of one part of so many can add up to a threshold exactly.

A reader that brings neurons to one threshold leaves whole weights as thirds, fifths and so on.
"""

CLOSE = 2.0**-48
"""A number this close to a whole one, as a share of it, is that, but for the rounding of float64."""

COARSE = 2**10
"""Weights up to so many steps count as of few values: sums of finer ones meet a threshold by chance alone."""


def _steps(weights: Mapping[int, Sparse]) -> IntArray:
    """Largest number of which all weights of a neuron are multiples, 0 without weights; shape (neurons,)."""
    whole = sparse.hstack([weights[pre] for pre in sorted(weights)], format="csr").astype(np.int64)
    step = np.zeros(whole.shape[0], np.int64)
    filled = np.flatnonzero(np.diff(whole.indptr))
    if len(filled):
        step[filled] = np.gcd.reduceat(np.abs(whole.data), whole.indptr[filled])
    return step


def _whole(layer: FloatLayer) -> BoolArray:
    """Which neurons have weights, and whole numbers alone in parts of ``WHOLE``, as is their bias."""
    bias = layer.population.bias * WHOLE
    whole = np.abs(bias - np.rint(bias)) <= CLOSE * np.abs(bias)
    largest = max((p.weight for p in layer.projections), key=lambda weight: weight.nnz)
    for rows in row_parts(largest):  # most layers have none, and large ones would fill the memory
        most = np.zeros(len(whole[rows]))
        for weight in added_up((p.pre, p.weight[rows] * WHOLE) for p in layer.projections).values():
            apart = abs(weight - weight.rint()) - CLOSE * abs(weight)
            whole[rows] &= apart.max(axis=1).toarray().ravel() <= 0
            most = np.maximum(most, abs(weight).max(axis=1).toarray().ravel())
        whole[rows] &= (most > 0) & (most < 2**62)
    return whole


def _stored(stored: Rounded) -> dict[int, Sparse]:
    """Weights from each source in membrane units."""
    return added_up(
        (p.pre, p.effective().astype(np.int64) * (1 << MEMBRANE_SHIFT)) for p in stored.projections
    )


def remainders(
    population: IntegerPopulation, projections: Sequence[IntegerProjection]
) -> tuple[IntArray, IntArray]:
    """Most that a membrane which is to keep nothing brings into a step, and, as a magnitude, least; (neurons,)."""
    up, down = (
        (side << MEMBRANE_SHIFT).astype(np.float64) for side in one_sided(projections, population.size)
    )
    lowest = extreme_membranes(population.threshold, population.bias, population.decay_v, up, down)[1]
    most = (population.threshold << MEMBRANE_SHIFT) // DECAY_ONE
    return most, np.ceil(lowest / DECAY_ONE).astype(np.int64) + 1  # the bias is still to move


def _bounds(stored: Rounded, step: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Lowest and highest bias of each neuron with which it fires at the same sums, whatever its membrane keeps.

    Also which neurons have sums on either side, or next to, their threshold. All (neurons,).
    """
    chip = stored.population
    threshold = chip.threshold << MEMBRANE_SHIFT
    up, down = (side << MEMBRANE_SHIFT for side in one_sided(stored.projections, chip.size))
    above, below = remainders(chip, stored.projections)
    fires = (threshold - chip.bias) // np.maximum(step, 1) + 1
    concerned = (step > 0) & ((fires - 1) * step <= up) & (-down <= fires * step)
    return threshold - fires * step + below, threshold - (fires - 1) * step - above, concerned


def without_memory(layer: FloatLayer, stored: Rounded) -> Rounded:
    """Move biases so that a layer that is to keep nothing fires as if it did, where its weights are coarse enough."""
    chip = stored.population
    if layer.population.beta or layer.population.alpha:
        return stored
    low, high, concerned = _bounds(stored, _steps(_stored(stored)))
    usable = concerned & (low <= high)
    usable[chip.size - layer.population.relays :] = False  # a relay has no bias
    most = BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX
    wanted = np.where(usable, np.clip(chip.bias, low, high), chip.bias)
    mantissa, exponent = encode_bias(np.clip(wanted, -most, most).astype(np.float64))
    bias = mantissa << exponent
    usable &= (low <= bias) & (bias <= high)
    return replace(
        stored,
        population=replace(
            chip,
            bias_mantissa=np.where(usable, mantissa, chip.bias_mantissa),
            bias_exponent=np.where(usable, exponent, chip.bias_exponent),
        ),
    )


def ties_moved(layer: FloatLayer, stored: Rounded) -> int:
    """How many neurons sums can bring exactly to their threshold that decide these, as stored, otherwise.

    Known of layers whose weights have few values: of all sums where the membrane keeps nothing, or all, else of those
    that one step adds to a membrane at rest.
    """
    population = layer.population
    chip = stored.population
    if population.alpha:
        return 0
    lasting = population.beta == 1
    whole = _whole(layer)
    if not whole.any():
        return 0
    kept = sparse.diags_array(whole.astype(np.float64))
    floats = added_up((p.pre, p.weight * WHOLE) for p in layer.projections)
    floats = {pre: (kept @ weight.rint()).tocsr() for pre, weight in floats.items()}
    bias = np.where(whole, np.rint(population.bias * WHOLE), 0).astype(np.int64)
    step = _steps(floats)
    weights = _stored(stored)
    chip_step = _steps(weights)
    if lasting:  # a bias adds up as a weight does
        step = np.gcd(step, bias)
        chip_step = np.gcd(chip_step, chip.bias)
    most = np.max([abs(weight).max(axis=1).toarray().ravel() for weight in floats.values()], axis=0)
    needed = population.theta * WHOLE - (0 if lasting else bias)
    due = np.rint(needed / np.maximum(step, 1))
    tied = whole & (step > 0) & (np.abs(due * step - needed) <= CLOSE * population.theta * WHOLE)
    tied &= (due > 0) & (most <= COARSE * step)
    if not lasting:
        reach = np.sum([weight.maximum(0).sum(axis=1) for weight in floats.values()], axis=0)
        tied &= due * step <= reach
    same = _alike(floats, weights, np.maximum(step, 1), chip_step) & (chip_step > 0)
    units = chip.threshold << MEMBRANE_SHIFT
    if lasting:
        same &= chip.bias * step == bias * chip_step
    else:
        units = units - chip.bias
    if not population.beta:
        low, high, concerned = _bounds(stored, chip_step)
        same &= ~concerned | ((low <= chip.bias) & (chip.bias <= high))
    same &= units // np.maximum(chip_step, 1) == due
    return int(np.count_nonzero(tied & ~same))


def _alike(
    floats: Mapping[int, Sparse], weights: Mapping[int, Sparse], step: IntArray, chip_step: IntArray
) -> BoolArray:
    """Which neurons have as many steps in each weight as the real one."""
    alike = np.ones(len(step), bool)
    for pre, weight in floats.items():
        steps = (sparse.diags_array(1 / step) @ weight).rint()
        apart = abs(sparse.diags_array(chip_step.astype(np.float64)) @ steps - weights[pre]).max(axis=1)
        alike &= apart.toarray().ravel() == 0
    return alike
