"""Yardsticks counted by hand and by brute force; a netlist as a torch module, and in NeuroBench's harness."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from random_networks import float_networks, random_checkpoint
from timed_networks import events_of
from zoo import specimen

from spikeloom.compiler import compile_network, lift
from spikeloom.compiler.checkpoint import Dense
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, run_float, run_integer, vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.costs.yardsticks import HOROWITZ, measure
from spikeloom.runtime.machines.loihi1.chip_module import ChipModule, neurobench_model
from spikeloom.runtime.machines.loihi1.chip_module import vote as torch_vote
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.report.encode import encode

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
    assert HOROWITZ == {
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


def test_the_command(place, spikeloom):
    code, out, _ = spikeloom("yardsticks", "net.pt", "--data", "data", "--json")
    report = json.loads(out)
    assert (code, report["samples"], report["neurobench"]["synaptic_operations"]["Effective_MACs"]) == (0, 6, 0)


SETTINGS = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def equal(netlist, events):
    """Votes of the module are those of the integers; returns how many there are."""
    network = lift(netlist)
    spikes = run_integer(network, events).spikes[network.readout.population]
    module = ChipModule(netlist)
    for _ in range(2):  # the second run starts from rest again
        votes = module(torch.from_numpy(events))
        wanted = readout_counts(network.readout, network.classes, spikes)
        assert_array_equal(votes.sum(1).numpy(), wanted)
        assert torch_vote(votes).tolist() == vote(wanted).tolist()
    return int(spikes.sum())


@SETTINGS
@given(float_networks(), st.integers(0, 2**32 - 1))
def test_any_netlist_votes_alike(network, seed):
    events = np.random.default_rng(seed).random((3, 12, network.input.size)) < 0.4
    equal(compile_network(network).netlist, events)


def test_currents_and_clocks():
    netlist = specimen("timed").machine.netlist
    events = with_clocks(events_of(5, steps=40), netlist.clocks).transpose(0, 2, 1) != 0
    assert equal(netlist, np.ascontiguousarray(events)) > 20


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "neurobench.models", None)
    with pytest.raises(OptionError, match="neurobench: is not installed; pip install neurobench"):
        neurobench_model(specimen("timed").machine.netlist)


HARNESS = """
import json, sys
import numpy as np, torch
from neurobench.benchmarks import Benchmark
from neurobench.metrics.static import Footprint
from neurobench.metrics.workload import ActivationSparsity, ClassificationAccuracy, SynapticOperations
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.machines.loihi1.chip_module import neurobench_model, vote

with np.load(sys.argv[2]) as data:
    events, labels = torch.from_numpy(data["events"]).float(), torch.from_numpy(data["labels"])
loader = torch.utils.data.DataLoader(torch.utils.data.TensorDataset(events, labels), batch_size=1)
metrics = [[Footprint], [ClassificationAccuracy, ActivationSparsity, SynapticOperations]]
model = neurobench_model(read_netlist(sys.argv[1]))
print(json.dumps(Benchmark(model, loader, [], [vote], metrics).run(quiet=True), default=float))
"""


def test_in_the_harness(tmp_path):
    python = os.environ.get("SPIKELOOM_NEUROBENCH_PYTHON")
    if python is None and importlib.util.find_spec("neurobench") is None:
        pytest.skip("neurobench is not installed (name an interpreter that has it in SPIKELOOM_NEUROBENCH_PYTHON)")
    timed = specimen("timed")
    netlist, network = timed.machine.netlist, timed.machine.integer
    events = np.ascontiguousarray(
        with_clocks(events_of(6, samples=5, steps=30), netlist.clocks).transpose(0, 2, 1) != 0
    )
    spikes = run_integer(network, events).spikes
    decided = vote(readout_counts(network.readout, network.classes, spikes[-1]))
    labels = decided.copy()
    labels[0] = (labels[0] + 1) % network.classes  # one decision is wrong
    np.savez(tmp_path / "data.npz", events=events, labels=labels)
    root = Path(__file__).resolve().parents[1]
    command = [python or sys.executable, "-W", "ignore", "-c", HARNESS, str(timed.netlist), str(tmp_path / "data.npz")]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": str(root / "src")}
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["ClassificationAccuracy"] == pytest.approx(0.8)
    fired = sum(int(train.sum()) for train in spikes) / sum(train.size for train in spikes)
    assert found["ActivationSparsity"] == pytest.approx(1 - fired)
    operations = weights = 0
    for projection in network.projections:
        source = events if projection.pre < 0 else spikes[projection.pre]
        dense = projection.effective().toarray()
        operations += int((source.sum((0, 1)) * np.count_nonzero(dense, axis=0)).sum())
        weights += dense.size
    assert found["SynapticOperations"]["Effective_ACs"] == pytest.approx(operations / len(events))
    assert found["SynapticOperations"]["Effective_MACs"] == 0
    assert found["Footprint"] == 8 * weights
