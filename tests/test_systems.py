"""The systems beside TactileSGNet: their first layer in training, in files, on the chip and on the command line."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from oracles import probed
from scipy import sparse
from test_dynamics import surrogate_spike

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, Grid, in_order
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.graphs import NEUTOUCH, build_graph
from spikeloom.models.networks.checkpoint import save_checkpoint
from spikeloom.models.networks.layers import filter_places
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.networks.surrogate import RECTANGLE
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.systems import filters_of, grid_cells, propagation_of, sensor_grid, taxels_alone
from spikeloom.models.training.finetune import finetune
from spikeloom.runtime.equivalence.verify import verify

NEW = (MLP, GCN, GRID_CNN)
FORMED = ((MLP, "none"), (GCN, "none"), (GRID_CNN, "none"), (GRID_CNN, "same"))
MANUAL = build_graph("manual")
FORMS = {"none": sensor_grid(NEUTOUCH, "none"), "same": sensor_grid(NEUTOUCH, "same")}


def seen_by(system, padding="none"):
    return propagation_of(system, MANUAL.edges, 39, FORMS[padding], filters_of(system, 39, 3))


def network_of(system, *, seed=1, gain=3.0, padding="none", features=4, hidden=(8, 6), classes=4) -> SpikingNet:
    """A small network of random weights, lively enough to spike in every layer."""
    sizes = Architecture(taxels=39, classes=classes, features=features, hidden=hidden, system=system)
    network = SpikingNet(sizes, seen_by(system, padding), seed=seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(gain)
    return network


def events_of(seed, samples=3, steps=25, rate=0.15):
    return (np.random.default_rng(seed).random((samples, 39, 2, steps)) < rate).astype(np.uint8)


def saved(tmp_path, network, *, padding="none", name="x.pt"):
    system = network.architecture.system
    save_checkpoint(
        tmp_path / name,
        {"last": network.export_weights()},
        MANUAL if system in GRAPH_SYSTEMS else taxels_alone(NEUTOUCH),
        beta=0.2,
        theta=0.5,
        training={},
        system=system,
        grid=FORMS[padding] if system == GRID_CNN else None,
    )
    return read_checkpoint(tmp_path / name)


# --- plain code, as a script with torch's own layers would have it ---------------------------------------------------
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
    hops, bias = weights.pop("conv1.hops"), weights.pop("conv1.bias")
    match network.architecture.system:
        case "mlp":
            first = {"fc0.weight": hops.permute(1, 0, 2).reshape(len(bias), -1), "fc0.bias": bias}
        case "gcn":
            first = {"conv1.lin.weight": hops[0], "conv1.bias": bias}
        case _:
            first = {"conv1.weight": hops.permute(1, 2, 0).reshape(len(bias), 2, 3, 3), "conv1.bias": bias}
    return first | weights


def plain_spikes(system, state, events, *, padding="none"):
    """Spikes of every layer, step by step, of one recording (taxels, channels, steps)."""
    stages = [plain_first(system, state, padding=padding)]
    stages += [
        lambda x, k=k: torch.nn.functional.linear(x, state[f"fc{k}.weight"], state[f"fc{k}.bias"]) for k in (1, 2, 3)
    ]
    kind, fire = state["fc1.weight"].dtype, surrogate_spike(RECTANGLE)
    membranes, spikes, trace = [0.0] * 4, [torch.zeros(())] * 4, []
    for t in range(events.shape[-1]):
        x = torch.tensor(events[..., t], dtype=kind)
        for layer, stage in enumerate(stages):
            membranes[layer] = membranes[layer] * 0.2 * (1 - spikes[layer]) + stage(x)
            spikes[layer] = x = fire(membranes[layer], 0.5)
        trace.append(list(spikes))
    return [torch.stack([step[layer] for step in trace]) for layer in range(4)]


# --- the first layer -------------------------------------------------------------------------------------------------
@given(
    kernel=st.integers(1, 4),
    stride=st.integers(1, 3),
    padding=st.integers(0, 2),
    rows=st.integers(4, 7),
    columns=st.integers(4, 6),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
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
        torch.tensor(x)[:, None], torch.tensor(grid.propagation(kernel)), torch.tensor(filters), torch.tensor(bias)
    )
    assert_allclose(in_order(GRID_CNN, found.view(5, -1, 3).permute(1, 2, 0)).T, expected.flatten(1), atol=1e-12)


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
        expected = plain_spikes(system, state, events[0], padding=padding)
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


@pytest.mark.parametrize(("system", "bound"), [(MLP, 78**-0.5), (GCN, (6 / 66) ** 0.5), (GRID_CNN, 18**-0.5)])
def test_initial_weights_are_those_of_the_usual_layers(system, bound):
    weights = network_of(system, gain=1.0, features=64).export_weights()
    assert 0.9 * bound < np.abs(weights["conv1.hops"]).max() <= bound
    assert weights["conv1.bias"].any() == (system != GCN)
    again = network_of(system, gain=1.0, features=64).export_weights()
    assert all(np.array_equal(weights[name], again[name]) for name in weights)


# --- files -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("system", "padding"), FORMED)
def test_spikes_are_those_of_plain_torch(tmp_path, system, padding):
    network = network_of(system, padding=padding)
    state, found = state_of(network), saved(tmp_path, network, padding=padding)
    events = events_of(7)
    spikes = float_spikes(found, seen_by(system, padding), events, dtype="float64")
    for recording in range(len(events)):
        doubled = {name: tensor.double() for name, tensor in state.items()}
        plain = plain_spikes(system, doubled, events[recording], padding=padding)
        for layer, expected in zip(spikes.values(), plain, strict=True):
            assert_array_equal(layer[recording], expected.bool())


# --- to the chip -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("system", NEW)
def test_expansion_equals_probing_the_layer(tmp_path, system):
    """The general way: any affine stage, here plain torch code, by its responses to unit vectors."""
    network = network_of(system)
    checkpoint = saved(tmp_path, network)
    first = plain_first(system, {name: tensor.double() for name, tensor in state_of(network).items()})
    weight, bias = probed(lambda batch: np.stack([first(torch.tensor(row).view(39, 2)).numpy() for row in batch]), 78)
    expanded = expand(checkpoint, seen_by(system))
    assert expanded.populations[0].name == "conv1"
    assert_allclose(expanded.projections[0].weight.toarray(), weight, atol=1e-12)
    assert_allclose(expanded.populations[0].bias, bias, atol=1e-12)
    assert isinstance(expanded.projections[0].weight, sparse.csr_array)
    assert expanded.projections[0].weight.nnz == np.count_nonzero(weight)
    spikes = run_float(expanded, channels_last(events_of(5))).spikes
    reference = float_spikes(checkpoint, seen_by(system), events_of(5), dtype="float64")
    for ours, theirs in zip(spikes, reference.values(), strict=True):
        assert_array_equal(ours, theirs)


@pytest.mark.parametrize("system", NEW)
def test_fine_tuned_on_the_chips_integers_they_are_the_chip(tmp_path, system):
    checkpoint, seen = saved(tmp_path, network_of(system)), seen_by(system)
    data = [synthetic_grasps(per_class=2, steps=12, seed=seed) for seed in (1, 2)]
    training, test = (grasps.part(grasps.labels < 4) for grasps in data)
    tuned = finetune(checkpoint, seen, training, training, load_target("loihi1"), bits=[4], epochs=1)
    save_checkpoint(
        tmp_path / "tuned.pt",
        {"last": tuned.weights},
        MANUAL,
        beta=0.2,
        theta=0.5,
        training={},
        forms=tuned.forms,
        system=system,
        grid=checkpoint.grid,
    )
    again = read_checkpoint(tmp_path / "tuned.pt")
    netlist = compile_network(expand(again, seen), Options(forms=again.forms)).netlist
    verdict = verify(netlist, Factored(again, seen), test.events[:4], test.labels[:4], test.files[:4])
    assert verdict.quantised_different == 0
    assert verdict.spikes["fc1"].chip > 0
