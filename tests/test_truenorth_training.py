"""Training for TrueNorth: neurons and gradients, whole numbers in every pass; its commands, its networks in a chart."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import as_json, refusal
from made_files import grasps_folder, sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from oracles import refused
from random_crossbars import random_network
from zoo import STEPS, specimen

from spikeloom.compiler.archive import archive_bytes, read_members
from spikeloom.compiler.dynamics import clocks_over
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.targets.truenorth.native import faults
from spikeloom.compiler.targets.truenorth.native_file import PARTS, is_trained, read_trained, write_trained
from spikeloom.compiler.targets.truenorth.netlist import read_crossbars, write_crossbars
from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate
from spikeloom.models.systems import propagation_of
from spikeloom.models.truenorth import network as truenorth
from spikeloom.models.truenorth.kind import CROSSBARS
from spikeloom.models.truenorth.neurons import block_sums, integrate

SMOOTH = Surrogate(shape=FAST_SIGMOID, width=0.5, reset=False)
SIZES = truenorth.NativeArchitecture(
    taxels=6, classes=3, features=4, groups=2, hidden=(6, 4), clocks=clocks_over(2, 9)
)
EDGES = np.array([[0, 1], [1, 0], [1, 2], [2, 1], [3, 4], [4, 3]])


def slow_integrate(current, threshold, floor, surrogate):
    """The same in torch operations, step by step, so that torch finds the gradient."""
    held, found = torch.zeros_like(current[0]), []
    for step in current:
        m = held + step
        far = (m / threshold - 1).abs()
        smooth = 1 / (1 + far / surrogate.width) ** 2
        slope = smooth if surrogate.shape == FAST_SIGMOID else (far < surrogate.width).float()
        fires = (m >= threshold).float()
        found.append(fires + slope.detach() * (m - m.detach()) / threshold)
        keeps = ((m >= -floor) & (m < threshold)).float()
        held = torch.where(fires > 0, 0.0, torch.maximum(m, -floor)).detach() + keeps * (m - m.detach())
    return torch.stack(found)


@pytest.mark.parametrize("surrogate", [SMOOTH, Surrogate(width=0.4)], ids=lambda s: s.shape)
def test_neurons_and_their_gradient(surrogate):
    rng = np.random.default_rng(0)
    current = torch.tensor(rng.integers(-40, 50, (20, 2, 7)), dtype=torch.float32)
    threshold = torch.tensor(rng.integers(8, 60, 7), dtype=torch.float32)
    floor = threshold * torch.tensor(rng.integers(1, 3, 7))
    above = torch.tensor(rng.normal(size=current.shape), dtype=torch.float32)
    spikes, gradients = [], []
    for function in (integrate, slow_integrate):
        given = current.clone().requires_grad_()
        spikes.append(function(given, threshold, floor, surrogate))
        gradients += torch.autograd.grad((spikes[-1] * above).sum(), given)
    torch.testing.assert_close(*spikes, rtol=0, atol=0)
    assert 0.1 < spikes[0].detach().mean() < 0.9
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-6)


def test_sums_of_blocks_and_their_gradient():
    rng = np.random.default_rng(1)
    spikes = torch.tensor(rng.random((5, 2, 12)) < 0.4, dtype=torch.float32, requires_grad=True)
    weight = torch.tensor(rng.integers(-90, 90, (3, 4, 5)), dtype=torch.float32, requires_grad=True)
    found = block_sums(spikes, weight)
    expected = torch.einsum("tsbi,bio->tsbo", spikes.view(5, 2, 3, 4), weight).reshape(5, 2, 15)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    above = torch.tensor(rng.normal(size=found.shape), dtype=torch.float32)
    one, other = (torch.autograd.grad((sums * above).sum(), (spikes, weight)) for sums in (found, expected))
    torch.testing.assert_close(one, other)


def network(seed=0, sizes=SIZES):
    return sizes.network(
        propagation_of("tactilesgnet", EDGES, sizes.taxels, None, 4), seed=seed, surrogate=SMOOTH
    )


def test_what_is_trained_is_what_is_exported():
    net, events = network(), sparse_events(2, 3, 6, 2, 9, rate=0.3)
    with torch.no_grad():
        net.biases[1] += 0.3
        net.hops *= 2
    found = truenorth.native_network(SIZES, net.export_weights())
    assert faults(found) == []
    votes = truenorth.run_network(found, events)["fc3"].sum(axis=1).reshape(3, -1, 3).mean(axis=1) / 9
    rates = net(torch.from_numpy(events.transpose(3, 0, 1, 2).astype(np.float32)))
    assert_allclose(rates.detach().numpy(), votes, rtol=1e-6)
    for layer in net.rounded():
        for whole in (layer.weight / 32, layer.leak, layer.threshold, layer.floor):
            assert_array_equal(whole.detach().numpy(), np.round(whole.detach().numpy()))
    rates.sum().backward()
    assert all(
        parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in net.parameters()
    )


def test_shorter_recordings_count_their_own_steps():
    net = network()
    events = torch.from_numpy((np.random.default_rng(3).random((9, 2, 6, 2)) < 0.5).astype(np.float32))
    both = net(events, torch.tensor([9, 5]))
    torch.testing.assert_close(both[0], net(events[:, :1])[0])
    torch.testing.assert_close(both[1], net(events[:5, 1:])[0])


def test_equal_votes_stay_equal():
    """With twelve voters a class, the shares of single steps are no binary fractions, and their sums would differ."""
    sizes = replace(SIZES, voters=6, clocks=clocks_over(2, 40))
    net = network(sizes=sizes)
    rng, equal = np.random.default_rng(3), 0
    for lengths in (None, torch.tensor([40] * 200)):
        events = torch.tensor(rng.random((40, 200, 6, 2)) < 0.3, dtype=torch.float32)
        *_, spikes = truenorth.run_layers(net.rounded(), net.inputs, sizes.clocks, events, net.surrogate)
        counts = spikes.detach().numpy().sum(0).reshape(200, 12, 3).sum(1)
        rates = net(events, lengths).detach().numpy()
        for one, other in ((0, 1), (0, 2), (1, 2)):
            difference = np.sign(counts[:, one] - counts[:, other])
            assert_array_equal(difference, np.sign(rates[:, one] - rates[:, other]))
            equal += np.count_nonzero((difference == 0) & (counts[:, one] > 0))
    assert equal > 10


def test_groups_fill_the_axons_of_a_core():
    found = truenorth.size_network(
        taxels=39, classes=20, hops=3, features=16, copies=3, clocks=clocks_over(5, 325)
    )
    assert (found.groups, found.hidden) == (8, (80, 80))
    found = truenorth.size_network(
        taxels=39, classes=20, hops=3, features=15, copies=2, clocks=clocks_over(8, 325)
    )
    assert (found.groups, found.hidden) == (5, (120, 120))
    sensor = {"taxels": 39, "classes": 20, "hops": 3, "features": 16}
    refused(
        OptionError,
        "--copies 4: 78 input channels with 4 axons each, | has 256",
        truenorth.size_network,
        **sensor,
        copies=4,
        clocks=clocks_over(5, 325),
    )
    refused(
        OptionError,
        "--features 16: | 39 taxels and 60 clocks to cores of 85 inputs",
        truenorth.size_network,
        **sensor,
        copies=3,
        clocks=clocks_over(60, 325),
    )


def written(path, networks=None):
    networks = networks or {"last": random_network(0), "best": random_network(1)}
    record = {"command": "spikeloom train", "seed": 0}
    return write_trained(path, networks, graph="ring", edges=np.array([[0, 1], [1, 0]]), training=record)


def test_round_trip(tmp_path):
    path = tmp_path / "x.pt"
    sha256 = written(path)
    first = path.read_bytes()
    assert is_trained(path)
    assert (written(path), path.read_bytes()) == (sha256, first)
    for which, seed in (("last", 0), ("best", 1)):
        found, made = read_trained(path, weights=which), random_network(seed)
        assert (found.weights, found.sets, found.graph, found.sha256) == (
            which,
            ("last", "best"),
            "ring",
            sha256,
        )
        for one, other in zip(found.network.stages, made.stages, strict=True):
            for part in PARTS:
                assert_array_equal(getattr(one, part), getattr(other, part))
    assert read_trained(path).weights == "last"
    refused(ModelError, "--weights clean: the file holds last, best", read_trained, path, weights="clean")


def restated(path, **changes):
    """The same file with another manifest."""
    members = read_members(path)
    manifest = json.loads(str(members.pop("manifest"))) | changes
    del members["sha256"]
    path.write_bytes(archive_bytes(manifest, members))


def with_first(name, change):
    first, *rest = random_network(0).stages
    first = replace(first, **{name: change(getattr(first, name))})
    return {"last": replace(random_network(0), stages=(first, *rest))}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: restated(path, towers=2, graph=1), "no usable graph, towers"),
        (
            lambda path: restated(path, graph={"name": "ring", "edges": [[0, 9]]}),
            "joins taxels outside 0..3",
        ),
        (lambda path: written(path, with_first("level", lambda k: k * 4)), "conv1: levels beyond 3"),
        (lambda path: written(path, with_first("leak", lambda v: v[None])), "leak is no list of integers"),
    ],
)
def test_files_that_are_refused(tmp_path, change, said):
    path = tmp_path / "x.pt"
    written(path)
    change(path)
    refused(ModelError, f"{said}|; copy or train it again", read_trained, path)


TRAIN = "train --system tactilesgnet-truenorth --data data --graph manual --features 2 --epochs 1"


def test_from_recordings_to_the_chip(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    grasps = grasps_folder(tmp_path / "data", per_class=2, steps=12)
    (run,) = as_json(*f"{TRAIN} -o x.pt".split())["runs"]
    assert run["command"].endswith(
        "--system tactilesgnet-truenorth --graph manual --features 2 --epochs 1 --seed 0"
    )
    assert run["recipe"] == CROSSBARS.to_json() | {"features": 2}
    shown = as_json("inspect", "x.pt")
    assert (shown["copies"], shown["levels"], shown["sets"]) == (3, 7, ["last", "best", "clean"])
    made = as_json("compile", "x.pt", "--target", "truenorth", "-o", "x.loom")
    assert made["provenance"]["checkpoint_sha256"] == shown["sha256"] == run["sha256"]
    found = as_json("verify", "x.loom", "--data", "data", "--checkpoint", "x.pt", "--spec-samples", "1")
    assert not found["missed"]
    network = read_trained("x.pt").network
    votes = [truenorth.votes_by_step(network, events[None]).sum(axis=0) for events in grasps[1].events]
    right = np.count_nonzero(np.argmax(votes, axis=1) == grasps[1].labels)
    assert round(found["accuracy"]["chip"] * found["samples"]) == run["last"]["correct"] == right
    # what was finished is not trained again
    (again,) = as_json(*f"{TRAIN} -o x.pt --resume".split())["runs"]
    assert again == run
    assert "x.pt: holds another training (other seed)" in refusal(
        *f"{TRAIN} --seed 1 --resume -o x.pt".split()
    )


@pytest.fixture
def native(tmp_path, monkeypatch):
    """A network of the zoo, its netlist and recordings."""
    made = specimen("native")
    for name in ("net.pt", "net.loom", "data"):
        (tmp_path / name).symlink_to(made.folder / name)
    monkeypatch.chdir(tmp_path)


VERIFY = "verify net.loom --data data --checkpoint"


@pytest.mark.usefixtures("native")
def test_a_spike_that_differs_fails():
    netlist = read_crossbars("net.loom")
    write_crossbars(replace(netlist, threshold=netlist.threshold + 9), "other.loom")
    words = VERIFY.replace("net.loom", "other.loom").split()
    report = as_json(*words, "net.pt", "--spec-samples", 1, codes=(1,))
    assert any(layer["different"] for layer in report["model"].values())
    assert any(missed.startswith("E1") for missed in report["missed"])


@pytest.mark.parametrize(
    "command", ["run net.loom", "estimate net.loom", "verify net.loom --checkpoint net.pt"]
)
@pytest.mark.usefixtures("native")
def test_a_part_of_every_recording(command):
    words = [*command.split(), "--data", "data", "--window"]
    found = as_json(*words, "50%")
    assert "per_inference" not in found or found["per_inference"]["ticks"] == STEPS // 2 + 3
    assert "--window 0%: not a part of a recording" in refusal(*words, "0%")
