"""Sums that are exactly a threshold: what decides them on the chip, whose membrane cannot forget all.

Weights of a neuron that are multiples of a step add up to multiples of it, so that a bias may lie anywhere
between two of them and decides the same. A membrane that is to keep nothing keeps 1/4096, which a bias makes
up for where that is less than a step.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.ir import Sparse, added_up
from spikeloom.compiler.targets.loihi1.bounds import extreme_membranes, one_sided
from spikeloom.compiler.targets.loihi1.integers import IntegerPopulation
from spikeloom.compiler.targets.loihi1.registers import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    DECAY_ONE,
    MEMBRANE_SHIFT,
    encode_bias,
)
from spikeloom.compiler.targets.loihi1.storage.scales import FloatLayer, Rounded
from spikeloom.compiler.types import BoolArray, IntArray

WHOLE = 2.0**20
"""Real weights that are multiples of one part of so many can add up to a threshold exactly."""

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


def _stored(stored: Rounded) -> dict[int, Sparse]:
    """Weights from each source in membrane units."""
    return added_up(
        (p.pre, p.effective().astype(np.int64) * (1 << MEMBRANE_SHIFT)) for p in stored.projections
    )


def _bounds(stored: Rounded, step: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Lowest and highest bias of each neuron with which it fires at the same sums, whatever its membrane keeps.

    Also which neurons have sums on either side, or next to, their threshold. All (neurons,).
    """
    chip = stored.population
    threshold = chip.threshold << MEMBRANE_SHIFT
    up, down = (side << MEMBRANE_SHIFT for side in one_sided(stored.projections, chip.size))
    floats = up.astype(np.float64), down.astype(np.float64)
    lowest = extreme_membranes(chip.threshold, chip.bias, chip.decay_v, *floats)[1]
    below = np.ceil(lowest / DECAY_ONE).astype(np.int64) + 1  # the bias is still to move
    above = threshold // DECAY_ONE
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

    Known of layers that keep nothing, or all, of their membrane, with weights of few values.
    """
    population = layer.population
    chip = stored.population
    if population.alpha or population.beta not in (0, 1):
        return 0
    floats = added_up((p.pre, p.weight * WHOLE) for p in layer.projections)
    if not all(np.array_equal(weight.data, np.rint(weight.data)) for weight in floats.values()):
        return 0
    if max(np.abs(weight.data).max(initial=0) for weight in floats.values()) >= 2**62:
        return 0
    step = _steps(floats)
    weights = _stored(stored)
    chip_step = _steps(weights)
    most = np.max([abs(weight).max(axis=1).toarray().ravel() for weight in floats.values()], axis=0)
    due, rest = np.divmod((population.theta - population.bias) * WHOLE, np.maximum(step, 1))
    tied = (step > 0) & (rest == 0) & (due > 0) & (most <= COARSE * step)
    if population.beta:
        tied &= population.bias == 0
    else:
        reach = np.sum([weight.maximum(0).sum(axis=1) for weight in floats.values()], axis=0)
        tied &= due * step <= reach
    same = _alike(floats, weights, np.maximum(step, 1), chip_step) & (chip_step > 0)
    same &= ((chip.threshold << MEMBRANE_SHIFT) - chip.bias) // np.maximum(chip_step, 1) == due
    same &= _keeps_apart(population.beta, chip, stored, chip_step)
    return int(np.count_nonzero(tied & ~same))


def _keeps_apart(beta: float, chip: IntegerPopulation, stored: Rounded, step: IntArray) -> BoolArray:
    """Which neurons decide by their sums alone, whatever the rest that the membrane keeps."""
    if beta:
        return np.asarray(chip.bias == 0)
    low, high, concerned = _bounds(stored, step)
    return ~concerned | ((low <= chip.bias) & (chip.bias <= high))


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
