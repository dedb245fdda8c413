"""A netlist as a torch module, and in NeuroBench's harness."""

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
from random_networks import float_networks
from timed_networks import events_of
from zoo import specimen

from spikeloom.compiler import compile_network, lift
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.interpret import run_integer, vote
from spikeloom.runtime.machines.loihi1.chip_module import ChipModule, neurobench_model
from spikeloom.runtime.machines.loihi1.chip_module import vote as torch_vote
from spikeloom.runtime.machines.votes import readout_counts

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
