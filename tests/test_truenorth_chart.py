"""Networks for TrueNorth in a chart: beside those for Loihi, and alone; and the first part of recordings."""

import csv
import json
import shlex

import numpy as np
import pytest
from made_files import CLASSES, STEPS, TAXELS, events, own_file, recordings_folder
from random_crossbars import random_network

from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.studies.chart import work as chart_work

NATIVE, LOIHI = "native.pt", "ring.pt"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, a checkpoint and two networks for TrueNorth, one of unknown origin."""
    chart_work.both_splits.cache_clear()
    folder = tmp_path_factory.mktemp("chart")
    train = np.concatenate([events(1, samples=12), events(3, samples=4, rate=0.05)])
    recordings_folder(folder / "data", train=train, test=events(2, samples=8))
    digest = data_digest(load_data(folder / "data", "train"), load_data(folder / "data", "test"))
    known = {"data_sha256": digest, "validation": {"correct": 3, "samples": 4}, "command": "spikeloom train …"}
    own_file(folder / LOIHI, training=known)
    for name, seed, training in ((NATIVE, 4, known), ("unknown.pt", 5, {})):
        network = random_network(seed, taxels=TAXELS, classes=CLASSES, steps=STEPS)
        write_trained(folder / name, {"last": network}, graph="ring", edges=np.zeros((0, 2), int), training=training)
    return folder


def test_a_network_for_truenorth_has_a_point_for_each_window(spikeloom, place):
    grid = "bits=8,window=50-100%:50"
    code, out, err = spikeloom("chart", LOIHI, NATIVE, "--data", "data", "--grid", grid, "--jobs", "1", "-o", "out")
    assert (code, err) == (0, "")
    report = json.loads((place / "out" / "chart.json").read_text())
    points = [point for point in report["points"] if point["target"] == "truenorth"]
    assert [(point["storage"], point["window"]) for point in points] == [("7 levels", 50), ("7 levels", 100)]
    assert (len(report["points"]), report["target"]) == (4, "loihi1")
    assert set(report["tables"]["energy"]) == {"davies2018", "sanafe", "all_in", "marginal"}
    assert set(report["tables"]["time"]) == {"sanafe", "tick"}
    # choices and fronts are of the chip of the first network
    assert not any(any(point["front"].values()) for point in points)
    chosen = {*report["recommended"].values(), report["saving"]["chosen"]["point"]}
    assert not chosen & {point["number"] for point in points}
    assert report["networks"][1]["expected"] == 0.75
    # every file, and the text, names its prices
    page = (place / "out" / "chart.html").read_text()
    assert "energy of a mean inference (davies2018; truenorth: all_in)" in page
    assert "time of a mean inference on the chip (sanafe; truenorth: tick)" in page
    with (place / "out" / "chart.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["network"] == "native"]
    assert [row["test_energy_j_davies2018"] for row in rows] == ["", ""]
    assert all(float(row["test_energy_j_all_in"]) > 0 for row in rows)
    head, *lines = out.partition("on truenorth, whose prices are others (no choice, no front):\n")[2].splitlines()
    assert "energy (all_in)" in head
    assert "time (tick)" in head
    for line, point in zip(lines, points, strict=False):
        assert f"native 7 levels, {point['window']} %" in line
        # chip and model decide alike, in every part of a recording
        assert [point[split]["equal"] for split in ("train", "test")] == [16, 8]
        assert point["test"]["float"]["accuracy"] == point["test"]["accuracy"]
        kept = point["train"]["accuracy"] / report["networks"][1]["float_training"]
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
