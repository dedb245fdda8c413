"""Recordings of different length, and networks whose steps join bins: each decides as on what was cut or joined."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commands import as_json
from made_files import CLASSES, TAXELS, grasps_folder, own_file, rebuilt, weights
from numpy.testing import assert_array_equal
from oracles import refused

from spikeloom.compiler.dynamics import NO_CLOCKS
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import netlist_bytes, read_netlist
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.models.training.evaluate import evaluate
from spikeloom.models.training.train import train, validation_split
from spikeloom.runtime.cli import main
from spikeloom.runtime.studies.robustness import bench, perturbations

STEPS = (5, 40, 17, 17, 90, 1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Event files of several lengths and a network whose biases speak in silence; the working folder holds both."""
    monkeypatch.chdir(tmp_path)
    lively = weights(3)
    for name in ("fc1.bias", "fc2.bias", "fc3.bias"):
        lively[name] += np.float32(0.3)
    own_file(tmp_path / "x.pt", last=lively)
    rng = np.random.default_rng(5)
    for split in ("train", "test"):
        (tmp_path / "data" / split).mkdir(parents=True)
        for index, steps in enumerate(STEPS * 2 if split == "train" else STEPS):
            grid = rng.random((steps, TAXELS, 2)) < 0.3
            grid[-1, 0, 0] = True  # the last event says how long it is
            lines = [
                f"{(step + 0.5) * 0.02:.2f},{taxel},{polarity}"
                for step, taxel, polarity in np.argwhere(grid)
            ]
            file = tmp_path / "data" / split / f"grasp_{index}_label_{index % CLASSES}.csv"
            file.write_text("\n".join(["time_s,taxel,polarity", *lines, ""]))
    assert main(["compile", "x.pt", "-o", "x.loom"]) == 0
    return tmp_path / "data"


def files(folder):
    return sorted((folder / "test").iterdir())


def test_silence_after_the_end_would_move_votes(folder):
    together = load_data(folder, "test")
    assert together.lengths.tolist() == list(STEPS)
    assert load_data(files(folder)[1]).lengths is None
    fitted, held = validation_split(load_data(folder, "train"))
    assert sorted([*fitted.lengths, *held.lengths]) == sorted(STEPS * 2)
    network = lift(read_netlist("x.loom"))
    flat = together.events.reshape(len(together), -1, together.steps).transpose(0, 2, 1).astype(bool)
    whole = run_integer(network, flat).spikes[-1]
    assert whole[0, STEPS[0] :].any(), "the network is silent in silence, so nothing is tested here"


def test_verify_compares_each_recording_at_its_own_length(folder):
    words = ("verify", "x.loom", "--checkpoint", "x.pt", "--spec-samples", "1", "--min-agreement", "0")
    together = as_json(*words, "--data", "data")
    assert together["spec_equals_engine"]
    parts = [as_json(*words, "--data", str(file)) for file in files(folder)]
    for layer, found in together["spikes"].items():
        for key in found:
            assert found[key] == sum(part["spikes"][layer][key] for part in parts), (layer, key)
    for rung, found in enumerate(together["ladder"]):
        for layer, different in found["different"].items():
            assert different == sum(part["ladder"][rung]["different"][layer] for part in parts)
    assert together["decision_agreement"] == pytest.approx(
        np.mean([part["decision_agreement"] for part in parts])
    )


def test_the_page_draws_a_recording_at_its_own_length(folder):
    words = (
        "report",
        "x.loom",
        "--checkpoint",
        "x.pt",
        "--data",
        "data",
        "-o",
        "x.html",
        "--recording",
        "0",
    )
    recording = as_json(*words)["recording"]
    assert (recording["file"], recording["steps"]) == (files(folder)[0].name, STEPS[0])


def test_estimate_prices_each_recording_at_its_own_length(folder):
    together = as_json("estimate", "x.loom", "--data", "data")
    parts = [as_json("estimate", "x.loom", "--data", str(file)) for file in files(folder)]
    assert together["chip_steps"] == max(part["chip_steps"] for part in parts)
    for key in ("neuron_accesses", "neuron_updates", "spikes", "synaptic_operations"):
        alone = [part["per_inference"][key] for part in parts]
        assert together["per_inference"][key] == pytest.approx(np.mean(alone))
        assert (together["min"][key], together["max"][key]) == (min(alone), max(alone))


def test_training_sees_each_recording_at_its_own_length(folder):
    adjacency = np.eye(TAXELS)
    network = SpikingNet(Architecture(taxels=TAXELS, classes=CLASSES), adjacency, seed=2)
    together = load_data(folder, "test")
    alone = [load_data(file, taxels=TAXELS) for file in files(folder)]
    loss, correct = evaluate(network, together)
    parts = [evaluate(network, one) for one in alone]
    assert (loss, correct) == (pytest.approx(np.mean([p[0] for p in parts])), sum(p[1] for p in parts))


def test_a_training_does_not_depend_on_the_longest_recording(folder):
    """The file of 90 steps decides how long the array is; without it the same recordings train the same weights."""
    chosen = load_data(folder, "train")
    short = np.flatnonzero(chosen.lengths < 90)
    options = {"epochs": 1, "seed": 1}
    fit = []
    for steps in (90, 40):
        part = chosen.part(short)
        part = replace(part, held=part.events[..., :steps])
        architecture = Architecture(taxels=TAXELS, classes=CLASSES)
        fit.append(train(part, part, np.eye(TAXELS), architecture, **options).last)
    for name, array in fit[0].items():
        assert np.array_equal(array, fit[1][name])


BINS = 3
TRAINED = ("--graph", "manual", "--epochs", "1")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, the same in longer bins, and a network of each."""
    folder = tmp_path_factory.mktemp("bins")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        grasps_folder(folder / "fine", per_class=2, steps=20, classes=("ring", "box"))
        words = (
            ("data", "convert", "fine", "--join", str(BINS), "-o", "long"),
            ("train", "--data", "fine", "--join", str(BINS), *TRAINED, "-o", "x.pt"),
            ("train", "--data", "long", *TRAINED, "-o", "plain.pt"),
            ("compile", "x.pt", "--calibrate", "fine", "-o", "x.loom"),
            ("compile", "plain.pt", "--calibrate", "long", "-o", "plain.loom"),
        )
        for command in words:
            assert main([*command, "--json"]) == 0
    return folder


def test_it_is_the_network_of_recordings_in_longer_bins(place):
    own, plain = (read_checkpoint(place / f"{name}.pt") for name in ("x", "plain"))
    assert (own.bins, plain.bins) == (BINS, 1)
    for ours, theirs in zip(
        (own.hops, own.dense[-1].weight), (plain.hops, plain.dense[-1].weight), strict=True
    ):
        assert_array_equal(ours, theirs)
    assert own.training["command"].startswith(f"spikeloom train --data fine --join {BINS} --graph manual ")
    assert own.training["history"] == plain.training["history"]
    fine = own.training["data_sha256"]
    assert fine != plain.training["data_sha256"], "the hash is over what the data set holds"


def test_the_netlist_is_that_one_but_for_the_bins(place):
    own, plain = (read_netlist(place / f"{name}.loom") for name in ("x", "plain"))
    assert (own.bins, plain.bins) == (BINS, 1)
    assert netlist_bytes(replace(own, bins=1, provenance={})) == netlist_bytes(replace(plain, provenance={}))


@pytest.mark.parametrize("bins", [0, True, "3", 2**20 + 1])
def test_unusable_bins_are_refused(place, tmp_path, bins):
    content = rebuilt((place / "x.pt").read_bytes(), lambda manifest, _: manifest.update(bins=bins))
    (tmp_path / "y.pt").write_bytes(content)
    refused(ModelError, "the manifest has no usable bins", read_checkpoint, tmp_path / "y.pt")


@pytest.mark.usefixtures("spikeloom")
def test_it_decides_on_the_recordings_what_the_other_does_on_longer_bins():
    ours, theirs = (
        as_json("run", f"{name}.loom", "--data", data) for name, data in (("x", "fine"), ("plain", "long"))
    )
    assert ours["counts"] == theirs["counts"]
    assert any(map(any, ours["counts"]))
    assert ours["predictions"] == theirs["predictions"]
    own = as_json("estimate", "x.loom", "--data", "fine")
    other = as_json("estimate", "plain.loom", "--data", "long")
    assert own["per_inference"]["energy_j"] == other["per_inference"]["energy_j"]
    pace, others = own["pace"], other["pace"]
    assert (
        pace["bin_s"] == others["bin_s"] == pytest.approx(BINS * BIN_S)
    )  # which convert wrote beside the bins
    for table, watt in pace["real_time_w"].items():
        assert watt == pytest.approx(others["real_time_w"][table])


@pytest.mark.parametrize(
    "words",
    # what reads recordings in the same way in many runs, bits and lean, is left out: they take long
    [
        "verify NET --checkpoint CKPT --data DATA --require E0",
        "explain NET --checkpoint CKPT --data DATA",
        "anytime NET --data DATA --calibrate DATA",
        "stress NET --checkpoint CKPT --data DATA --seeds 1 --only taxels_dead,warm_state,longer,ties_fire",
    ],
)
@pytest.mark.usefixtures("spikeloom")
def test_other_commands_find_what_they_find_on_longer_bins(words, place):
    found = []
    for name, data in (("x", "fine"), ("plain", "long")):
        names = {"NET": f"{name}.loom", "CKPT": f"{name}.pt", "DATA": data}
        found.append(_without_names(as_json(*(names.get(word, word) for word in words.split()))))
    assert found[0] == found[1]


def _without_names(value):
    """A report without names, hashes, commands, times, and what follows from the length of a step."""
    told = (
        "calibrated_on",
        "command",
        "source",
        "chosen",
        "name",
        "candidate",
        "data",
        "provenance",
        "netlist",
    )
    told += ("checkpoint", "sha256")
    if isinstance(value, dict):
        return {
            key: _without_names(entry)
            for key, entry in value.items()
            if not any(word in key for word in told)
        }
    return [_without_names(entry) for entry in value] if isinstance(value, list) else value


def test_what_is_done_to_recordings_is_done_before_they_are_joined():
    events = np.zeros((1, 1, 2, 7), np.uint8)
    events[..., 4] = 1
    netlist = SimpleNamespace(bins=3, clocks=NO_CLOCKS)
    late = bench.whole(perturbations.start_late(events, 2), netlist, np.array([7]))
    assert late.channels(slice(None)).tolist() == [[[0, 0, 1]] * 2]
    assert late.lengths.tolist() == [3]


def test_joined_networks_and_fine_tuned_ones_keep_them(refusal, place):
    as_json("join", "x.pt", "x.pt", "-o", "both.pt")
    assert (read_checkpoint(place / "both.pt").bins, read_checkpoint(place / "both.pt").towers) == (BINS, 2)
    as_json("finetune", "x.pt", "--data", "fine", "--weight-bits", "4", "--epochs", "1", "-o", "tuned.pt")
    as_json(
        "finetune",
        "plain.pt",
        "--data",
        "long",
        "--weight-bits",
        "4",
        "--epochs",
        "1",
        "-o",
        "plain-tuned.pt",
    )
    tuned, plain = (read_checkpoint(place / f"{name}.pt") for name in ("tuned", "plain-tuned"))
    assert (tuned.bins, plain.bins, len(tuned.forms)) == (BINS, 1, 4)
    assert_array_equal(tuned.dense[0].weight, plain.dense[0].weight)
    assert tuned.training["data_sha256"] == read_checkpoint(place / "x.pt").training["data_sha256"]
    assert "bins of a step (plain.pt)" in refusal("join", "x.pt", "plain.pt", "-o", "z.pt")
    again = refusal("train", "--data", "fine", "--join", "2", *TRAINED, "--resume", "-o", "x.pt")
    assert again == "x.pt: holds another training (other bins); give its options, or another -o"
