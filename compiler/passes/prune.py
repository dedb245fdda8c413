"""Disconnect what provably does nothing in the float model: neurons that can never fire.

The bounds hold for any input, so every spike that is left is as before. Such a neuron is taken out before
rounding: its weights then no longer take room in the accumulators of its targets, whose scales become finer.
Left out on request only: neurons that did not fire on the training recordings.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from spikeloom.compiler.ir import INPUT, Graph, Network, Sparse, entry_parts, row_parts, with_data
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

Masks = tuple[BoolArray, ...]
"""Some neurons of each population."""

Known = dict[int, BoolArray]
"""Neurons that are known to do nothing, by population; the channels of the input under ``INPUT``."""

Judge = Callable[[int, Known], BoolArray]
"""Says which neurons of a population do nothing, given what is known to do nothing."""

FLOAT32_ROUNDING = 2.0**-23
"""Relative error of one float32 operation, doubled: the float model is silent in that precision and order too."""


def never_fires(network: Network) -> Masks:
    """Neurons of the float model that no input can make fire, in any order of summation, in float32 or wider.

    Neurons that vote are never among them.

    A neuron that has not fired holds at most ``sum(positive weights) + bias``, added up by the leak, where a
    current that outlasts its step has added up the weights already.
    """
    silent = spread(network, lambda post, known: _never_fires(network, post, known))
    return _without_voters(network, tuple(silent[post] for post in range(len(network.populations))))


def spread(network: Graph, judge: Judge) -> Known:
    """Neurons of all populations that `judge` says do nothing, first population first: silence spreads."""
    silent: Known = {INPUT: np.zeros(network.input.size, np.bool_)}
    for post in range(len(network.populations)):
        grow(network, post, silent, judge)
    return silent


def grow(network: Graph, post: int, known: Known, judge: Judge) -> None:
    """Let `judge` say which neurons of a population do nothing, given what is known to do nothing."""
    known[post] = np.zeros(network.populations[post].size, np.bool_)
    known[post] = judge(post, known)
    if any(p.pre == p.post == post for p in network.projections):
        while not np.array_equal(known[post], more := judge(post, known)):
            known[post] = more


def _sums(network: Network, post: int, silent: Known) -> tuple[FloatArray, FloatArray]:
    """Sums of the positive weights into each neuron from those that are not silent, and of all their magnitudes."""
    up = np.zeros(network.populations[post].size)
    total = up.copy()
    for p in network.projections:
        if p.post == post:
            fires = (~silent[p.pre]).astype(np.float64)
            for rows in row_parts(p.weight):
                weight = p.weight[rows]
                up[rows] += weight.maximum(0) @ fires
                total[rows] += abs(weight) @ fires
    return up, total


def settled(inflow: FloatArray | IntArray, kept: FloatArray | float) -> FloatArray:
    """Limit of ``x <- kept * x + inflow``: what a leaking register can add up to."""
    endless = np.where(inflow > 0, np.inf, 0.0)
    return np.divide(inflow, 1 - kept, out=endless, where=np.less(kept, 1))


def _never_fires(network: Network, post: int, silent: Known) -> BoolArray:
    """Neurons of one population that cannot fire as long as those that are known to be silent do not."""
    population = network.populations[post]
    up, total = _sums(network, post, silent)
    inputs = sum(p.weight.shape[1] for p in network.projections if p.post == post)
    lasts = population.alpha * (1 + 8 * FLOAT32_ROUNDING)
    gathered = np.inf if lasts >= 1 else 1 / (1 - lasts)
    slack = (inputs + 8) * FLOAT32_ROUNDING * (total + np.abs(population.bias)) * gathered
    with np.errstate(invalid="ignore"):
        most = np.maximum(np.where(up > 0, up * gathered, 0.0) + population.bias + slack, 0)
    kept = population.beta * (1 + 8 * FLOAT32_ROUNDING)
    return settled(most, kept) <= population.theta * (1 - 8 * FLOAT32_ROUNDING)


def never_fired(network: Network, calibration: Calibration) -> Masks:
    """Neurons that did not fire on the calibration recordings; never among them are those that vote."""
    return _without_voters(network, tuple(rate == 0 for rate in calibration.rates))


def none_of(network: Graph) -> Masks:
    """No neuron of any population."""
    return tuple(np.zeros(population.size, np.bool_) for population in network.populations)


def either(first: Masks, second: Masks) -> Masks:
    """Neurons of one mask or the other."""
    return tuple(np.asarray(a | b, np.bool_) for a, b in zip(first, second, strict=True))


def disconnect(network: Network, gone: Masks) -> Network:
    """Set the weights from and to some neurons, and their biases, to zero; the structure stays."""
    if not any(mask.any() for mask in gone):
        return network
    return replace(
        network,
        populations=tuple(
            replace(population, bias=np.where(mask, 0.0, population.bias))
            for population, mask in zip(network.populations, gone, strict=True)
        ),
        projections=tuple(
            replace(p, weight=zeroed(p.weight, gone[p.post], of_source(gone, p.pre, p.weight.shape[1])))
            for p in network.projections
        ),
        convolution=None,
    )


def _without_voters(network: Network, masks: Masks) -> Masks:
    voting = network.readout.population
    return tuple(np.zeros_like(mask) if i == voting else mask for i, mask in enumerate(masks))


def of_source(masks: Sequence[BoolArray], pre: int, size: int) -> BoolArray:
    """Mask of a source; if that is the input, none of its `size` channels."""
    return np.zeros(size, np.bool_) if pre == INPUT else masks[pre]


def touched(weight: Sparse, rows: BoolArray, columns: BoolArray) -> BoolArray:
    """Whether each stored synapse is in one of these rows or columns."""
    inside = np.repeat(rows, np.diff(weight.indptr))
    for part in entry_parts(weight):
        inside[part] |= columns[weight.indices[part]]
    return inside


def zeroed(weight: Sparse, rows: BoolArray, columns: BoolArray) -> Sparse:
    """Set some rows and columns to zero; the structure stays."""
    return with_data(weight, np.where(touched(weight, rows, columns), 0, weight.data))
