"""Layers and networks against step-by-step code, and the float reference against the released outputs."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from spikeloom.compiler.checkpoint import Checkpoint, Dense
from spikeloom.compiler.passes.expand import expand_graph_convolution
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.layers import LifSteps, lif, spike_linear, tag_convolution
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.reference import float_membranes, float_spikes
from spikeloom.models.networks.surrogate import RECTANGLE

BETA, THETA = 0.2, 0.5


class Spike(torch.autograd.Function):
    """Step with a rectangular surrogate, as plain autograd code has it."""

    @staticmethod
    def forward(ctx, membrane, theta):
        ctx.save_for_backward(membrane)
        ctx.theta = theta
        return membrane.gt(theta).to(membrane.dtype)

    @staticmethod
    def backward(ctx, gradient):
        (membrane,) = ctx.saved_tensors
        return gradient * ((membrane - ctx.theta).abs() < RECTANGLE.width).to(gradient.dtype), None


def lif_step_by_step(current, beta=BETA, theta=THETA):
    membrane = spike = torch.zeros_like(current[0])
    spikes, membranes = [], []
    for step in current:
        membrane = membrane * beta * (1.0 - spike) + step
        spike = Spike.apply(membrane, theta)
        spikes.append(spike)
        membranes.append(membrane)
    return torch.stack(spikes), torch.stack(membranes)


def convolution_step_by_step(x, edges, hops, bias):
    """One graph convolution of (taxels, channels), scattered edge by edge in float32 arithmetic."""
    source, target = torch.tensor(edges.T)
    degree = torch.zeros(len(x), dtype=x.dtype).index_add_(0, target, torch.ones(len(edges), dtype=x.dtype))
    scale = torch.where(degree > 0, degree.pow(-0.5), 0.0)
    norm = scale[source] * scale[target]
    out = x @ hops[0].t()
    for hop in hops[1:]:
        x = torch.zeros_like(x).index_add_(0, target, norm[:, None] * x[source])
        out = out + x @ hop.t()
    return out + bias


def random_events(seed, steps, samples, taxels, rate=0.15, kind=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(steps, samples, taxels, 2, generator=generator) < rate).to(kind)


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


def test_the_threshold_is_strict_and_a_spike_resets_to_zero():
    spikes, _ = lif(torch.tensor([[0.5], [0.400001]]), 0.2, 0.5)
    assert spikes[:, 0].tolist() == [0, 1]  # 0.5 is not above 0.5, and goes on as 0.1
    spikes, membrane = lif(torch.tensor([[0.6], [0.4], [0.43]]), 0.2, 0.5)
    assert spikes[:, 0].tolist() == [1, 0, 1]
    assert_allclose(membrane[:, 0], [0.6, 0.4, 0.51], rtol=1e-6)


@given(seed=st.integers(0, 2**31), steps=st.integers(1, 30), beta=st.sampled_from([0.0, 0.2, 0.9]))
@settings(max_examples=40, deadline=None)
def test_gradient_of_the_recurrence_equals_plain_autograd(seed, steps, beta):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(steps, 3, 7, generator=generator, dtype=torch.float64)
    weight = torch.randn(values.shape, generator=generator, dtype=torch.float64)
    gradients = []
    for function in (lif, lif_step_by_step):
        current = values.clone().requires_grad_()
        spikes, _ = function(current, beta, THETA)
        (spikes * weight).sum().backward()
        gradients.append(current.grad)
    assert_allclose(gradients[0], gradients[1], rtol=1e-12, atol=1e-12)
    assert gradients[0].abs().max() > 0 or ((values[-1] - THETA).abs() >= RECTANGLE.width).all()


def test_the_surrogate_is_open_at_its_ends():
    current = torch.tensor([[0.0, 1.0, 0.25, 0.75]], dtype=torch.float64, requires_grad=True)
    lif(current, BETA, THETA)[0].sum().backward()
    assert current.grad.tolist() == [[0, 0, 1, 1]]


def test_no_gradient_flows_from_the_membrane():
    current = torch.ones(3, 2, requires_grad=True)
    assert not lif(current, BETA, THETA)[1].requires_grad


# --- the convolution -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("graph", ["manual", "released:knn:3", "mst:2"])
def test_convolution_equals_scattered_edges_and_the_expanded_matrix(graph):
    generator = torch.Generator().manual_seed(3)
    edges = build_graph(graph).edges
    hops = torch.randn(4, 5, 2, generator=generator, dtype=torch.float64)
    bias = torch.randn(5, generator=generator, dtype=torch.float64)
    x = random_events(0, 6, 3, 39, kind=torch.float64)
    adjacency = normalised_adjacency(edges, 39)
    found = tag_convolution(x, torch.tensor(adjacency), hops, bias)
    assert found.shape == (6, 3, 39 * 5)
    one = convolution_step_by_step(x[2, 1], edges, hops, bias)
    assert_allclose(found[2, 1], one.reshape(-1), rtol=1e-12, atol=1e-12)
    matrix = expand_graph_convolution(adjacency, hops.numpy()).toarray()
    assert_allclose(found, x.reshape(6, 3, 78).numpy() @ matrix.T + np.tile(bias.numpy(), 39), rtol=1e-10, atol=1e-12)


def test_a_taxel_without_neighbours_hears_itself_only():
    adjacency = torch.tensor(normalised_adjacency([[0, 1], [1, 0]], 3), dtype=torch.float32)
    hops = torch.ones(3, 1, 2)
    out = tag_convolution(torch.ones(1, 1, 3, 2), adjacency, hops, torch.zeros(1))
    assert out[0, 0].tolist() == [6, 6, 2]


def test_gradient_of_the_convolution_equals_plain_autograd():
    generator = torch.Generator().manual_seed(4)
    edges = build_graph("manual").edges
    x = random_events(1, 5, 2, 39, kind=torch.float64)
    values = (
        torch.randn(4, 3, 2, generator=generator, dtype=torch.float64),
        torch.randn(3, generator=generator, dtype=torch.float64),
    )
    weight = torch.randn(5, 2, 39 * 3, generator=generator, dtype=torch.float64)
    fused, plain = ([value.clone().requires_grad_() for value in values] for _ in range(2))
    (tag_convolution(x, torch.tensor(adjacency_of()), *fused) * weight).sum().backward()
    steps = [[convolution_step_by_step(one, edges, *plain).reshape(-1) for one in samples] for samples in x]
    (torch.stack([torch.stack(samples) for samples in steps]) * weight).sum().backward()
    for a, b in zip(fused, plain, strict=True):
        assert_allclose(a.grad, b.grad, rtol=1e-10, atol=1e-10)


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


def lively(seed):
    """A network of which every layer spikes: initial weights times four."""
    network = SpikingNet(SMALL, adjacency_of(), seed=seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(4)
    return network


def test_sizes_come_from_the_architecture():
    network = SpikingNet(SMALL, adjacency_of(), seed=1)
    shapes = {name: array.shape for name, array in network.export_weights().items()}
    assert shapes == {
        "conv1.hops": (3, 3, 2),
        "conv1.bias": (3,),
        "fc1.weight": (8, 117),
        "fc1.bias": (8,),
        "fc2.weight": (6, 8),
        "fc2.bias": (6,),
        "fc3.weight": (5, 6),
        "fc3.bias": (5,),
        "fc4.weight": (4, 5),
        "fc4.bias": (4,),
    }
    assert network(random_events(0, 10, 2, 39)).shape == (2, 4)


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


def test_weights_can_be_taken_over():
    events = random_events(2, 20, 2, 39)
    first, second = (SpikingNet(SMALL, adjacency_of(), seed=seed) for seed in (1, 2))
    exported = first.export_weights()
    second.load_weights(exported)
    for name, (spikes, _) in first.layers(events).items():
        assert_array_equal(second.layers(events)[name][0].detach(), spikes.detach())
    exported["fc1.weight"][:] = 0
    assert (first.export_weights()["fc1.weight"] != 0).any()


def test_all_layers_equal_the_step_by_step_network_in_spikes_and_gradient():
    network = lively(3).double()
    network.adjacency = torch.tensor(adjacency_of())
    edges = build_graph("manual").edges
    events = random_events(3, 30, 1, 39, rate=0.4, kind=torch.float64)
    weights = {name: torch.tensor(array, requires_grad=True) for name, array in network.export_weights().items()}
    sizes = (39 * 3, 8, 6, 5, 4)
    membranes = [torch.zeros(size, dtype=torch.float64) for size in sizes]
    spikes = list(membranes)
    total = torch.zeros(4, dtype=torch.float64)
    trace = []
    for step in events[:, 0]:
        current = convolution_step_by_step(step, edges, weights["conv1.hops"], weights["conv1.bias"]).reshape(-1)
        for i in range(5):
            if i:
                current = weights[f"fc{i}.weight"] @ spikes[i - 1] + weights[f"fc{i}.bias"]
            membranes[i] = membranes[i] * SMALL.beta * (1 - spikes[i]) + current
            spikes[i] = Spike.apply(membranes[i], SMALL.theta)
        total = total + spikes[-1]
        trace.append([spike.detach().clone() for spike in spikes])
    rates = network(events)
    for i, name in enumerate(("conv1", *network.dense)):
        found = network.layers(events)[name][0][:, 0].detach()
        assert_array_equal(found, torch.stack([step[i] for step in trace]))
        assert found.any()
    target = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    ((rates[0] - target) ** 2).mean().backward()
    ((total / len(events) - target) ** 2).mean().backward()
    for name, parameter in network.named_parameters():
        expected = weights[name].grad
        found = parameter.grad.t() if name.endswith(".weight") else parameter.grad
        assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert network.conv1.hops.grad.abs().max() > 0


# --- the reference -------------------------------------------------------------------------------------------------


def checkpoint_of(network: SpikingNet) -> Checkpoint:
    weights = network.export_weights()
    return Checkpoint(
        hops=weights["conv1.hops"],
        conv_bias=weights["conv1.bias"],
        dense=tuple(
            Dense(name=name, weight=weights[f"{name}.weight"], bias=weights[f"{name}.bias"]) for name in network.dense
        ),
        beta=network.architecture.beta,
        theta=network.architecture.theta,
        assumed=(),
        graph=None,
        edges=None,
        layout="state_dict",
        weights="last",
        sets=("last",),
        runs=1,
        training=None,
        forms=(),
        sha256="",
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_reference_gives_the_spikes_of_the_network(dtype):
    network = lively(3)
    events = random_events(5, 25, 19, 39).permute(1, 2, 3, 0).numpy().astype(np.uint8)
    spikes = float_spikes(checkpoint_of(network), adjacency_of(), events, dtype=dtype)
    membranes = float_membranes(checkpoint_of(network), adjacency_of(), events, dtype=dtype)
    expected = network.layers(torch.tensor(events, dtype=torch.float32).permute(3, 0, 1, 2))
    assert list(spikes) == list(membranes) == list(expected)
    for name, found in spikes.items():
        assert found.dtype == np.bool_
        assert found.any()
        assert_array_equal(found, expected[name][0].detach().bool().transpose(0, 1))
        assert membranes[name].dtype == np.dtype(dtype)
        assert_array_equal(membranes[name] > np.dtype(dtype).type(SMALL.theta), found)
        assert_allclose(membranes[name], expected[name][1].transpose(0, 1), rtol=1e-4, atol=1e-5)


def test_the_recurrence_in_torch_operations_equals_the_kernels_bit_for_bit():
    generator = torch.Generator().manual_seed(3)
    current = torch.randn(40, 3, 17, generator=generator)
    above = torch.randn(40, 3, 17, generator=generator)
    results = []
    for function in (lif, LifSteps.apply):
        x = current.clone().requires_grad_()
        spikes, membrane = function(x, 0.2, 0.5)
        spikes.backward(above)
        results.append((spikes.detach(), membrane, x.grad))
    for kernel, steps in zip(*results, strict=True):
        assert torch.equal(kernel, steps)
    assert 0 < results[0][0].mean() < 1
