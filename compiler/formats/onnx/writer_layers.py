"""What an integer ONNX graph needs to know of a netlist: layers, digits of weights, and how wide its numbers get.

Weights become matrices of int8 digits: ``weight = unit * sum_k digit_k * 256**k`` with digits from -128 to 127, one
unit for the matrix or one for each neuron. A product of spikes (0 and 1) with digits is ``MatMulInteger``, exact in its
int32 sums and faster than float32: most netlists need a single digit. Weights that several synapses of a pair store
(planes) are added up first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.formats.names import plain_names
from spikeloom.compiler.formats.onnx.builder import require_room
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.loihi1.netlist import Netlist, Reach, reach
from spikeloom.compiler.types import IntArray

ONE = 2**DECAY_BITS
NARROW = 2**31 - 1
"""Largest number of an int32 layer."""

Digit = tuple[npt.NDArray[np.int8], IntArray]
"""Matrix (sources, neurons) of a digit, and what a one in it adds to each neuron, in weight units."""


Weights = tuple[IntArray, IntArray]
"""Sums of positive and of negative effective weights, as magnitudes, (neurons of the source, neurons)."""


def of_sign(weights: Weights, sign: int) -> IntArray:
    """All weights (0), or magnitudes of the positive (1) or the negative ones (-1)."""
    positive, negative = weights
    return {0: positive - negative, 1: positive, -1: negative}[sign]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """One population as the graph computes it; arrays (n,) have an entry per compartment, ordered by neuron."""

    index: int  # into ``netlist.layers``
    name: str  # unique, without dots
    ids: IntArray  # compartments
    depth: int  # steps that it lags behind the data
    sources: dict[int, Weights]  # by the index of a layer in ``netlist.layers``, or ``INPUT``
    decay_u: IntArray
    decay_v: IntArray
    threshold: IntArray  # membrane units, as the bias
    bias: IntArray
    label: IntArray  # class of a vote, -1 for none
    remembers: bool  # a current outlasts its step
    checked: bool  # some input could make the synaptic sum or the current overflow
    saturates: bool  # some input could bring the membrane to the end of its register
    kind: type[np.int32] | type[np.int64]  # int32 where no input brings any product or sum beyond it

    @property
    def size(self) -> int:
        """Number of compartments."""
        return len(self.ids)


def digits(weight: IntArray) -> tuple[Digit, ...]:
    """Write a matrix of integers in int8 digits.

    Examples
    --------
    >>> [(digit.tolist(), factor.tolist()) for digit, factor in digits(np.array([[508, -254]]))]
    [([[127, -127]], [4, 2])]
    >>> [(digit.tolist(), factor.tolist()) for digit, factor in digits(np.array([[300, 1]]))]
    [([[75, 1]], [4, 1])]
    >>> [(digit.tolist(), factor.tolist()) for digit, factor in digits(np.array([[301, 128]]))]
    [([[45, -128]], [1, 1]), ([[1, 1]], [256, 256])]
    """
    common = np.bitwise_or.reduce(np.abs(weight), axis=0)
    units = np.where(common == 0, 1, common & -common)
    whole = np.bitwise_or.reduce(common)
    single = np.full_like(units, max(int(whole & -whole), 1))
    return min((_digits(weight, unit) for unit in (single, units)), key=len)


def _digits(weight: IntArray, unit: IntArray) -> tuple[Digit, ...]:
    found: list[Digit] = []
    rest, factor = weight // unit, unit
    while not found or rest.any():
        low = ((rest + 128) & 255) - 128
        found.append((low.astype(np.int8), factor))
        rest, factor = (rest - low) >> 8, factor << 8
    return tuple(found)


def plan(netlist: Netlist) -> tuple[Layer, ...]:
    """Layers that have compartments, in the order of their depth.

    Raises ModelError if their weights as dense matrices are more than a file holds.
    """
    names = plain_names([layer.name for layer in netlist.layers], taken=["input"])
    pre_of_axon = np.append(np.full(netlist.n_inputs, INPUT), netlist.layer)[netlist.axon_source]
    # zeros of dense lists are no synapses
    weight = netlist.effective_weight()
    real = weight != 0
    weight, axon, target = weight[real], netlist.axon_of_synapse()[real], netlist.synapse_compartment()[real]
    pre, post = pre_of_axon[axon], netlist.layer[target]
    pairs = np.unique(np.stack([post, pre], axis=1), axis=0)
    place = netlist.number_in_layer()
    counts = {INPUT: netlist.n_inputs} | dict(enumerate(np.bincount(netlist.layer, minlength=len(names)).tolist()))
    require_room(sum(counts[a] * counts[b] for b, a in pairs.tolist()))
    row = np.append(np.arange(netlist.n_inputs), place)[netlist.axon_source[axon]]

    def weights(a: int, b: int) -> Weights:
        found = [(pre == a) & (post == b) & side for side in (weight > 0, weight < 0)]
        entries = [(np.abs(weight[side]), (row[side], place[target[side]])) for side in found]
        positive, negative = (sparse.coo_array(each, shape=(counts[a], counts[b])).toarray() for each in entries)
        return positive, negative

    reached = reach(netlist)
    layers = [
        _layer(netlist, index, name, {a: weights(a, b) for b, a in pairs.tolist() if b == index}, reached)
        for index, name in enumerate(names)
        if counts[index]
    ]
    return tuple(sorted(layers, key=lambda layer: layer.depth))


def _layer(netlist: Netlist, index: int, name: str, sources: dict[int, Weights], reached: Reach) -> Layer:
    ids = netlist.compartments_of(index)
    sums, current, highest, stored = (bound[ids] for bound in reached)
    lost_u, lost_v = netlist.decay_u[ids] + 1, netlist.decay_v[ids]
    threshold = netlist.threshold[ids] << MEMBRANE_SHIFT
    bias = netlist.bias_mantissa[ids] << netlist.bias_exponent[ids]
    held_current, held = np.minimum(current, CURRENT_MAX), np.minimum(stored, MEMBRANE_MAX)
    widest = max(
        int((held * (ONE - lost_v)).max()),
        int((held_current * (ONE - lost_u)).max()),
        int((held + held_current + np.abs(bias)).max()) + _gathered(sources),
    )
    return Layer(
        index=index,
        name=name,
        ids=ids,
        depth=netlist.layers[index].depth,
        sources=sources,
        decay_u=netlist.decay_u[ids],
        decay_v=lost_v,
        threshold=threshold,
        bias=bias,
        label=netlist.readout_class[ids],
        remembers=bool(np.any(lost_u != ONE)),
        checked=bool(np.any(sums > ACCUMULATOR_MAX) or np.any(current > CURRENT_MAX)),
        saturates=bool(np.any(np.maximum(highest, stored) > MEMBRANE_MAX)),
        kind=np.int32 if widest <= NARROW else np.int64,
    )


def _gathered(sources: dict[int, Weights]) -> int:
    """Bound of any partial result while products with digits are added up, membrane units."""
    every = [digit for weights in sources.values() for sign in (0, 1, -1) for digit in digits(of_sign(weights, sign))]
    sums = [(np.abs(digit.astype(np.int64)).sum(axis=0) * factor).max(initial=0) for digit, factor in every]
    return int(sum(sums)) << MEMBRANE_SHIFT
