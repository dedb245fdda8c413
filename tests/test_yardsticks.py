"""Yardsticks on a network small enough to count by hand, against brute force, and against the neurobench package."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from made_files import recordings_folder, small_checkpoint
from random_networks import random_checkpoint

from spikeloom.compiler import compile_network
from spikeloom.compiler.checkpoint import Dense
from spikeloom.compiler.errors import DataError
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.costs.yardsticks import HOROWITZ, measure, sections
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import terminal

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
    assert {name: price.value for name, price in HOROWITZ.items()} == {
        "float32_add": 0.9,
        "float32_multiply": 3.7,
        "int8_multiply": 0.2,
        "int32_add": 0.1,
    }


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


def test_spikes_of_another_network_are_refused():
    checkpoint, events, spikes = by_hand()
    with pytest.raises(DataError) as caught:
        measure(checkpoint, PAIR, events, [spikes["conv1"]])
    assert str(caught.value) == (
        "yardsticks: spikes of shapes [(1, 3, 2)] found, [(1, 3, 2), (1, 3, 1)] allowed for these 1 recordings; "
        "give the spikes of every layer of this network on these recordings"
    )


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


PACKAGE = """
import json, sys
import numpy as np, torch
from neurobench.benchmarks import Benchmark
from neurobench.metrics.static import ConnectionSparsity, Footprint
from neurobench.metrics.workload import ActivationSparsity, SynapticOperations
from neurobench.models import TorchModel

class LIF(torch.nn.Module):
    def forward(self, current):
        # the membrane is kept outside of buffers: it is state, not footprint
        self.__dict__["u"] = self.__dict__.get("u", 0) * BETA + current
        spikes = (self.u > THETA).float()
        self.__dict__["u"] = self.u * (1 - spikes)
        return spikes

class Net(torch.nn.Module):
    def __init__(self, weights, biases):
        super().__init__()
        self.layers = torch.nn.ModuleList()
        for weight, bias in zip(weights, biases):
            linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
            linear.weight.data, linear.bias.data = torch.tensor(weight), torch.tensor(bias)
            self.layers += [linear, LIF()]

    def forward(self, batch):
        for layer in self.layers:
            layer.__dict__.pop("u", None)
        found = []
        for step in range(batch.shape[1]):
            x = batch[:, step]
            for layer in self.layers:
                x = layer(x)
            found.append(x)
        return torch.stack(found, 1)

with np.load(sys.argv[1]) as data, torch.no_grad():
    BETA, THETA = float(data["beta"]), float(data["theta"])
    count = int(data["layers"])
    model = TorchModel(Net([data[f"w{i}"] for i in range(count)], [data[f"b{i}"] for i in range(count)]))
    model.add_activation_module(LIF)
    events = torch.tensor(data["events"])
    loader = torch.utils.data.DataLoader(torch.utils.data.TensorDataset(events, torch.zeros(len(events))), batch_size=1)
    metrics = [[Footprint, ConnectionSparsity], [ActivationSparsity, SynapticOperations]]
    found = Benchmark(model, loader, [], [], metrics).run(quiet=True)
print(json.dumps(found, default=float))
"""
"""Runs the package on the network of a file, step by step, batches of one."""


@pytest.fixture(scope="module")
def package():
    """Interpreter that can import neurobench."""
    named = os.environ.get("SPIKELOOM_NEUROBENCH_PYTHON")
    if named is None and importlib.util.find_spec("neurobench") is None:
        pytest.skip("neurobench is not installed (name an interpreter that has it in SPIKELOOM_NEUROBENCH_PYTHON)")
    return named or sys.executable


def ask_package(python, folder, checkpoint, network, events):
    """What the package says about a network on recordings, under our key names."""
    arrays = {"beta": checkpoint.beta, "theta": checkpoint.theta, "layers": len(network.populations)}
    for i, (population, projection) in enumerate(zip(network.populations, network.projections, strict=True)):
        arrays |= {f"w{i}": projection.weight.toarray().astype(np.float32), f"b{i}": population.bias.astype(np.float32)}
    np.savez(folder / "network.npz", events=channels_last(events).astype(np.float32), **arrays)
    command = [python, "-W", "ignore", "-c", PACKAGE, str(folder / "network.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    return {
        "footprint": said["Footprint"],
        "connection_sparsity": said["ConnectionSparsity"],
        "activation_sparsity": pytest.approx(said["ActivationSparsity"], rel=1e-12),
        "synaptic_operations": pytest.approx(said["SynapticOperations"], rel=1e-12),
    }


@pytest.mark.parametrize("seed", range(3))
def test_equal_to_the_package(package, tmp_path, seed):
    checkpoint, adjacency, events, network, spikes = drawn(seed)
    ours = encode(measure(checkpoint, adjacency, events, spikes))["neurobench"]
    assert ours == ask_package(package, tmp_path, checkpoint, network, events)


@pytest.mark.recordings
def test_the_released_network_in_round_figures(released_checkpoint, objects_zip):
    from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint

    checkpoint = read_checkpoint(released_checkpoint)
    graph = build_graph("manual")
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    events = load_data(objects_zip, "test", limit=2).events
    spikes = run_float(expand(checkpoint, adjacency), channels_last(events), dtype=np.float32).spikes
    result = measure(checkpoint, adjacency, events, spikes)
    found = encode(result)
    classes = checkpoint.dense[-1].weight.shape[0]
    dense = 78 * 2496 + 2496 * 128 + 128 * 256 + 256 * classes
    assert found["neurobench"]["synaptic_operations"]["Dense"] == 250 * dense
    assert found["neurobench"]["footprint"] == 4 * (dense + 2496 + 128 + 256 + classes)
    effective = found["neurobench"]["synaptic_operations"]["Effective_ACs"]
    assert 0 < effective < 0.2 * 250 * dense
    text = terminal(sections(result))
    assert f"{250 * dense:,}" in text
    assert "Horowitz, ISSCC 2014" in text


def test_the_command(tmp_path, capsys):
    small_checkpoint(tmp_path)
    recordings_folder(tmp_path / "data")
    words = ["yardsticks", str(tmp_path / "small.pt"), "--data", str(tmp_path / "data")]
    assert cli.main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 6
    assert report["neurobench"]["synaptic_operations"]["Effective_MACs"] == 0
    assert cli.main(words) == 0
    assert "NeuroBench's metrics per recording, over 6" in capsys.readouterr().out


def test_the_command_wants_a_checkpoint(tmp_path, capsys):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    path = tmp_path / "net.loom"
    write_netlist(compile_network(expand(checkpoint, adjacency)).netlist, path)
    assert cli.main(["yardsticks", str(path), "--data", "synthetic"]) == 2
    assert capsys.readouterr().err == (
        f"spikeloom: {path}: is a netlist, estimate says what it costs; give the checkpoint it was made from\n"
    )
