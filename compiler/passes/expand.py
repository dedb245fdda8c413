"""Expand the first layer of a system to the synapses that it means: fan-in weights per place and taxel.

Outputs equal those of the factored form up to floating-point rounding (float64 throughout).

References
----------
.. [1] J. Du et al., "Topology Adaptive Graph Convolutional Networks", 2017, arXiv:1710.10370: the K-hop filter
   ``y = sum_k A^k x g_k + b``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from spikeloom.compiler.dynamics import RELAY_WEIGHT
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.formats.towers import inputs_of
from spikeloom.compiler.ir import INPUT, Input, Network, Population, Projection, Sparse
from spikeloom.compiler.systems import TACTILESGNET, TITLES, in_order

AFFINE_TOLERANCE = 1e-9
"""Largest deviation from affinity, relative to the stage's largest response, that rounding in float64 explains."""


def hop_powers(adjacency: FloatArray, hops: int) -> FloatArray:
    """Powers 0 … `hops` - 1 of a propagation matrix; shape (hops, taxels, taxels)."""
    powers = [np.eye(len(adjacency))]
    for _ in range(1, hops):
        powers.append(adjacency @ powers[-1])
    return np.stack(powers)


def effective_weight(stack: FloatArray, filters: FloatArray) -> FloatArray:
    """``W[p, f, j, c] = sum_k stack[k, p, j] * filters[k, f, c]``; shape (places, features, taxels, channels)."""
    _, features, channels = filters.shape
    weight = np.zeros((stack.shape[1], features, stack.shape[2], channels))
    for matrix, values in zip(stack, filters, strict=True):
        weight += np.einsum("ij,fc->ifjc", matrix, values)
    return weight


def stack_of(checkpoint: Checkpoint, propagation: FloatArray) -> FloatArray:
    """Stack (filters, places, taxels) of a checkpoint's first layer, see :mod:`compiler.systems`.

    Parameters
    ----------
    checkpoint : Checkpoint
        Which system it is, and how many filters it has.
    propagation : (taxels, taxels) or (filters, places, taxels) float64
        Of a TactileSGNet the normalised adjacency, whose powers make the stack; of the others the stack itself.
    """
    if checkpoint.system == TACTILESGNET:
        return hop_powers(propagation, len(checkpoint.hops))
    return propagation


def expand_first_layer(checkpoint: Checkpoint, propagation: FloatArray) -> tuple[Sparse, FloatArray]:
    """Weights and biases of a checkpoint's first layer.

    Returns
    -------
    weight : csr_array (neurons, taxels * channels) float64
        Rows in the order of the system's neurons. The stored entries are all pairs of a place and a taxel that some
        filter connects, whatever their weight.
    bias : (neurons,) float64
    """
    filters = checkpoint.hops.astype(np.float64)
    bias = np.tile(checkpoint.conv_bias.astype(np.float64), (checkpoint.places, 1))
    if checkpoint.system == TACTILESGNET:
        return expand_graph_convolution(propagation, filters), bias.reshape(-1)
    weight = effective_weight(propagation, filters)
    structure = np.broadcast_to((propagation != 0).any(axis=0)[:, None, :, None], weight.shape)
    flat = [in_order(checkpoint.system, array) for array in (weight, structure)]
    columns = weight.shape[2] * weight.shape[3]
    return _stored(*(array.reshape(-1, columns) for array in flat)), in_order(checkpoint.system, bias)


def _with_relays(checkpoint: Checkpoint, weight: Sparse, bias: FloatArray) -> tuple[Sparse, FloatArray]:
    """Weights and biases of the first layer with a relay for each clock, see :mod:`compiler.dynamics`."""
    clocks = checkpoint.dynamics.clocks.channels
    if not clocks:
        return weight, bias
    relays = sparse.diags_array(np.full(clocks, RELAY_WEIGHT * checkpoint.theta), format="csr")
    both = sparse.csr_array(sparse.block_diag([weight, relays], format="csr"))
    both.sort_indices()
    return both, np.append(bias, np.zeros(clocks))


def expand_dense(checkpoint: Checkpoint, layer: int) -> Sparse:
    """Weights of a fully connected layer, (neurons, neurons of the layer before) float64.

    The stored entries are all pairs within a tower, and those from the relays of clocks, whatever their weight.
    """
    weight, inputs = checkpoint.dense[layer - 1].weight, inputs_of(checkpoint, layer)
    before = list(checkpoint.neurons.values())[layer - 1]
    column = np.repeat(inputs, len(weight) // len(inputs), axis=0)
    first = np.arange(0, weight.size + 1, weight.shape[1])
    return sparse.csr_array((weight.astype(np.float64).ravel(), column.ravel(), first), shape=(len(weight), before))


def expand_graph_convolution(adjacency: FloatArray | Sparse, hops: FloatArray) -> Sparse:
    """Effective weights ``W[(i, f), (j, c)] = sum_k (A^k)[i, j] * g[k, f, c]``.

    Parameters
    ----------
    adjacency : (taxels, taxels) float64, dense or sparse
        Normalised propagation matrix; row i gathers into taxel i. From a sparse one nothing dense is made; sums are
        then taken in another order, so that weights may differ in their last bits.
    hops : (K + 1, features, channels) float64
        Filter of each hop.

    Returns
    -------
    csr_array (taxels * features, taxels * channels) float64
        Rows are taxel-major (``taxel * features + feature``), columns likewise. The stored entries are all pairs of
        taxels that some hop connects, whatever their weight.
    """
    if sparse.issparse(adjacency):
        return _expand_sparse(adjacency, hops)
    taxels = len(adjacency)
    n_hops, features, channels = hops.shape
    reach = np.zeros((taxels, taxels), np.bool_)
    weight = effective_weight(hop_powers(adjacency, n_hops), hops)
    pattern = np.eye(taxels, dtype=np.bool_)
    for _ in range(n_hops):
        reach |= pattern
        pattern = (adjacency != 0).astype(np.int64) @ pattern.astype(np.int64) > 0
    structure = np.broadcast_to(reach[:, None, :, None], weight.shape)
    shape = (taxels * features, taxels * channels)
    return _stored(weight.reshape(shape), structure.reshape(shape))


def _expand_sparse(adjacency: Sparse, hops: FloatArray) -> Sparse:
    """The same of a sparse matrix: the pairs of taxels that some hop connects, then a block of weights for each."""
    taxels = adjacency.shape[0]
    n_hops, features, channels = hops.shape
    power, powers = sparse.eye_array(taxels, format="csr"), []
    for _ in range(n_hops):
        powers.append(sparse.coo_array(power))
        power = sparse.csr_array(adjacency @ power)
    pair = np.concatenate([p.coords[0].astype(np.int64) * taxels + p.coords[1] for p in powers])
    pairs, index = np.unique(pair, return_inverse=True)
    weight = np.zeros((len(pairs), features, channels))
    for p, own, hop in zip(powers, np.split(index, np.cumsum([p.nnz for p in powers])[:-1]), hops, strict=True):
        weight[own] += p.data[:, None, None] * hop
    row, column = np.divmod(pairs, taxels)
    first = np.searchsorted(row, np.arange(taxels + 1)).astype(np.int32)
    blocks = sparse.bsr_array((weight, column.astype(np.int32), first), shape=(taxels * features, taxels * channels))
    return sparse.csr_array(blocks)


def _stored(weight: FloatArray, structure: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Sparse:
    row, column = np.nonzero(structure)
    matrix = sparse.csr_array((weight[row, column], (row, column)), shape=weight.shape)
    matrix.sort_indices()
    return matrix


def probe_affine(
    stage: Callable[[FloatArray], FloatArray], channels: int, *, name: str, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Weights and bias of any affine stage between two spiking layers, by probing it with unit vectors.

    Parameters
    ----------
    stage : callable
        Maps (batch, channels) float64 to (batch, outputs) float64.
    channels : int
        Number of inputs.
    name : str
        For messages.
    seed : int
        Seed of the random vectors that test affinity.

    Returns
    -------
    weight : (outputs, channels) float64
    bias : (outputs,) float64

    Raises
    ------
    ModelError
        If the stage does not map random combinations to the same combinations of its responses.

    Examples
    --------
    >>> weight, bias = probe_affine(lambda x: x @ np.array([[1.0], [2.0]]) + 3, 2, name="fc")
    >>> weight.tolist(), bias.tolist()
    ([[1.0, 2.0]], [3.0])
    """
    bias = stage(np.zeros((1, channels)))[0]
    weight = (stage(np.eye(channels)) - bias).T
    inputs = np.random.default_rng(seed).normal(size=(8, channels)) * 10.0 ** np.arange(-2, 6)[:, None]
    responses, affine = stage(inputs), inputs @ weight.T + bias
    worst = np.abs(responses - affine).max(axis=1) / np.maximum(np.abs(affine).max(axis=1), 1e-300)
    if not np.all(worst <= AFFINE_TOLERANCE):
        raise ModelError(
            f"stage {name}: is not affine (a random combination of inputs is off by {worst.max():.2g} of the response, "
            f"{AFFINE_TOLERANCE:g} allowed); only affine stages between spiking layers can be lowered to synapses"
        )
    return weight, bias


def expand(checkpoint: Checkpoint, propagation: FloatArray) -> Network:
    """Lower a checkpoint to a network of populations and synapses, in float64.

    Spikes equal those of the float64 model up to the rounding of a differently ordered sum.

    Parameters
    ----------
    checkpoint : Checkpoint
        Trained weights.
    propagation : (taxels, taxels) or (filters, places, taxels) float64
        What its first layer sees, see :func:`stack_of`.

    Raises
    ------
    ModelError
        If propagation and weights disagree about the number of taxels, places or filters.
    """
    if checkpoint.system == TACTILESGNET:
        if propagation.shape != (checkpoint.taxels, checkpoint.taxels):
            raise ModelError(
                f"graph and weights disagree: the graph has {len(propagation)} taxels, fc1 was trained on "
                f"{checkpoint.taxels}; give the graph that the checkpoint was trained on"
            )
    elif propagation.shape != (len(checkpoint.hops), checkpoint.places, checkpoint.taxels):
        raise ModelError(
            f"sensor and weights disagree: (filters, places, taxels) is {propagation.shape}, the weights are of "
            f"{TITLES[checkpoint.system]} with {(len(checkpoint.hops), checkpoint.places, checkpoint.taxels)}; "
            "give the sensor that it was trained on"
        )
    dynamics = checkpoint.dynamics
    stages = [("conv1", *_with_relays(checkpoint, *expand_first_layer(checkpoint, propagation)))]
    for layer, dense in enumerate(checkpoint.dense, 1):
        stages.append((dense.name, expand_dense(checkpoint, layer), dense.bias.astype(np.float64)))
    return Network(
        input=Input(
            taxels=checkpoint.taxels,
            polarities=checkpoint.hops.shape[2],
            clocks=dynamics.clocks,
            bins=checkpoint.bins,
        ),
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
    )
