"""Layers and networks against step-by-step code, and the float reference against the released outputs."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import events as made_events
from made_files import small_checkpoint
from numpy.testing import assert_allclose, assert_array_equal

from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.layers import lif, spike_linear
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.reference import BATCH, float_membranes, float_spikes
from spikeloom.models.recordings.events import load_data

BETA, THETA = 0.2, 0.5


def lif_step_by_step(current, beta=BETA, theta=THETA):
    membrane = spike = torch.zeros_like(current[0])
    spikes, membranes = [], []
    for step in current:
        membrane = membrane * beta * (1.0 - spike) + step
        spike = membrane.gt(theta).to(membrane.dtype)
        spikes.append(spike)
        membranes.append(membrane)
    return torch.stack(spikes), torch.stack(membranes)


def adjacency_of(name="manual"):
    return normalised_adjacency(build_graph(name).edges, 39)


# --- the recurrence ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@given(
    seed=st.integers(0, 2**31),
    steps=st.integers(1, 40),
    neurons=st.integers(1, 40),
    beta=st.sampled_from([0.0, 0.2, 0.9]),
    theta=st.sampled_from([0.25, 0.5, 1.0]),
)
@settings(max_examples=40, deadline=None)
def test_spikes_and_membranes_equal_a_step_by_step_loop(kind, seed, steps, neurons, beta, theta):
    generator = torch.Generator().manual_seed(seed)
    current = torch.randn(steps, neurons, generator=generator, dtype=kind) * 0.8
    current[torch.rand(current.shape, generator=generator) < 0.2] = theta  # ties
    spikes, membrane = lif(current, beta, theta)
    expected_spikes, expected_membrane = lif_step_by_step(current, beta, theta)
    assert_array_equal(spikes, expected_spikes)
    assert_array_equal(membrane, expected_membrane)
    assert spikes.dtype == membrane.dtype == kind


# --- the dense layer -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rate", [0.0, 0.2, 1.0])
def test_spike_linear_equals_a_dense_product_and_its_gradient(rate):
    generator = torch.Generator().manual_seed(5)
    kind = torch.float64
    spikes = (torch.rand(4, 3, 11, generator=generator) < rate).to(kind)
    values = (
        spikes,
        torch.randn(11, 6, generator=generator, dtype=kind),
        torch.randn(6, generator=generator, dtype=kind),
    )
    above = torch.randn(4, 3, 6, generator=generator, dtype=kind)
    results = []
    for function in (spike_linear, lambda s, w, b: s @ w + b):
        leaves = [value.clone().requires_grad_() for value in values]
        out = function(*leaves)
        (out * above).sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for a, b in zip(*results, strict=True):
        assert_allclose(a, b, rtol=1e-12, atol=1e-12)


# --- the network ---------------------------------------------------------------------------------------------------

SMALL = Architecture(taxels=39, classes=4, hops=2, features=3, hidden=(8, 6, 5), beta=0.3, theta=0.4)


def test_initial_weights_follow_the_seed_and_leave_the_global_random_state_alone():
    before = torch.get_rng_state()
    first, again, other = (SpikingNet(SMALL, adjacency_of(), seed=seed).export_weights() for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    for name, array in first.items():
        assert_array_equal(array, again[name])
        if name == "conv1.bias":
            assert not array.any()
        else:
            assert (array != other[name]).any()
    for name, fan_in in (("conv1.hops", 2), ("fc1.weight", 117), ("fc1.bias", 117), ("fc2.weight", 8)):
        bound = 1 / math.sqrt(fan_in)
        assert 0.7 * bound < np.abs(first[name]).max() <= bound


# --- the reference of a checkpoint ------------------------------------------------------------------------------------
def reference_step_by_step(checkpoint, adjacency, recording, dtype):
    """Spikes and membranes of one recording, (steps, neurons) per layer, in plain loops as the equations say."""
    a, theta, beta = adjacency.astype(dtype), dtype(checkpoint.theta), dtype(checkpoint.beta)
    stages = [dense.weight.astype(dtype) for dense in checkpoint.dense]
    biases = [dense.bias.astype(dtype) for dense in checkpoint.dense]
    sizes = [len(a) * checkpoint.hops.shape[1], *(len(bias) for bias in biases)]
    u, s = [np.zeros(size, dtype) for size in sizes], [np.zeros(size, dtype) for size in sizes]
    spikes, membranes = [[] for _ in sizes], [[] for _ in sizes]
    for t in range(recording.shape[2]):
        x = recording[:, :, t].astype(dtype)  # (taxels, channels)
        total = x @ checkpoint.hops[0].astype(dtype).T
        for hop in checkpoint.hops[1:]:
            x = a @ x
            total = total + x @ hop.astype(dtype).T
        signal = (total + checkpoint.conv_bias.astype(dtype)).reshape(-1)  # taxel-major
        for layer in range(len(sizes)):
            u[layer] = beta * u[layer] * (1 - s[layer]) + signal
            s[layer] = (u[layer] > theta).astype(dtype)
            membranes[layer].append(u[layer].copy())
            spikes[layer].append(s[layer].astype(bool))
            if layer < len(stages):
                signal = stages[layer] @ s[layer] + biases[layer]
    return [np.array(trace) for trace in spikes], [np.array(trace) for trace in membranes]


@pytest.mark.parametrize(("name", "dtype"), [("float32", np.float32), ("float64", np.float64)])
@pytest.mark.parametrize("constants", [{}, {"beta": 0.9, "theta": 0.8}, {"beta": 0.0, "theta": 0.1}])
def test_against_the_equations(tmp_path, name, dtype, constants):
    checkpoint, adjacency = small_checkpoint(tmp_path, **constants)
    recordings = made_events(3)
    spikes = float_spikes(checkpoint, adjacency, recordings, dtype=name)
    membranes = float_membranes(checkpoint, adjacency, recordings, dtype=name)
    assert list(spikes) == list(membranes) == ["conv1", "fc1", "fc2", "fc3"]
    # sums may be added in another order than here, so a membrane beside the threshold could fall to either side;
    # none does on these recordings
    tolerance = 1e-5 if name == "float32" else 1e-12
    for sample, recording in enumerate(recordings):
        expected = reference_step_by_step(checkpoint, adjacency, recording, dtype)
        for layer, one, wanted, membrane in zip(spikes, spikes.values(), *expected, strict=True):
            assert one.dtype == np.bool_
            assert_array_equal(one[sample], wanted, err_msg=layer)
            assert membranes[layer].dtype == dtype
            assert_allclose(membranes[layer][sample], membrane, rtol=tolerance, atol=tolerance)
    assert all(0 < trace.mean() < 1 for trace in spikes.values())


def test_recordings_do_not_influence_each_other(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    recordings = made_events(4, samples=BATCH + 3)  # two batches
    together = float_spikes(checkpoint, adjacency, recordings)
    for sample in (0, BATCH - 1, BATCH, BATCH + 2):
        alone = float_spikes(checkpoint, adjacency, recordings[sample : sample + 1])
        for layer, spikes in together.items():
            assert_array_equal(alone[layer][0], spikes[sample])


# -- the released checkpoint -------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def released_run(released_checkpoint, objects_zip, shared_dir):
    """Checkpoint, propagation matrix, recordings, float32 spikes and the published outputs."""
    from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint

    checkpoint, graph = read_checkpoint(released_checkpoint), build_graph("manual")
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    data = load_data(objects_zip, "test", classes=checkpoint.classes, taxels=checkpoint.taxels)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    return checkpoint, adjacency, data, float_spikes(checkpoint, adjacency, data.events), expected


@pytest.mark.recordings
def test_every_released_spike_count(released_run):
    _, _, data, spikes, expected = released_run
    assert list(data.files) == expected["files"]
    assert data.labels.tolist() == expected["labels"]
    counts = spikes["fc3"].sum(axis=1)
    assert counts.tolist() == expected["spike_counts"]
    predictions = counts.argmax(axis=1)
    assert predictions.tolist() == expected["predictions"]
    assert int(np.count_nonzero(predictions == data.labels)) == expected["right"] == 127
