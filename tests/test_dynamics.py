"""Currents that outlast their step, decays of single layers, and clocks: float network, gradients, recipes, files."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from made_files import grasps_folder, sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from oracles import load_weights, refused, surrogate_spike
from timed_networks import GRAPH, SMALL, TIMING, louder, written

from spikeloom.compiler.dynamics import NO_CLOCKS, PLAIN, Clocks, Dynamics, clocks_over
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.networks.reference import float_membranes, float_spikes
from spikeloom.models.networks.surrogate import FAST_SIGMOID, RECTANGLE, Surrogate
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.training.evaluate import evaluate
from spikeloom.models.training.recipes import RATES, RECIPES, RELEASED, TIMED, Recipe, parse_decays
from spikeloom.models.training.train import train
from spikeloom.runtime.cli import main

ADJACENCY = normalised_adjacency(GRAPH.edges, 39)
SIGMOID = Surrogate(shape=FAST_SIGMOID, width=0.25, reset=False)


def neurons_step_by_step(drive, bias, alpha, beta, theta, surrogate):
    """Spikes of neurons in plain autograd code, from what their synapses bring."""
    spike_of = surrogate_spike(surrogate)
    current = membrane = spike = torch.zeros_like(drive[0])
    found = []
    for step in drive:
        current = alpha * current + step
        held = spike if surrogate.reset else spike.detach()
        membrane = beta * membrane * (1.0 - held) + current + bias
        spike = spike_of(membrane, theta)
        found.append(spike)
    return torch.stack(found)


def test_a_clock_ticks_in_every_step_of_its_part_and_none_after_the_last():
    assert clocks_over(8, 250) == Clocks(channels=8, steps=32)
    assert clocks_over(0, 250) == NO_CLOCKS
    ticks = Clocks(channels=2, steps=3).events(8)
    assert ticks.tolist() == [[1, 1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 1, 1, 0, 0]]
    assert Clocks(channels=2, steps=3).events(2, first=2).tolist() == [[1, 0], [0, 1]]


def network_step_by_step(network, events, surrogate):
    """The network of the docs in plain autograd code; spikes of the last layer."""
    sizes = network.architecture
    dynamics = sizes.dynamics
    weights = dict(network.named_parameters())
    for alpha, name in zip(
        dynamics.alphas, ("conv1.hops", "fc1.weight", "fc2.weight", "fc3.weight"), strict=False
    ):
        weights[name] = weights[name] * (1 - alpha)
    steps = len(events)
    powers = [torch.linalg.matrix_power(network.adjacency.double(), k) for k in range(sizes.hops + 1)]
    seen = torch.stack([torch.einsum("ij,tnjc->tnic", power, events) for power in powers])
    drive = torch.einsum("ktnic,kfc->tnif", seen, weights["conv1.hops"]).flatten(2)
    bias = weights["conv1.bias"].repeat(39)
    spikes = neurons_step_by_step(
        drive, bias, dynamics.alpha(0), dynamics.beta(0, 0.2), sizes.theta, surrogate
    )
    ticks = torch.zeros(steps, events.shape[1], dynamics.clocks.channels, dtype=torch.float64)
    for t in range(steps):
        if t // dynamics.clocks.steps < dynamics.clocks.channels:
            ticks[t, :, t // dynamics.clocks.steps] = 1
    spikes = torch.cat([spikes, ticks], dim=2)
    for layer, name in enumerate(network.dense, 1):
        drive = spikes @ weights[f"{name}.weight"]
        decays = dynamics.alpha(layer), dynamics.beta(layer, 0.2)
        spikes = neurons_step_by_step(drive, weights[f"{name}.bias"], *decays, sizes.theta, surrogate)
    return spikes


@pytest.mark.parametrize(
    "surrogate", [RECTANGLE, SIGMOID, replace(SIGMOID, reset=True), replace(RECTANGLE, reset=False)]
)
@pytest.mark.parametrize(
    "dynamics", [TIMING, replace(TIMING, alphas=()), Dynamics(alphas=(0.6, 0.0, 0.0, 0.9)), PLAIN]
)
def test_gradients_of_a_whole_network_equal_plain_autograd(surrogate, dynamics):
    sizes = replace(SMALL, dynamics=dynamics)
    network = SpikingNet(sizes, ADJACENCY, seed=3, surrogate=surrogate).double()
    louder(network)
    draw = torch.Generator().manual_seed(0)
    events = (torch.rand(14, 2, 39, 2, generator=draw) < 0.2).double()
    above = torch.randn(14, 2, 4, generator=draw, dtype=torch.float64)
    found = []
    for spikes in (network.layers(events)["fc3"][0], network_step_by_step(network, events, surrogate)):
        network.zero_grad()
        (spikes * above).sum().backward()
        found.append((spikes.detach(), [p.grad.clone() for p in network.parameters()]))
    assert torch.equal(found[0][0], found[1][0])
    assert found[0][0].sum() > 0
    for ours, plain in zip(found[0][1], found[1][1], strict=True):
        assert_allclose(ours, plain, rtol=1e-9, atol=1e-10)
        assert plain.abs().max() > 0


@pytest.mark.parametrize("system", ["tactilesgnet", "gcn", "mlp", "grid-cnn"])
def test_a_checkpoint_holds_the_dynamics_and_its_float_model_is_the_network(tmp_path, system):
    network, seen = written(tmp_path / "x.pt", system)
    checkpoint = read_checkpoint(tmp_path / "x.pt")
    assert checkpoint.dynamics == TIMING
    assert checkpoint.taxels == 39
    assert checkpoint.dense[0].weight.shape == (8, checkpoint.places * 3 + 3)
    events = sparse_events(4, 2, 39, 2, 15, rate=0.2)
    time_first = torch.from_numpy(events.transpose(3, 0, 1, 2).astype(np.float32))
    spikes, membranes = (
        float_spikes(expand(checkpoint, seen), events),
        float_membranes(expand(checkpoint, seen), events),
    )
    for name, (ours, values) in network.layers(time_first).items():
        if (system, name) == ("grid-cnn", "conv1"):
            continue  # these neurons lie in another order
        assert_array_equal(spikes[name], ours.bool().transpose(0, 1), err_msg=name)
        assert_allclose(membranes[name], values.detach().transpose(0, 1), atol=2e-5, err_msg=name)
    assert spikes["fc3"].any()
    assert_array_equal(spikes["conv1"][0, :, -3:], TIMING.clocks.events(15).T)


def test_a_lasting_current_starts_as_loud_as_none():
    """What a spike brings in all, W / (1 - alpha), is drawn alike, and so an optimizer's step moves it."""
    loud = SpikingNet(SMALL, ADJACENCY, seed=4).export_weights()
    plain = SpikingNet(
        replace(SMALL, dynamics=replace(TIMING, alphas=())), ADJACENCY, seed=4
    ).export_weights()
    for name, alpha in zip(
        ("conv1.hops", "fc1.weight", "fc2.weight", "fc3.weight"), TIMING.alphas, strict=True
    ):
        assert_allclose(loud[name], plain[name] * (1 - alpha), rtol=1e-6)


def test_what_a_file_cannot_have_is_refused(tmp_path):
    path = tmp_path / "x.pt"
    written(path)
    refused(
        OptionError,
        "--beta 0.5:|has a decay for each layer, 0.2, 0.3, 0, 0.4",
        read_checkpoint,
        path,
        beta=0.5,
    )
    written(path, dynamics=replace(TIMING, alphas=(0.0, 1.5, 0.0, 0.0)))
    refused(
        ModelError,
        "unusable|dynamics|a current decay of 1.5, allowed are 0 <= decay < 1",
        read_checkpoint,
        path,
    )


def test_the_released_recipe_is_the_released_code():
    assert RECIPES == {"released": RELEASED, "timed": TIMED, "rates": RATES}
    assert RELEASED == Recipe(
        name="released",
        epochs=100,
        batch=1,
        loss="mse",
        optimizer="adam",
        learning_rate=1e-3,
        schedule="steps",
    )
    assert RELEASED.surrogate == Surrogate(shape="rectangular", width=0.5, reset=True)
    assert RELEASED.dynamics(("conv1", "fc1"), 0.2, 250) == PLAIN
    layers = ("conv1", "fc1", "fc2", "fc3")
    assert TIMED.dynamics(layers, 0.2, 325).clocks == clocks_over(TIMED.clocks, 325)
    assert TIMED.dynamics(layers, 0.2, 325).alphas == (0.0, *[3891 / 4096] * 3), "what the register holds"
    held = 819 / 4096
    assert replace(RELEASED, betas=(("fc2", 0.5),)).dynamics(layers, 0.2, 9).betas == (held, held, 0.5, held)
    assert TIMED.dynamics(layers, 0.2, 325).betas == (held,) * 4


@pytest.mark.parametrize(
    ("words", "telling"),
    [
        ("fc1=1", "'fc1=1' is not LAYER=DECAY with 0 <= DECAY < 1"),
        ("fc9=0.5", "no layer 'fc9'; the layers are conv1, fc1"),
        ("fc1=0.5,fc1=0.6", "names fc1 twice"),
    ],
)
def test_decays_that_are_none_are_refused(words, telling):
    with pytest.raises(OptionError, match=re.escape(f"--current-decay {words}: {telling}")):
        parse_decays(words, "--current-decay", ("conv1", "fc1"))


def grasps(seed, per_class=3, steps=14):
    return replace(
        synthetic_grasps(per_class=per_class, steps=steps, seed=seed), split="train" if seed else "test"
    )


def small_timed(recordings, **values):
    recipe = replace(TIMED, **values)
    sizes = Architecture(taxels=39, classes=int(recordings.labels.max()) + 1, features=4, hidden=(8, 6))
    layers = ("conv1", "fc1", "fc2", "fc3")
    return recipe, replace(sizes, dynamics=recipe.dynamics(layers, sizes.beta, recordings.steps))


def test_the_learning_rate_falls_as_a_cosine():
    training = grasps(1, per_class=1)
    recipe, sizes = small_timed(training)
    whole = train(training, training, ADJACENCY, sizes, epochs=4, recipe=recipe)
    assert [epoch.learning_rate for epoch in whole.history] == pytest.approx(
        [1e-3 * 0.5 * (1 + np.cos(np.pi * index / 4)) for index in range(4)]
    )


def test_a_batch_is_one_step_of_the_optimizer_on_the_mean_loss(monkeypatch):
    """One epoch of one batch moves every weight by the learning rate at most: Adam's first step."""
    training = grasps(1)
    recipe, sizes = small_timed(training, batch=len(training), weight_decay=0.0)
    start = SpikingNet(sizes, ADJACENCY, seed=0).export_weights()
    trained = train(training, training, ADJACENCY, sizes, epochs=1, seed=0, recipe=recipe)
    moved = max(float(np.abs(trained.last[name] - start[name]).max()) for name in start)
    assert moved == pytest.approx(1e-3, rel=1e-3)


def test_the_loss_is_the_cross_entropy_of_the_scaled_rates():
    training = grasps(1)
    recipe, sizes = small_timed(training, gain=7.0, smoothing=0.25)
    network = SpikingNet(sizes, ADJACENCY, seed=2)
    time_first = torch.from_numpy(training.events.transpose(3, 0, 1, 2).astype(np.float32))
    rates = network(time_first).detach().double()
    target = np.full(rates.shape, 0.25 / rates.shape[1])
    target[np.arange(len(rates)), training.labels] += 0.75
    logits = 7.0 * rates.numpy()
    expected = -(target * (logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))).sum(axis=1).mean()
    assert evaluate(network, training, recipe)[0] == pytest.approx(expected, rel=1e-5)


def test_activity_is_the_share_of_synapses_that_carry_a_spike():
    training = grasps(1)
    recipe, sizes = small_timed(training)
    network = SpikingNet(sizes, ADJACENCY, seed=2)
    layers = network.layers(torch.from_numpy(training.events.transpose(3, 0, 1, 2).astype(np.float32)))
    fan_out = {"conv1": 8, "fc1": 6, "fc2": sizes.classes}
    carried = sum(
        layers[name][0].detach().numpy().mean((0, 1)).sum() * synapses for name, synapses in fan_out.items()
    )
    synapses = (39 * 4 + recipe.clocks) * 8 + 8 * 6 + 6 * sizes.classes
    assert float(network.activity(layers).detach()) == pytest.approx(carried / synapses, rel=1e-5)
    # steps that were filled up do not count
    one, other = (
        torch.from_numpy(training.events[i : i + 1].transpose(3, 0, 1, 2).astype(np.float32)) for i in (0, 3)
    )
    short = other[:9]
    alone = [float(network.activity(network.layers(events)).detach()) for events in (one, short)]
    together = torch.cat([one, torch.cat([short, torch.zeros_like(other[9:])])], dim=1)
    found = network.activity(network.layers(together), torch.tensor([len(one), len(short)]))
    assert float(found.detach()) == pytest.approx(np.mean(alone), rel=1e-5)
    assert alone[0] != pytest.approx(alone[1], rel=1e-2)


def test_the_tenth_layer_is_not_scaled_as_the_first():
    """A name may begin as another one does."""
    layers = ("conv1", *(f"fc{number}" for number in range(1, 11)))
    dynamics = replace(TIMED, clocks=0, alphas=(("fc1", 0.95),)).dynamics(layers, 0.2, 30)
    sizes = Architecture(taxels=39, classes=3, features=2, hidden=(4,) * 9, dynamics=dynamics)
    network = SpikingNet(sizes, ADJACENCY, seed=0)
    found = network.export_weights()
    assert not np.allclose(found["fc1.weight"], network.fc1.weight.detach().numpy().T)
    assert_array_equal(found["fc10.weight"], network.fc10.weight.detach().numpy().T)


def test_a_penalty_on_spikes_makes_them_fewer():
    training = grasps(1)
    _, sizes = small_timed(training)
    time_first = torch.from_numpy(training.events.transpose(3, 0, 1, 2).astype(np.float32))
    shares = []
    for penalty in (0.0, 50.0):
        recipe, _ = small_timed(training, penalty=penalty, learning_rate=0.02)
        trained = train(training, training, ADJACENCY, sizes, epochs=5, seed=0, recipe=recipe)
        network = SpikingNet(sizes, ADJACENCY)
        load_weights(network, trained.last)
        shares.append(float(network.activity(network.layers(time_first)).detach()))
    assert shares[1] < 0.8 * shares[0]


def test_train_writes_what_the_recipe_asks_for(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    grasps_folder(tmp_path / "data", per_class=2, steps=14)
    words = (
        "train --data data --graph manual --recipe timed --current-decay fc1=0.5 --membrane-decay fc3=0.75"
    )
    words = f"{words} --clocks 4 --features 6 --batch 3 --spike-penalty 0.5 --epochs 1"
    assert main([*words.split(), "-o", "x.pt", "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["command"] == f"spikeloom {words} --seed 0"
    assert run["recipe"]["alphas"] == {"fc1": 0.5}
    assert "epochs" not in run["recipe"]
    assert (run["recipe"]["name"], run["epochs"]) == ("timed", 1)
    assert run["recipe"]["surrogate"] == {"shape": "fast-sigmoid", "width": 0.25, "reset": False}
    checkpoint = read_checkpoint("x.pt")
    assert checkpoint.dynamics == Dynamics(
        betas=(*[819 / 4096] * 3, 0.75), alphas=(0.0, 0.5, 0.0, 0.0), clocks=Clocks(channels=4, steps=4)
    )
    assert checkpoint.hops.shape == (4, 6, 2)
    assert main([*words.replace("--clocks 4", "--clocks 3").split(), "-o", "x.pt", "--resume"]) == 2
    assert "x.pt: holds another training (other recipe)" in capsys.readouterr().err
