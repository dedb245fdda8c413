"""Yardsticks, counted by hand and by brute force."""

import dataclasses

import numpy as np
import pytest
from random_networks import random_checkpoint

from spikeloom.compiler.checkpoint import Dense
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.studies.yardsticks import HOROWITZ, measure

PAIR = np.array([[0.0, 1.0], [1.0, 0.0]])
"""Propagation between two taxels."""


def by_hand():
    """Two taxels, one channel, one feature, two hops: the effective matrix is [[1, 2], [2, 1]]; fc1 is [[1, 0]]."""
    checkpoint = dataclasses.replace(
        random_checkpoint(taxels=2, features=1, hops=2, sizes=(1,)),
        hops=np.array([[[1.0]], [[2.0]]], np.float32),
        conv_bias=np.zeros(1, np.float32),
        dense=(Dense(name="fc1", weight=np.array([[1.0, 0.0]], np.float32), bias=np.zeros(1, np.float32)),),
    )
    events = np.array([[[[1, 0, 1]], [[0, 0, 1]]]], np.uint8)  # one recording, three steps: taxel 0, nothing, both
    conv = np.array([[[1, 1], [0, 0], [0, 1]]], np.bool_)
    fc1 = np.array([[[1], [0], [0]]], np.bool_)
    return checkpoint, events, {"conv1": conv, "fc1": fc1}


def test_a_network_counted_by_hand():
    checkpoint, events, spikes = by_hand()
    found = encode(measure(checkpoint, PAIR, events, spikes))
    assert found["neurobench"] == {
        "footprint": (4 + 2 + 2 + 1) * 4,  # weights and biases of both layers
        "connection_sparsity": 0.1667,  # one of six
        "activation_sparsity": 1 - 4 / 9,
        "synaptic_operations": {
            "Effective_MACs": 0.0,
            # three events on two weights each; of the spikes of conv1, neuron 0's one meets the weight that is not zero
            "Effective_ACs": 3 * 2 + 1,
            "Dense": 3 * 6,
        },
    }
    rows = {(row["what"], row["numbers"]): row for row in found["arithmetic"]}
    # three steps of six products and three decays; in factors two maps of two products and one hop over two edges
    assert rows["dense", "float32"]["macs"] == 3 * 9
    assert rows["dense, convolution in factors", "float32"]["macs"] == 3 * (4 + 2 + 2 + 3)
    assert (rows["effective", "int8"]["macs"], rows["effective", "int8"]["acs"]) == (9, 7)
    assert rows["dense", "float32"]["energy_j"] == pytest.approx(27 * 4.6e-12)
    assert rows["dense", "int8"]["energy_j"] == pytest.approx(27 * 0.3e-12)
    assert rows["effective", "float32"]["energy_j"] == pytest.approx(9 * 4.6e-12 + 7 * 0.9e-12)


def test_prices_are_the_published_ones():
    assert HOROWITZ == {"float32_add": 0.9, "float32_multiply": 3.7, "int8_multiply": 0.2, "int32_add": 0.1}


def test_steps_with_other_inputs_than_ones_are_multiplications():
    checkpoint, events, spikes = by_hand()
    events[0, 0, 0, 0] = 3
    bench = measure(checkpoint, PAIR, events, spikes).neurobench
    assert (bench.synaptic_operations.effective_macs, bench.synaptic_operations.effective_acs) == (2, 5)


def test_what_comes_after_a_recording_is_not_counted():
    checkpoint, events, spikes = by_hand()
    long_events, long_spikes = np.repeat(events, 2, axis=0), {k: np.repeat(s, 2, axis=0) for k, s in spikes.items()}
    found = measure(checkpoint, PAIR, long_events, long_spikes, lengths=np.array([3, 1])).neurobench
    assert found.synaptic_operations.effective_acs == (7 + 3) / 2
    assert found.synaptic_operations.dense == (18 + 6) / 2
    assert found.activation_sparsity == pytest.approx((5 / 9 + 0 / 3) / 2)


def drawn(seed):
    """A random network whose weights are multiples of 1/64, so that any order of float32 sums is exact."""
    checkpoint = random_checkpoint(taxels=4, features=3, hops=2, sizes=(6, 5), seed=seed)

    def coarse(array):
        return (np.rint(array * 64) / 64).astype(np.float32) * (np.abs(array) > 0.2)

    dense = tuple(Dense(name=d.name, weight=coarse(d.weight), bias=coarse(d.bias)) for d in checkpoint.dense)
    checkpoint = dataclasses.replace(
        checkpoint, hops=coarse(checkpoint.hops), conv_bias=coarse(checkpoint.conv_bias), dense=dense, beta=0.25
    )
    adjacency = np.kron(np.eye(2), PAIR)
    events = (np.random.default_rng(seed).random((5, 4, 2, 12)) < 0.3).astype(np.uint8)
    network = expand(checkpoint, adjacency)
    return checkpoint, adjacency, events, network, run_float(network, channels_last(events)).spikes


@pytest.mark.parametrize("seed", range(3))
def test_counts_equal_those_of_loops(seed):
    checkpoint, adjacency, events, network, spikes = drawn(seed)
    bench = measure(checkpoint, adjacency, events, spikes).neurobench
    acs, sources = 0, [channels_last(events), *spikes[:-1]]
    for projection, source in zip(network.projections, sources, strict=True):
        weight = projection.weight.toarray()
        for sample, step, neuron in zip(*np.nonzero(source), strict=True):
            assert source[sample, step, neuron] == 1
            acs += np.count_nonzero(weight[:, neuron])
    assert bench.synaptic_operations.effective_acs == acs / len(events)
    assert bench.activation_sparsity == pytest.approx(1 - np.mean(np.concatenate(spikes, axis=2)))


@pytest.mark.recordings
def test_the_released_network_in_round_figures(released_checkpoint, objects_zip):
    checkpoint = read_checkpoint(released_checkpoint)
    graph = build_graph("manual")
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    events = load_data(objects_zip, "test", limit=2).events
    spikes = run_float(expand(checkpoint, adjacency), channels_last(events), dtype=np.float32).spikes
    found = encode(measure(checkpoint, adjacency, events, spikes))
    classes = checkpoint.dense[-1].weight.shape[0]
    dense = 78 * 2496 + 2496 * 128 + 128 * 256 + 256 * classes
    assert found["neurobench"]["synaptic_operations"]["Dense"] == 250 * dense
    assert found["neurobench"]["footprint"] == 4 * (dense + 2496 + 128 + 256 + classes)
    effective = found["neurobench"]["synaptic_operations"]["Effective_ACs"]
    assert 0 < effective < 0.2 * 250 * dense
