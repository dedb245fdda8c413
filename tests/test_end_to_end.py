"""The main job on the released checkpoint and the real recordings of both data sets."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made_files import own_file, weights
from random_netlists import assert_equal, by_engine
from random_networks import LOIHI, counted

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.machines.loihi1 import spec

RIGHT = 127  # of 144, by the released code's own outputs


def command(*words) -> tuple[int, dict]:
    """Run a command with ``--json`` in this process; exit code and object."""
    printed = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spikeloom.runtime.report.console.show", printed.append)
        code = cli.main([*map(str, words), "--json"])
    return code, json.loads(printed[0])


@pytest.fixture(scope="module")
def compiled(tmp_path_factory, released_checkpoint, objects_zip) -> tuple[Path, dict]:
    """Netlist of the released checkpoint as a user compiles it, and what the command said."""
    path = tmp_path_factory.mktemp("objects") / "objects.loom"
    words = ["--graph", "manual", "--target", "loihi1", "--weight-bits", 8, "--calibrate", objects_zip, "-o", path]
    code, report = command("compile", released_checkpoint, *words)
    assert code == 0
    return path, report


@pytest.fixture(scope="module")
def objects(objects_zip) -> np.ndarray:
    """Objects test recordings, (144, 39, 2, 250)."""
    return load_data(objects_zip, "test").events


@pytest.fixture(scope="module")
def containers(containers_zip) -> np.ndarray:
    """Containers test recordings, (60, 39, 2, 325)."""
    return load_data(containers_zip, "test").events


def assert_twins_agree(netlist: Netlist, events: np.ndarray) -> np.ndarray:
    """Every spike, membrane and count of both simulators is equal; returns the spikes of each layer."""
    total = np.zeros(len(netlist.layers), int)
    for recording in events.reshape(len(events), netlist.n_inputs, -1):
        expected = spec.simulate(netlist, recording)
        assert_equal(by_engine(netlist, recording), expected)
        total += [expected.counts.spikes[netlist.compartments_of(layer)].sum() for layer in range(len(total))]
    return total


# -- the released checkpoint -------------------------------------------------------------------------------------------
@pytest.mark.recordings
def test_the_netlist_has_the_published_size(compiled):
    path, report = compiled
    layers = {layer["name"]: layer for layer in report["layers"]}
    assert list(layers) == ["conv1", "fc1", "fc2", "fc3"]
    assert [layer["neurons"] for layer in layers.values()] == [2496, 128, 256, 36]
    assert [layer["synapses"] for layer in layers.values()] == [97_920, 319_488, 32_768, 9_216]
    assert report["synapses"] == 459_392
    assert report["neurons"] == 2916
    assert report["cores"] <= 9
    assert report["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert all(limit["used"] <= limit["allowed"] for limit in report["limits"])
    assert all(proof["holds"] for proof in report["proofs"])


@pytest.mark.recordings
def test_every_limit_is_kept_when_counted_again(compiled):
    netlist = read_netlist(compiled[0])
    for uses in counted(netlist):
        assert all(amount <= LOIHI.limit(rule) for rule, amount in uses.items())
    tiles, used = np.unique(netlist.core_tile, return_counts=True)
    assert used.max() <= 4
    assert tiles.max() < 32
    assert np.all(netlist.synapse_weight % 2 == 0)
    assert -256 <= netlist.synapse_weight.min() < netlist.synapse_weight.max() <= 254
    assert netlist.format_exponent.min() >= -1
    assert set(netlist.decay_v.tolist()) == {3277}
    assert set(netlist.decay_u.tolist()) == {4095}


@pytest.mark.recordings
def test_the_chip_is_within_one_sample_of_the_float_model(compiled, objects_zip, shared_dir):
    code, report = command("run", compiled[0], "--data", objects_zip)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    assert code == 0
    assert report["samples"] == 144
    assert (report["files"], report["labels"]) == (expected["files"], expected["labels"])
    right = sum(a == b for a, b in zip(report["predictions"], report["labels"], strict=True))
    assert abs(right - RIGHT) <= 1
    assert report["accuracy"] == right / 144
    agreeing = sum(a == b for a, b in zip(report["predictions"], expected["predictions"], strict=True))
    assert agreeing >= 0.95 * 144


@pytest.mark.recordings
def test_verify_passes(compiled, released_checkpoint, objects_zip, shared_dir):
    words = ["--checkpoint", released_checkpoint, "--graph", "manual", "--data", objects_zip, "--limit", 16]
    code, report = command("verify", compiled[0], *words, "--spec-samples", 1)
    expected = json.loads((shared_dir / "checkpoints" / "objects_manual.expected.json").read_text())
    assert code == 0
    assert report["spec_equals_engine"] is True
    assert report["same_checkpoint"] is True
    right = np.equal(expected["predictions"][:16], expected["labels"][:16])
    assert report["accuracy"]["float"] == right.mean()
    assert report["decision_agreement"] >= 0.95
    ladder = {rung["stage"]: rung["different"] for rung in report["ladder"]}
    assert ladder["saturation"] == {name: layer["different"] for name, layer in report["spikes"].items()}
    # rounded weights cost what there is to lose; the realised decay is a hair beside them
    for name, layer in report["spikes"].items():
        assert ladder["beta"][name] < layer["different"] / 20
        assert 0.5 < ladder["weights"][name] / layer["different"] < 2
        assert layer["different"] < layer["float"]
    first = report["first_divergence"]
    assert first["file"] == expected["files"][0]
    assert (first["float_membrane"] > first["theta"]) != (first["chip_membrane"] > first["chip_theta"])


@pytest.mark.recordings
def test_prices_and_times_are_plausible(compiled, objects_zip):
    """An inference of the full network takes 1.5 to 25 ms: sweeping silent cores takes the one, a fifth of conv1's
    neurons spiking in every step the other."""
    _, report = command("estimate", compiled[0], "--data", objects_zip, "--limit", 2, "--detail", "cycle")
    assert report["not_modelled"] == []
    mean = report["per_inference"]
    # neurons that can never fire are not on the chip; idle ones alone cost 51.2 pJ a step, and synapses come on top
    accesses = mean["neuron_accesses"]
    assert 2400 * 253 < accesses < 2916 * 253
    assert accesses % 253 == 0
    for table, floor in (("davies2018", 52.0e-12), ("sanafe", 51.2e-12)):
        assert report["min"]["energy_j"][table] > accesses * floor
        assert 37e-6 < mean["energy_j"][table] < 0.7e-3
    for entry in report["time"]:
        assert 1.5e-3 < entry["inference_s"]["mean"] < 25e-3


@pytest.mark.recordings
def test_specification_equals_engine_on_objects(compiled, objects):
    assert objects.shape == (144, 39, 2, 250)
    spikes = assert_twins_agree(read_netlist(compiled[0]), objects[[0, 143], ..., :80])
    assert np.all(spikes > 0)


@pytest.mark.recordings
def test_the_shipped_network_of_longer_bins(tmp_path, objects_zip):
    """What its card says of it on the chip, at a fifth of what steps of 20 ms take."""
    netlist = tmp_path / "n.loom"
    assert command("compile", "pretrained:objects-200ms", "--calibrate", objects_zip, "-o", netlist)[0] == 0
    _, report = command("run", netlist, "--data", objects_zip, "--detail", "counts")
    assert report["accuracy"] == 131 / 144
    assert report["costs"]["pace"]["bin_s"] == pytest.approx(0.2)
    mean = report["costs"]["per_inference"]
    assert 1.1e6 < mean["synaptic_operations"] < 1.2e6
    assert 30e-6 < mean["energy_j"]["davies2018"] < 36e-6


# -- Containers, for which no checkpoint was released ------------------------------------------------------------------
@pytest.mark.recordings
def test_specification_equals_engine_on_containers(tmp_path, containers):
    assert containers.shape == (60, 39, 2, 325)
    arrays = weights(20, taxels=39, features=64, sizes=(128, 256, 20), gain=1.2)
    own_file(tmp_path / "random.pt", last=arrays, graph=build_graph("manual"))
    code, report = command("compile", tmp_path / "random.pt", "-o", tmp_path / "random.loom")
    assert code == 0
    assert report["layers"][-1]["neurons"] == 20
    netlist, some = read_netlist(tmp_path / "random.loom"), containers[[30], ..., :150]
    spikes = assert_twins_agree(netlist, some)
    assert np.all(spikes > 0)
    # and the chip does what the float model does, by and large
    checkpoint = read_checkpoint(tmp_path / "random.pt")
    adjacency = normalised_adjacency(checkpoint.edges, checkpoint.taxels)
    for found, reference in zip(spikes, float_spikes(checkpoint, adjacency, some).values(), strict=True):
        assert found == pytest.approx(reference.sum(), rel=0.1)


# -- without the recordings --------------------------------------------------------------------------------------------

WITHOUT_TORCH = """
import sys
from spikeloom.runtime.cli import main
code = main(sys.argv[1:])
unwanted = "torch" in sys.modules
sys.exit("torch was imported" if unwanted else code)
"""


@pytest.mark.parametrize(
    "words",
    [["run", "net.loom", "--data", "data", "--spikes", "out.npz"], ["estimate", "net.loom", "--data", "data"]],
    ids=["run", "estimate"],
)
def test_run_and_estimate_never_import_torch(place, words):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, *words], cwd=place, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
