"""Recordings of different length in one folder: each decides as it does alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_files import CLASSES, TAXELS, own_file, weights

from spikeloom.compiler import lift
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.networks.networks import Architecture, SpikingNet
from spikeloom.models.recordings.events import load_data
from spikeloom.models.training.evaluate import evaluate, predict
from spikeloom.models.training.train import train, validation_split
from spikeloom.runtime.cli import main

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
            lines = [f"{(step + 0.5) * 0.02:.2f},{taxel},{polarity}" for step, taxel, polarity in np.argwhere(grid)]
            file = tmp_path / "data" / split / f"grasp_{index}_label_{index % CLASSES}.csv"
            file.write_text("\n".join(["time_s,taxel,polarity", *lines, ""]))
    assert main(["compile", "x.pt", "-o", "x.loom"]) == 0
    return tmp_path / "data"


def as_json(capsys, *words):
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


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


def test_verify_compares_each_recording_at_its_own_length(folder, capsys):
    words = ("verify", "x.loom", "--checkpoint", "x.pt", "--spec-samples", "1", "--min-agreement", "0")
    together = as_json(capsys, *words, "--data", "data")
    assert together["spec_equals_engine"]
    parts = [as_json(capsys, *words, "--data", str(file)) for file in files(folder)]
    for layer, found in together["spikes"].items():
        for key in found:
            assert found[key] == sum(part["spikes"][layer][key] for part in parts), (layer, key)
    for rung, found in enumerate(together["ladder"]):
        for layer, different in found["different"].items():
            assert different == sum(part["ladder"][rung]["different"][layer] for part in parts)
    assert together["decision_agreement"] == pytest.approx(np.mean([part["decision_agreement"] for part in parts]))


def test_estimate_prices_each_recording_at_its_own_length(folder, capsys):
    together = as_json(capsys, "estimate", "x.loom", "--data", "data")
    parts = [as_json(capsys, "estimate", "x.loom", "--data", str(file)) for file in files(folder)]
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
    assert predict(network, together).tolist() == [int(predict(network, one)[0]) for one in alone]
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
        part = replace(part, events=part.events[..., :steps])
        architecture = Architecture(taxels=TAXELS, classes=CLASSES)
        fit.append(train(part, part, np.eye(TAXELS), architecture, **options).last)
    for name, array in fit[0].items():
        assert np.array_equal(array, fit[1][name])
