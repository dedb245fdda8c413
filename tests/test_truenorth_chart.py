"""A network for TrueNorth in a chart; and the first part of recordings."""

import json
import shlex

import numpy as np
import pytest
from made_files import CLASSES, STEPS, TAXELS, events, recordings_folder
from random_crossbars import random_network

from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest

NATIVE = "native.pt"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings and a network."""
    folder = tmp_path_factory.mktemp("chart")
    train = np.concatenate([events(1, samples=12), events(3, samples=4, rate=0.05)])
    recordings_folder(folder / "data", train=train, test=events(2, samples=8))
    digest = data_digest(load_data(folder / "data", "train"), load_data(folder / "data", "test"))
    known = {"data_sha256": digest, "validation": {"correct": 3, "samples": 4}, "command": "spikeloom train …"}
    network = random_network(4, taxels=TAXELS, classes=CLASSES, steps=STEPS)
    write_trained(folder / NATIVE, {"last": network}, graph="ring", edges=np.zeros((0, 2), int), training=known)
    return folder


def test_a_network_for_truenorth_has_a_point_for_each_window(spikeloom, place):
    grid = "bits=8,window=50-100%:50"
    code, out, err = spikeloom("chart", NATIVE, "--data", "data", "--grid", grid, "--jobs", "1", "-o", "out")
    assert (code, err) == (0, "")
    report = json.loads((place / "out" / "chart.json").read_text())
    points = report["points"]
    assert [(point["storage"], point["window"]) for point in points] == [("7 levels", 50), ("7 levels", 100)]
    assert report["target"] == "truenorth"
    assert set(report["tables"]["energy"]) == {"all_in", "marginal"}
    assert set(report["tables"]["time"]) == {"tick"}
    (charted,) = report["networks"]
    assert charted["expected"] == 0.75
    assert "energy (all_in)" in out
    assert "time (tick)" in out
    for point in points:
        # chip and model decide alike, in every part of a recording
        assert [point[split]["equal"] for split in ("train", "test")] == [16, 8]
        assert point["test"]["float"]["accuracy"] == point["test"]["accuracy"]
        kept = point["train"]["accuracy"] / charted["float_training"]
        assert point["expected"] == pytest.approx(0.75 * kept)
        # its commands give its netlist and its figures
        compiled, ran = (shlex.split(command) for command in point["commands"])
        assert spikeloom(*compiled[1:])[0] == 0
        assert (place / compiled[-1]).read_bytes() == (place / "out" / point["netlist"]).read_bytes()
        found = json.loads(spikeloom(*ran[1:], "--json")[1])
        assert found["accuracy"] == point["test"]["accuracy"]
        mean = found["costs"]["per_inference"]
        assert mean["energy_j"] == pytest.approx(point["test"]["energy_j"], rel=1e-12)
        assert mean["synaptic_events"] == point["test"]["synaptic_operations"]
        ticks = STEPS * point["window"] // 100 + 3
        assert point["test"]["time_s"] == {"tick": pytest.approx(ticks * 1e-3)}
        assert point["test"]["step_s"] == {"tick": pytest.approx(1e-3)}


@pytest.mark.parametrize("command", ["run n.loom", "estimate n.loom", f"verify n.loom --checkpoint {NATIVE}"])
def test_a_part_of_every_recording(spikeloom, command):
    assert spikeloom("compile", NATIVE, "--target", "truenorth", "-o", "n.loom")[0] == 0
    words = [*command.split(), "--data", "data", "--json", "--window"]
    code, out, _ = spikeloom(*words, "50%")
    assert code == 0
    assert "per_inference" not in out or json.loads(out)["per_inference"]["ticks"] == STEPS // 2 + 3
    code, out, err = spikeloom(*words, "0%")
    assert (code, out) == (2, "")
    assert "--window 0%: not a part of a recording" in err
