"""The command ``chart`` on small networks: what it writes, that its commands give its figures, resuming, refusals."""

import csv
import hashlib
import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_files import CLASSES, events, own_file, recordings_folder, ring, weights
from random_crossbars import random_network
from zoo import STORAGE, tuned

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.models.networks.checkpoint import save_checkpoint
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.studies.chart import work as chart_work

GRID = "bits=4,8,window=50-100%:50,cores=cores/fc1:2"
VIOLATION = Violation(owner="core 0", rule="loihi1.core.axons_in", used=5, allowed=4, remedy="use fewer inputs")

CHART = ("chart", "ring.pt", "--data", "data", "--grid", GRID, "--jobs", "1")


def chain():
    pairs = ring().edges
    return replace(ring(), name="knn:1", edges=pairs[abs(pairs[:, 0] - pairs[:, 1]) == 1])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings and checkpoints of two graphs."""
    folder = tmp_path_factory.mktemp("chart")
    train = np.concatenate([events(1, samples=12), events(3, samples=4, rate=0.05)])
    recordings_folder(folder / "data", train=train, test=events(2, samples=8))
    recordings_folder(folder / "other", test=events(5, samples=8))
    digest = data_digest(load_data(folder / "data", "train"), load_data(folder / "data", "test"))
    known = {"data_sha256": digest, "validation": {"correct": 3, "samples": 4}, "command": "spikeloom train …"}
    own_file(folder / "ring.pt", training=known)
    own_file(folder / "chain.pt", last=weights(3), graph=chain(), training=known)
    own_file(folder / "unknown.pt", last=weights(4))
    forms = tuned(read_checkpoint(folder / "ring.pt")).forms
    save_checkpoint(folder / "tuned.pt", {"last": weights()}, ring(), beta=0.2, theta=0.5, training=known, forms=forms)
    own_file(folder / "elsewhere.pt", training={"data_sha256": "0" * 64, "data": "Grasps.zip"})
    network = random_network(4, taxels=6, classes=CLASSES, steps=24)
    write_trained(folder / "native.pt", {"last": network}, graph="ring", edges=np.zeros((0, 2), int), training=known)
    own_file(folder / "small.pt", last=weights(taxels=4), graph=ring(4))
    (folder / "file").write_text("")
    return folder


@pytest.fixture
def made(as_json, place):
    """A chart of one network, made once."""
    if not (place / "out" / "chart.json").exists():
        assert as_json(*CHART, "-o", "out") == json.loads((place / "out" / "chart.json").read_text())
    return json.loads((place / "out" / "chart.json").read_text())


@pytest.fixture
def again(made, place):
    """A copy of its folder."""
    shutil.copytree(place / "out", place / "again", dirs_exist_ok=True)
    return place / "again"


# -- points ------------------------------------------------------------------------------------------------------------
def test_every_point_of_the_grid_is_there(made, place):
    found = [(p["bits"], p["cores"], p["window"]) for p in made["points"]]
    assert found == [(b, c, w) for b in ([4], [8]) for c in ("cores", "fc1:2") for w in (50, 100)]
    assert [point["number"] for point in made["points"]] == list(range(1, 9))
    assert made["refused"] == []
    assert (made["data"]["train"], made["data"]["test"], made["data"]["steps"]) == (16, 8, 24)
    (network,) = made["networks"]
    assert network["validation"] == network["expected"] == 0.75
    decided = {}
    for point in made["points"]:
        kept = point["train"]["accuracy"] / network["float_training"]
        assert point["expected"] == pytest.approx(0.75 * kept)
        assert point["test"]["low"] <= point["test"]["accuracy"] <= point["test"]["high"]
        figures = [point[split][key] for split in ("train", "test") for key in ("correct", "equal")]
        assert decided.setdefault((str(point["bits"]), point["window"]), figures) == figures, "layouts decide alike"
    assert any(point["front"]["energy"] for point in made["points"])
    assert len({point["n_cores"] for point in made["points"]}) > 1
    assert (place / "out" / "chart.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (place / "out" / "chart.svg").read_text("utf-8").startswith("<?xml")
    assert (place / "out" / "chart.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    with (place / "out" / "chart.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row, point in zip(rows, made["points"], strict=True):
        assert row["bits"] == str(point["bits"][0])
        assert float(row["test_energy_j_davies2018"]) == point["test"]["energy_j"]["davies2018"]
        assert float(row["train_time_s_sanafe"]) == point["train"]["time_s"]["sanafe"]
        assert [row["compile"], row["run"]] == point["commands"]


@pytest.mark.parametrize("number", [4, 7])
def test_the_commands_of_a_point_give_its_netlist_and_its_figures(made, as_json, place, number):
    point = made["points"][number - 1]
    compiled, ran = (shlex.split(command) for command in point["commands"])
    as_json(*compiled[1:])
    netlist = (place / compiled[-1]).read_bytes()
    assert netlist == (place / "out" / point["netlist"]).read_bytes()
    assert hashlib.sha256(netlist).hexdigest() == point["netlist_sha256"]
    found = as_json(*ran[1:])
    assert found["accuracy"] == point["test"]["accuracy"]
    mean = found["costs"]["per_inference"]
    assert mean["energy_j"] == pytest.approx(point["test"]["energy_j"], rel=1e-12)
    assert mean["synaptic_operations"] == point["test"]["synaptic_operations"]
    (clock,) = found["costs"]["time"]
    assert {clock["table"]: clock["inference_s"]["mean"]} == pytest.approx(point["test"]["time_s"], rel=1e-12)
    assert found["costs"]["chip_steps"] == point["test"]["steps"] + read_netlist(place / compiled[-1]).max_depth
    words = ("--checkpoint", "ring.pt", "--data", "data", "--window", f"{point['window']}%", "--spec-samples", "1")
    found = as_json("verify", compiled[-1], *words, codes=(0, 1))
    assert found["accuracy"]["float"] == point["test"]["float"]["accuracy"]
    assert found["decision_agreement"] == point["test"]["equal"] / 8


# -- again -------------------------------------------------------------------------------------------------------------
def test_once_more_nothing_is_measured_and_every_byte_is_the_same(made, spikeloom, place, monkeypatch):
    before = {file.name: file.read_bytes() for file in (place / "out").glob("chart.*")}

    def never(_work):
        raise AssertionError("measured again")

    monkeypatch.setattr("spikeloom.runtime.studies.chart.work.measure", never)
    assert spikeloom(*CHART, "-o", "out", "--json")[0] == 0
    assert {file.name: file.read_bytes() for file in (place / "out").glob("chart.*")} == before


def test_one_more_width_measures_nothing_else(made, again, spikeloom, monkeypatch):
    worked, measure = [], chart_work.measure
    monkeypatch.setattr(
        "spikeloom.runtime.studies.chart.work.measure", lambda work: worked.append(work) or measure(work)
    )
    words = [word.replace("bits=4,8", "bits=4,6,8") for word in CHART]
    assert spikeloom(*words, "-o", "again", "--json")[0] == 0
    assert [work.storage.bits for work in worked] == [(6,)]
    points = json.loads((again / "chart.json").read_text())["points"]
    assert [point["test"] for point in points if point["bits"] != [6]] == [point["test"] for point in made["points"]]


# -- choices -----------------------------------------------------------------------------------------------------------
def test_what_the_chip_refuses_is_listed(as_json, refusal, place, monkeypatch):
    refused, to_integers = {4}, chart_work.to_integers

    def picky(network, options, target):
        if options.packings is not None and options.packings[0].bits in refused:
            raise CapacityError((VIOLATION,))
        return to_integers(network, options, target)

    monkeypatch.setattr("spikeloom.runtime.studies.chart.work.to_integers", picky)
    words = ("chart", "ring.pt", "--data", "data", "--jobs", "1", "--grid")
    found = as_json(*words, "bits=4,3,window=100%", "-o", "refused")
    assert [(each["bits"], each["why"]) for each in found["refused"]] == [([4], [str(VIOLATION)])]
    refused |= {5, 6}
    line = refusal(*words, "bits=5-6,window=100%", "-o", "nothing")
    assert line.endswith(f"refuses all 2 configurations; the first: {VIOLATION}")
    assert not (place / "nothing" / "chart.json").exists()


def test_a_fine_tuned_network_keeps_its_storage(as_json):
    words = ("chart", "tuned.pt", "--data", "data", "--jobs", "1", "-o", "tuned", "--grid")
    points = as_json(*words, "bits=2-6,8,window=50%,100%")["points"]
    found = [(tuple(point["bits"]), point["fine_tuned"], point["window"]) for point in points]
    widths = tuple(bits for bits, _ in STORAGE)
    assert found == [(widths, True, 50), (widths, True, 100)]
    assert "--weight-bits" not in points[0]["commands"][0]


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("ring.pt --data data --grid bits=8+4", r"bits=8\+4: 2 widths, ring.pt has 4 layers \(conv1, fc1, fc2, fc3\)"),
        ("ring.pt --data data --grid cores=fc9:2", "fc9:2: ring.pt has no layer fc9; it has conv1, fc1, fc2, fc3"),
        ("ring.pt ring.pt --data data", "ring.pt: is given twice"),
        ("elsewhere.pt --data data", r"elsewhere.pt: was trained on other recordings \(Grasps.zip\) than data"),
        ("unknown.pt small.pt --data data", f"small.pt: has 4 taxels and {CLASSES} classes, unknown.pt has 6"),
        ("ring.pt native.pt --data data", "native.pt: is for truenorth, ring.pt for loihi1; .* make a chart of each"),
        ("net.onnx --data data", "net.onnx: is an ONNX file"),
        ("ring.pt --data data -o file", "-o file: is not a folder"),
    ],
)
def test_a_mistake_is_named(refusal, place, words, told):
    line = refusal("chart", *(words if "-o" in words else f"{words} -o bad").split())
    assert re.match(f".*{told}", line), line
    assert not (place / "bad").exists()
