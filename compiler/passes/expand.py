"""Write the first layer of a system out as synapses: fan-in weights per place and taxel.

A topology adaptive graph convolution (see :mod:`compiler.systems`) gathers the features of its taxels over K
hops::

    y = sum_k A^k x W_k + b          x (taxels, channels), W_k (channels, features), k = 0 … K

which is one matrix for all taxels and channels at once, a Kronecker product for each hop::

    y = W x + b                      W = sum_k A^k ⊗ W_k^T

The other systems differ in what stands for the powers ``A^k``: a stack of matrices (places, taxels), one for
each filter. Outputs equal those of the factored form up to floating-point rounding (float64 throughout).
"""

import numpy as np
from scipy import sparse

from spikeloom.compiler.checkpoint import Checkpoint, neurons_of, towers_of
from spikeloom.compiler.dynamics import RELAY_WEIGHT
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import INPUT, Convolution, Input, Network, Population, Projection, Sparse
from spikeloom.compiler.systems import TACTILESGNET, TITLES, in_order
from spikeloom.compiler.types import BoolArray, FloatArray


def hop_powers(adjacency: FloatArray, hops: int) -> FloatArray:
    """Powers ``A^0 … A^(hops - 1)``; shape (hops, taxels, taxels)."""
    powers = [np.eye(len(adjacency))]
    for _ in range(1, hops):
        powers.append(adjacency @ powers[-1])
    return np.stack(powers)


def stack_of(convolution: Convolution) -> FloatArray:
    """Matrices (filters, places, taxels) through which filters see the taxels."""
    if convolution.system == TACTILESGNET:
        return hop_powers(convolution.propagation, len(convolution.filters))
    return convolution.propagation


def effective_weight(stack: FloatArray, filters: FloatArray) -> FloatArray:
    """``W = sum_k S_k ⊗ g_k`` of filters (filters, features, channels); shape (places, features, taxels, channels)."""
    _, places, taxels = stack.shape
    _, features, channels = filters.shape
    weight = sum(np.kron(matrix, values) for matrix, values in zip(stack, filters, strict=True))
    return np.asarray(weight).reshape(places, features, taxels, channels)


def synapses(stack: FloatArray, filters: FloatArray, system: str = TACTILESGNET) -> Sparse:
    """Weights of a first layer, of a stack (filters, places, taxels) and filters (filters, features, channels).

    The stored entries are all pairs of a place and a taxel that some matrix of the stack connects, whatever
    their weight; rows are in the order of the system's neurons, columns taxel-major.
    """
    weight = effective_weight(stack, filters)
    connected: BoolArray = (stack != 0).any(axis=0)
    connected = np.broadcast_to(connected[:, None, :, None], weight.shape)
    columns = weight.shape[2] * weight.shape[3]
    weight, connected = (in_order(system, array).reshape(-1, columns) for array in (weight, connected))
    row, column = np.nonzero(connected)
    matrix = sparse.csr_array((weight[row, column], (row, column)), shape=weight.shape)
    matrix.sort_indices()
    return matrix


def expand_first_layer(checkpoint: Checkpoint, convolution: Convolution) -> tuple[Sparse, FloatArray]:
    """Weights (neurons, channels) and biases (neurons,) of a first layer, in the order of its neurons.

    A relay for each clock comes last, see :mod:`compiler.dynamics`.
    """
    weight = synapses(stack_of(convolution), convolution.filters.astype(np.float64), convolution.system)
    bias = in_order(convolution.system, np.tile(convolution.bias.astype(np.float64), (checkpoint.places, 1)))
    clocks = checkpoint.dynamics.clocks.channels
    if not clocks:
        return weight, bias
    relays = sparse.diags_array(np.full(clocks, RELAY_WEIGHT * checkpoint.theta), format="csr")
    both = sparse.csr_array(sparse.block_diag([weight, relays], format="csr"))
    both.sort_indices()
    return both, np.append(bias, np.zeros(clocks))


def expand_dense(checkpoint: Checkpoint, layer: int) -> Sparse:
    """Weights of a fully connected layer, (neurons, neurons of the layer before) float64.

    The stored entries are all pairs within a tower, and those from the relays of clocks, whatever their
    weight.
    """
    weight = checkpoint.dense[layer - 1].weight
    before = towers_of(checkpoint)[layer - 1]
    inputs = np.stack([np.flatnonzero(neurons_of(t, before)) for t in range(checkpoint.towers)])
    column = np.repeat(inputs, len(weight) // len(inputs), axis=0)
    first = np.arange(0, weight.size + 1, weight.shape[1])
    return sparse.csr_array(
        (weight.astype(np.float64).ravel(), column.ravel(), first), shape=(len(weight), len(before))
    )


def expand(checkpoint: Checkpoint, propagation: FloatArray) -> Network:
    """Lower trained weights to a network of populations and synapses, in float64.

    Spikes equal those of the float64 model up to the rounding of a differently ordered sum. `propagation` as
    of :class:`ir.Convolution`; ModelError if it disagrees with the weights about the number of taxels,
    places or filters.
    """
    _require_fit(checkpoint, propagation.shape)
    dynamics = checkpoint.dynamics
    convolution = Convolution(
        system=checkpoint.system,
        filters=checkpoint.hops,
        bias=checkpoint.conv_bias,
        propagation=propagation,
        towers=towers_of(checkpoint) if checkpoint.towers > 1 else (),
    )
    stages = [("conv1", *expand_first_layer(checkpoint, convolution))]
    for layer, dense in enumerate(checkpoint.dense, 1):
        stages.append((dense.name, expand_dense(checkpoint, layer), dense.bias.astype(np.float64)))
    polarities = checkpoint.hops.shape[2]
    bins = checkpoint.bins
    return Network(
        input=Input(taxels=checkpoint.taxels, polarities=polarities, clocks=dynamics.clocks, bins=bins),
        populations=tuple(
            Population(
                name=name,
                beta=dynamics.beta(layer, checkpoint.beta),
                theta=checkpoint.theta,
                bias=bias,
                alpha=dynamics.alpha(layer),
                relays=0 if layer else dynamics.clocks.channels,
            )
            for layer, (name, _, bias) in enumerate(stages)
        ),
        projections=tuple(
            Projection(pre=post - 1 if post else INPUT, post=post, weight=weight)
            for post, (_, weight, _) in enumerate(stages)
        ),
        readout=checkpoint.readout,
        classes=checkpoint.classes,
        forms=checkpoint.forms,
        convolution=convolution,
    )


def _require_fit(checkpoint: Checkpoint, shape: tuple[int, ...]) -> None:
    if checkpoint.system == TACTILESGNET:
        if shape != (checkpoint.taxels, checkpoint.taxels):
            raise ModelError(
                f"graph and weights disagree: the graph has {shape[0]} taxels, fc1 was trained on "
                f"{checkpoint.taxels}; give the graph that the checkpoint was trained on"
            )
    elif shape != (len(checkpoint.hops), checkpoint.places, checkpoint.taxels):
        raise ModelError(
            f"sensor and weights disagree: (filters, places, taxels) is {shape}, the weights are of "
            f"{TITLES[checkpoint.system]} with {(len(checkpoint.hops), checkpoint.places, checkpoint.taxels)}; "
            "give the sensor that it was trained on"
        )
