"""Networks of every system against step-by-step code, in files and on the chip; and the released outputs."""

import json
import math

import made_files
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from made_files import events as made_events
from made_files import small_checkpoint, sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from oracles import surrogate_spike

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import save_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Given
from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, TACTILESGNET, Grid, in_order
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.graphs import NEUTOUCH, build_graph, normalised_adjacency
from spikeloom.models.networks.layers import filter_places, lif, spike_linear, times
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.quantised import quantised_spikes
from spikeloom.models.networks.reference import BATCH, float_membranes, float_spikes
from spikeloom.models.networks.surrogate import RECTANGLE
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.systems import filters_of, grid_cells, propagation_of, sensor_grid, taxels_alone
from spikeloom.models.training.finetune import finetune
from spikeloom.runtime.equivalence.verify import verify

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


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@given(
    seed=st.integers(0, 2**31),
    steps=st.integers(1, 40),
    neurons=st.integers(1, 40),
    beta=st.sampled_from([0.0, 0.2, 0.9]),
    theta=st.sampled_from([0.25, 0.5, 1.0]),
)
def test_spikes_and_membranes_equal_a_step_by_step_loop(kind, seed, steps, neurons, beta, theta):
    generator = torch.Generator().manual_seed(seed)
    current = torch.randn(steps, neurons, generator=generator, dtype=kind) * 0.8
    current[torch.rand(current.shape, generator=generator) < 0.2] = theta  # ties
    spikes, membrane = lif(current, beta, theta)
    expected_spikes, expected_membrane = lif_step_by_step(current, beta, theta)
    assert_array_equal(spikes, expected_spikes)
    assert_array_equal(membrane, expected_membrane)
    assert spikes.dtype == membrane.dtype == kind


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


@pytest.mark.parametrize("inputs", [12, 2496])
def test_a_product_is_the_same_by_either_library(inputs):
    generator = torch.Generator().manual_seed(5)
    rows, weight = torch.randn(9, 128, generator=generator), torch.randn(inputs, 128, generator=generator)
    assert_allclose(times(rows, weight), rows.double() @ weight.double().t(), rtol=0, atol=1e-4)


SMALL = Architecture(taxels=39, classes=4, hops=2, features=3, hidden=(8, 6, 5), beta=0.3, theta=0.4)


def test_initial_weights_follow_the_seed_and_leave_the_global_random_state_alone():
    before = torch.get_rng_state()
    first, again, other = (
        SpikingNet(SMALL, adjacency_of(), seed=seed).export_weights() for seed in (1, 1, 2)
    )
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


def test_recordings_do_not_influence_each_other(tmp_path):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    recordings = made_events(4, samples=BATCH + 3)  # two batches
    together = float_spikes(expand(checkpoint, adjacency), recordings)
    for sample in (0, BATCH - 1, BATCH, BATCH + 2):
        alone = float_spikes(expand(checkpoint, adjacency), recordings[sample : sample + 1])
        for layer, spikes in together.items():
            assert_array_equal(alone[layer][0], spikes[sample])


@pytest.mark.recordings
def test_every_released_spike_count(released_checkpoint, objects_zip, checkpoints):
    checkpoint = read_checkpoint(released_checkpoint)
    data = load_data(objects_zip, "test", classes=checkpoint.classes, taxels=checkpoint.taxels)
    expected = json.loads((checkpoints / "objects_manual.expected.json").read_text())
    spikes = float_spikes(expand(checkpoint, adjacency_of()), data.events)
    assert list(data.files) == expected["files"]
    assert data.labels.tolist() == expected["labels"]
    counts = spikes["fc3"].sum(axis=1)
    assert counts.tolist() == expected["spike_counts"]
    predictions = counts.argmax(axis=1)
    assert predictions.tolist() == expected["predictions"]
    assert int(np.count_nonzero(predictions == data.labels)) == expected["right"] == 127


NEW = (MLP, GCN, GRID_CNN)
FORMED = ((TACTILESGNET, "none"), (MLP, "none"), (GCN, "none"), (GRID_CNN, "none"), (GRID_CNN, "same"))
MANUAL = build_graph("manual")
FORMS = {"none": sensor_grid(NEUTOUCH, "none"), "same": sensor_grid(NEUTOUCH, "same")}


def seen_by(system, padding="none"):
    return propagation_of(system, MANUAL.edges, 39, FORMS[padding], filters_of(system, 39, 3))


def network_of(
    system, *, seed=1, gain=3.0, padding="none", features=4, hidden=(8, 6), classes=4
) -> SpikingNet:
    """A small network of random weights, lively enough to spike in every layer."""
    sizes = Architecture(taxels=39, classes=classes, features=features, hidden=hidden, system=system)
    network = SpikingNet(sizes, seen_by(system, padding), seed=seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(gain)
    return network


def events_of(seed, samples=3, steps=25, rate=0.15):
    return sparse_events(seed, samples, 39, 2, steps, rate=rate)


def saved(tmp_path, network, *, padding="none", weights=None, **more):
    system = network.architecture.system
    graph = MANUAL if system in GRAPH_SYSTEMS else taxels_alone(NEUTOUCH)
    more = {"beta": 0.2, "theta": 0.5, "grid": FORMS[padding] if system == GRID_CNN else None} | more
    sets = {"last": weights or network.export_weights()}
    save_checkpoint(
        tmp_path / "x.pt", sets, **made_files.graph_facts(graph), training={}, system=system, **more
    )
    return read_checkpoint(tmp_path / "x.pt")


def plain_first(system, state, *, padding="none"):
    """Current of the first layer of one step, a function of (taxels, channels), from a released-style state dict."""
    if system == MLP:
        return lambda x: torch.nn.functional.linear(x.reshape(-1), state["fc0.weight"], state["fc0.bias"])
    if system == GCN:
        source, target = torch.tensor(np.concatenate([MANUAL.edges, np.arange(39)[:, None].repeat(2, 1)])).T
        degree = torch.zeros(39, dtype=torch.float64).index_add_(
            0, target, torch.ones(len(target), dtype=torch.float64)
        )
        norm = (degree[source] * degree[target]) ** -0.5

        def gcn(x):
            mapped = x @ state["conv1.lin.weight"].t()
            return (torch.zeros_like(mapped).index_add_(0, target, norm[:, None].to(x) * mapped[source])
                    + state["conv1.bias"]).reshape(-1)  # fmt: skip

        return gcn
    if system == TACTILESGNET:
        adjacency = torch.tensor(adjacency_of())

        def tag(x):
            total = x @ state["conv1.hops"][0].t()
            for hop in state["conv1.hops"][1:]:
                x = adjacency.to(x) @ x
                total = total + x @ hop.t()
            return (total + state["conv1.bias"]).reshape(-1)

        return tag

    def convolution(x):
        picture = torch.zeros(2, 13, 19, dtype=x.dtype)
        for taxel, (a, b) in enumerate(NEUTOUCH):
            picture[:, round(a) + 6, round(b) + 9] = x[taxel]
        stride, pad = (2, 0) if padding == "none" else (1, 1)
        weight, bias = state["conv1.weight"], state["conv1.bias"]
        return torch.nn.functional.conv2d(picture, weight, bias, stride=stride, padding=pad).reshape(-1)

    return convolution


def state_of(network) -> dict[str, torch.Tensor]:
    """Weights of a network under the keys of a released-style file."""
    weights = {name: torch.tensor(array) for name, array in network.export_weights().items()}
    if network.architecture.system == TACTILESGNET:
        return weights
    hops, bias = weights.pop("conv1.hops"), weights.pop("conv1.bias")
    match network.architecture.system:
        case "mlp":
            first = {"fc0.weight": hops.permute(1, 0, 2).reshape(len(bias), -1), "fc0.bias": bias}
        case "gcn":
            first = {"conv1.lin.weight": hops[0], "conv1.bias": bias}
        case _:
            first = {"conv1.weight": hops.permute(1, 2, 0).reshape(len(bias), 2, 3, 3), "conv1.bias": bias}
    return first | weights


def plain_run(system, state, events, *, padding="none", beta=0.2, theta=0.5):
    """Spikes and membranes of every layer, step by step, of one recording (taxels, channels, steps)."""
    stages = [plain_first(system, state, padding=padding)]
    stages += [
        lambda x, k=k: torch.nn.functional.linear(x, state[f"fc{k}.weight"], state[f"fc{k}.bias"])
        for k in (1, 2, 3)
    ]
    kind, fire = state["fc1.weight"].dtype, surrogate_spike(RECTANGLE)
    membranes, spikes, trace = [0.0] * 4, [torch.zeros(())] * 4, []
    for t in range(events.shape[-1]):
        x = torch.tensor(events[..., t], dtype=kind)
        for layer, stage in enumerate(stages):
            membranes[layer] = membranes[layer] * beta * (1 - spikes[layer]) + stage(x)
            spikes[layer] = x = fire(membranes[layer], theta)
        trace.append((list(spikes), list(membranes)))
    return [[torch.stack([step[kind][layer] for step in trace]) for layer in range(4)] for kind in (0, 1)]


@given(
    kernel=st.integers(1, 4),
    stride=st.integers(1, 3),
    padding=st.integers(0, 2),
    rows=st.integers(4, 7),
    columns=st.integers(4, 6),
    seed=st.integers(0, 99),
)
def test_a_window_over_a_grid_equals_torchs_convolution(kernel, stride, padding, rows, columns, seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers((rows, columns), size=(6, 2))
    grid = Grid(rows=rows, columns=columns, stride=stride, padding=padding, cells=cells)
    x, filters, bias = rng.normal(size=(5, 6, 2)), rng.normal(size=(kernel**2, 3, 2)), rng.normal(size=3)
    picture = np.zeros((5, 2, rows, columns))
    for taxel, (row, column) in enumerate(cells):
        picture[:, :, row, column] += x[:, taxel]
    weight = torch.tensor(filters).permute(1, 2, 0).reshape(3, 2, kernel, kernel)
    expected = torch.nn.functional.conv2d(torch.tensor(picture), weight, torch.tensor(bias), stride, padding)
    assert grid.places(kernel) == tuple(expected.shape[2:])
    found = filter_places(
        torch.tensor(x)[:, None],
        torch.tensor(grid.propagation(kernel)),
        torch.tensor(filters),
        torch.tensor(bias),
    )
    assert_allclose(
        in_order(GRID_CNN, found.view(5, -1, 3).permute(1, 2, 0)).T, expected.flatten(1), atol=1e-12
    )


def test_the_grid_over_the_built_in_sensor():
    cells = grid_cells()
    assert_array_equal(cells, np.rint(NEUTOUCH) + np.array([6, 9]))
    assert len({tuple(cell) for cell in cells.tolist()}) == 39, "no two taxels share a cell"
    assert [(g.rows, g.columns, *g.places(3)) for g in FORMS.values()] == [(13, 19, 6, 9), (13, 19, 13, 19)]
    assert [64 * g.places(3)[0] * g.places(3)[1] for g in FORMS.values()] == [3456, 15808]


@pytest.mark.parametrize(("system", "padding"), FORMED)
def test_spikes_and_gradients_equal_plain_code(system, padding):
    events = events_of(4, samples=1)
    for seed in range(20):
        network = network_of(system, seed=seed, padding=padding).double()
        network.adjacency = torch.tensor(seen_by(system, padding))
        state = {name: tensor.double().requires_grad_() for name, tensor in state_of(network).items()}
        expected, _ = plain_run(system, state, events[0], padding=padding)
        if all(layer.any() and not layer.all() for layer in expected):
            break
    rates = network(torch.tensor(events.transpose(3, 0, 1, 2), dtype=torch.float64))
    assert_array_equal(rates[0].detach(), expected[-1].mean(0).detach())
    assert all(layer.any() and not layer.all() for layer in expected), "some layer never or always spikes"
    target = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    ((rates[0] - target) ** 2).mean().backward()
    ((expected[-1].mean(0) - target) ** 2).mean().backward()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(parameter.grad)
    for name, found in state_of(network).items():  # gradients have the order of the weights
        assert_allclose(found, state[name].grad, rtol=1e-5, atol=1e-9, err_msg=name)
        assert found.any()


@pytest.mark.parametrize(
    ("system", "bound"), [(MLP, 78**-0.5), (GCN, (6 / 66) ** 0.5), (GRID_CNN, 18**-0.5)]
)
def test_initial_weights_are_those_of_the_usual_layers(system, bound):
    weights = network_of(system, gain=1.0, features=64).export_weights()
    assert 0.9 * bound < np.abs(weights["conv1.hops"]).max() <= bound
    assert weights["conv1.bias"].any() == (system != GCN)
    again = network_of(system, gain=1.0, features=64).export_weights()
    assert all(np.array_equal(weights[name], again[name]) for name in weights)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("constants", [(0.2, 0.5), (0.9, 0.8), (0.0, 0.1)])
@pytest.mark.parametrize(("system", "padding"), FORMED)
def test_spikes_and_membranes_are_those_of_plain_torch(tmp_path, system, padding, constants, dtype):
    beta, theta = constants
    network = network_of(system, padding=padding)
    state = {name: tensor.to(getattr(torch, dtype)) for name, tensor in state_of(network).items()}
    found, events = saved(tmp_path, network, padding=padding, beta=beta, theta=theta), events_of(7)
    spikes = float_spikes(expand(found, seen_by(system, padding)), events, dtype=dtype)
    membranes = float_membranes(expand(found, seen_by(system, padding)), events, dtype=dtype)
    assert list(spikes) == list(membranes) == ["conv1", "fc1", "fc2", "fc3"]
    tolerance = 1e-5 if dtype == "float32" else 1e-12
    for sample, recording in enumerate(events):
        plain = plain_run(system, state, recording, padding=padding, beta=beta, theta=theta)
        for layer, fired, membrane in zip(spikes, *plain, strict=True):
            # sums may be added in another order; no membrane of these recordings is so near to its threshold
            assert_array_equal(spikes[layer][sample], fired.bool(), err_msg=layer)
            assert membranes[layer].dtype == dtype
            assert_allclose(membranes[layer][sample], membrane, rtol=tolerance, atol=tolerance)
    assert all(0 < spikes[layer].mean() < 1 for layer in ("conv1", "fc1"))


@pytest.mark.parametrize(
    ("system", "bits"), [(TACTILESGNET, 2), (TACTILESGNET, 4), *((system, 4) for system in NEW)]
)
def test_fine_tuned_on_the_chips_integers_they_are_the_chip(tmp_path, system, bits):
    network, seen = network_of(system), seen_by(system)
    checkpoint = saved(tmp_path, network)
    data = [synthetic_grasps(per_class=2, steps=12, seed=seed) for seed in (1, 2)]
    training, test = (grasps.part(grasps.labels < 4) for grasps in data)
    tuned = finetune(expand(checkpoint, seen), training, test, load_target("loihi1"), bits=[bits], epochs=4)
    assert system != TACTILESGNET or tuned.history[-1].loss < tuned.history[0].loss
    again = saved(tmp_path, network, weights=tuned.net.tensors(), forms=tuned.net.forms)
    netlist = compile_network(expand(again, seen), Options(storage=Given(again.forms))).netlist
    assert {projection.bits for projection in lift(netlist).projections} == {bits}
    verdict = verify(netlist, expand(again, seen), test)
    assert verdict.model_different == 0
    assert verdict.spikes["fc1"].chip > 0
    model = list(quantised_spikes(expand(again, seen), test.events).values())[-1]
    assert np.count_nonzero(model.sum(axis=1).argmax(axis=1) == test.labels) == tuned.after
