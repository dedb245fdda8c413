import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import probed
from random_networks import random_checkpoint, ring
from scipy import sparse

from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import INPUT, depths, fan_in
from spikeloom.compiler.passes.expand import expand, expand_graph_convolution
from spikeloom.models.graphs import build_graph, normalised_adjacency

# Pairs of taxels within three hops times 64 features and 2 polarities. The hand-drawn graph, the tree and 1, 3 and 4
# neighbours are also published counts.
CONV_SYNAPSES = {
    "manual": (97_920, 60),
    "mst:0": (45_440, 36),
    "knn:1": (27_776, 16),
    "knn:2": (49_792, 28),
    "knn:3": (104_576, 62),
    "knn:4": (117_888, 62),
    "knn:5": (138_368, 78),
    "knn:6": (155_520, 78),
    "knn:7": (167_040, 78),
    "knn:8": (181_120, 78),
}
"""Structural synapses and largest fan-in."""


def adjacency_of(name):
    graph = build_graph(name)
    return normalised_adjacency(graph.edges, graph.n_taxels)


def factored(adjacency, hops):
    """The graph convolution as models compute it: propagate, then filter, hop by hop."""
    taxels, channels = len(adjacency), hops.shape[2]

    def stage(x):
        signal = x.reshape(len(x), taxels, channels)
        total = np.zeros((len(x), taxels, hops.shape[1]))
        for k, filters in enumerate(hops):
            if k:
                signal = np.einsum("ij,bjc->bic", adjacency, signal)
            total = total + np.einsum("bic,fc->bif", signal, filters)
        return total.reshape(len(x), -1)

    return stage


@st.composite
def graphs(draw):
    """Adjacency of up to seven taxels, directed, with repeated edges and isolated taxels."""
    taxels = draw(st.integers(1, 7))
    node = st.integers(0, taxels - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=14))
    return normalised_adjacency(np.array(edges, np.int64).reshape(-1, 2), taxels)


@settings(deadline=None, max_examples=40)
@given(graphs(), st.integers(1, 5), st.integers(1, 3), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_the_expanded_convolution_is_the_probed_one(adjacency, n_hops, features, channels, seed):
    hops = np.random.default_rng(seed).normal(size=(n_hops, features, channels))
    expanded = expand_graph_convolution(adjacency, hops)
    weight, bias = probed(factored(adjacency, hops), len(adjacency) * channels)
    np.testing.assert_allclose(expanded.toarray(), weight, rtol=0, atol=1e-12)
    assert not bias.any()


def test_two_taxels_by_hand():
    adjacency = np.array([[0.0, 1.0], [1.0, 0.0]])
    hops = np.array([[[1.0, 2.0]], [[10.0, 20.0]], [[100.0, 200.0]]])
    # even hops come back to the taxel, odd ones end on the other
    assert expand_graph_convolution(adjacency, hops).toarray().tolist() == [[101, 202, 10, 20], [10, 20, 101, 202]]


@pytest.mark.parametrize("name", CONV_SYNAPSES)
def test_structural_synapses_of_each_graph(name):
    for prefix in ("", "released:"):
        weight = expand_graph_convolution(adjacency_of(prefix + name), np.ones((4, 64, 2)))
        assert (weight.nnz, np.diff(weight.indptr).max()) == CONV_SYNAPSES[name]


def test_structure_does_not_depend_on_the_weights():
    zero = expand_graph_convolution(adjacency_of("manual"), np.zeros((4, 64, 2)))
    assert zero.nnz == 97_920
    cancelled = expand_graph_convolution(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[[1.0]], [[0.0]], [[-1.0]]]))
    assert cancelled.nnz == 4
    assert not zero.data.any()
    assert not cancelled.toarray().any()
    checkpoint = random_checkpoint()
    zeroed = dataclasses.replace(checkpoint.dense[0], weight=np.zeros_like(checkpoint.dense[0].weight))
    network = expand(dataclasses.replace(checkpoint, dense=(zeroed, *checkpoint.dense[1:])), ring(5))
    assert fan_in(network, 1).tolist() == [15] * 6


@pytest.mark.parametrize("seed", range(2))
def test_a_sparse_graph_expands_as_a_dense_one_does(seed):
    rng = np.random.default_rng(seed)
    adjacency = np.where(rng.random((9, 9)) < 0.2, rng.normal(size=(9, 9)), 0.0)
    hops = rng.normal(size=(4, 3, 2))
    dense = expand_graph_convolution(adjacency, hops)
    thin = expand_graph_convolution(sparse.csr_array(adjacency), hops)
    assert thin.has_canonical_format
    np.testing.assert_array_equal(thin.indptr, dense.indptr)
    np.testing.assert_array_equal(thin.indices, dense.indices)
    np.testing.assert_allclose(thin.data, dense.data, rtol=1e-12, atol=1e-14)


# --- whole checkpoints
def test_a_checkpoint_becomes_a_chain_of_populations():
    network = expand(random_checkpoint(taxels=39, features=64, sizes=(128, 256, 36)), adjacency_of("manual"))
    verify(network)
    assert [(p.name, p.size) for p in network.populations] == [("conv1", 2496), ("fc1", 128), ("fc2", 256), ("fc3", 36)]
    assert [(p.pre, p.post) for p in network.projections] == [(INPUT, 0), (0, 1), (1, 2), (2, 3)]
    assert depths(network) == (0, 1, 2, 3)
    assert [int(fan_in(network, post).sum()) for post in range(4)] == [97_920, 319_488, 32_768, 9_216]
    assert [int(fan_in(network, post).max()) for post in range(4)] == [60, 2496, 128, 256]
    assert network.readout.population == 3
    assert network.readout.label.tolist() == list(range(36))
