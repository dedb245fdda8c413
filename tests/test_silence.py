"""What networks keep of their training and sensor, and what is said where recordings are others than these."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import as_json, refusal, run
from made_files import TAXELS, csv_folder, own_file, recordings_folder, state_dict, weights
from oracles import refused

import spikeloom
from spikeloom.compiler.errors import DataError
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.commands.check import certify
from spikeloom.runtime.inputs.checkpoint import places_of
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.requests.check import CertifyRequest
from spikeloom.runtime.studies.robustness.certify_sections import taxel_map

PLACES = [[float(taxel), 2.0 * (taxel % 2)] for taxel in range(TAXELS)]
STEPS = 20
SMALL = ("--features", "2", "--hidden", "4", "--epochs", "1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("silence")
    train, test = (np.random.default_rng(seed).random((12, TAXELS, 2, STEPS)) < 0.2 for seed in (1, 2))
    recordings_folder(place / "data", train=train, test=test)
    longer = (np.random.default_rng(3).random((12, TAXELS, 2, STEPS + 40)) < 0.2 for _ in range(2))
    recordings_folder(place / "longer", train=next(longer), test=next(longer))
    (place / "coords.csv").write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in PLACES))
    return place


@pytest.fixture(scope="module")
def half(folder):
    """A network that was trained on the first half of each recording, its netlist, and what training reached."""
    sensor = ("--taxels", folder / "coords.csv", "--graph", "knn:2")
    network = folder / "half.pt"
    given = ("--data", folder / "data", *sensor, *SMALL, "--window", "50%", "-o", network)
    made = as_json("train", *given)
    assert run("compile", network, "-o", folder / "half.loom")[0] == 0
    return network, folder / "half.loom", made


def test_the_part_of_recordings_that_trained_a_network_is_what_runs_it(folder, half):
    _, netlist, _ = half
    given = ("estimate", netlist, "--data", folder / "data")
    own = as_json(*given)
    assert own == as_json(*given, "--window", "50%")
    assert own != as_json(*given, "--window", "100%")
    origin = origin_of(machine_for(netlist).netlist.provenance)
    assert origin["window"] == 50
    assert run("export", netlist, "--to", "nir", "-o", folder / "half.nir")[0] == 0
    assert run("compile", folder / "half.nir", "-o", folder / "back.loom")[0] == 0
    assert origin_of(machine_for(folder / "back.loom").netlist.provenance) == origin


def test_positions_of_taxels_go_with_the_network(folder, half):
    network, netlist, _ = half
    origin = machine_for(netlist).netlist.provenance
    assert np.array_equal(places_of(None, origin, TAXELS), PLACES)
    given = ("--checkpoint", network, "--data", folder / "data", "--limit", "2", "-o", folder / "page.html")
    page = as_json("report", netlist, *given, codes=(0, 1))
    assert page["taxels"]["positions_mm"] == PLACES
    assert "positions are not known" not in (folder / "page.html").read_text()


def test_what_no_netlist_may_have_is_not_remembered():
    said = {"data": "x" * 1001, "bin_s": "0.05", "window": 101, "steps": True, "positions_mm": [[[0.0]]]}
    assert origin_of(said) == {}
    kept = {"data": "x", "bin_s": 0.05, "window": 50, "steps": 40, "positions_mm": [[0.0, -1.5]]}
    assert origin_of(kept) == kept


def test_counters_know_the_places_of_their_taxels(folder):
    given = ("--data", folder / "data", "--system", "counters", "--thresholds", "1,2")
    sensor = ("--taxels", folder / "coords.csv")
    made = as_json("train", *given, *sensor, "-o", folder / "placed.pt")
    assert f"--taxels {folder / 'coords.csv'}" in made["record"]["command"]
    assert run("compile", folder / "placed.pt", "-o", folder / "placed.loom")[0] == 0
    origin = machine_for(folder / "placed.loom").netlist.provenance
    assert np.array_equal(places_of(None, origin, TAXELS), PLACES)


@pytest.mark.parametrize(
    "said", [PLACES[:-1], [[0.0], [1.0, 2.0]], [["x", "y"]] * TAXELS, [[1e999, 0.0]] * TAXELS]
)
def test_positions_that_are_none_are_not_taken(said):
    assert places_of(None, {"positions_mm": said}, TAXELS) is None


def test_events_after_the_steps_that_counters_were_trained_for_are_said(folder):
    given = ("--data", folder / "data", "--system", "counters", "--thresholds", "1,2")
    assert run("train", *given, "-o", folder / "count.pt")[0] == 0
    assert run("compile", folder / "count.pt", "-o", folder / "count.loom")[0] == 0
    assert "after the network's" not in run("run", folder / "count.loom", "--data", folder / "data")[2]
    said = run("run", folder / "count.loom", "--data", folder / "longer")[2]
    assert f"after the network's {STEPS} steps: they may move votes until step {STEPS + 32}" in said


def test_test_recordings_that_trained_are_said(folder):
    shutil.copytree(folder / "data", folder / "twice")
    for name in ("sample_0_label_0.npy", "sample_1_label_1.npy"):
        shutil.copy(folder / "twice/train" / name, folder / "twice/test" / name)
    given = ("--system", "counters", "--thresholds", "1,2", "-o", folder / "twice.pt")
    said = run("train", "--data", folder / "twice", *given)[2]
    assert "2 of 12 test recordings are training recordings, too" in said
    assert "training recordings, too" not in run("train", "--data", folder / "data", *given)[2]


def test_a_picture_of_a_training_has_numbers_beside_its_axis(folder):
    given = (
        "--taxels",
        TAXELS,
        "--system",
        "mlp",
        "--hidden",
        "4",
        "--epochs",
        "2",
        "-o",
        folder / "shown.pt",
    )
    code, _, err = run("train", "--data", folder / "data", *given, "--picture", folder / "shown.svg")
    assert code == 0, err
    assert "mathdefault" not in (folder / "shown.svg").read_text()


def test_the_time_of_a_certificate_is_told_before(folder, half, monkeypatch):
    _, netlist, _ = half
    monkeypatch.setattr(certify, "TOLD_S", 0)
    given = ("--data", folder / "data", "--limit", "1", "--most", "1")
    assert ", at most about 0 min, then every other change" in run("certify", netlist, *given)[2]


def test_positions_that_are_given_to_compile_go_with_the_netlist(folder):
    torch.save(state_dict(weights()), folder / "bare.pt")
    graph = ("--taxels", folder / "coords.csv", "--graph", "knn:2")
    assert run("compile", folder / "bare.pt", *graph, "-o", folder / "bare.loom")[0] == 0
    words = ("--data", folder / "data", "--limit", "1", "--most", "1", "--picture", folder / "taxels.svg")
    assert run("certify", folder / "bare.loom", *words)[0] == 0
    origin = machine_for(folder / "bare.loom").netlist.provenance
    assert np.array_equal(places_of(None, origin, TAXELS), PLACES)
    drawn = (folder / "taxels.svg").read_text()
    result = certify.run(
        CertifyRequest(netlist=str(folder / "bare.loom"), data=str(folder / "data"), limit=1, most=1)
    )
    assert np.array_equal(result.result.places, PLACES)
    plain = replace(result.result, places=None)
    assert taxel_map(plain).file("svg").decode() != drawn == taxel_map(result.result).file("svg").decode()


def test_conversions_keep_the_length_of_each_recording(folder):
    made = csv_folder(folder / "events", samples=4)
    (made / "tap_0_label_0.csv").write_text("time_s,taxel,polarity\n0.01,1,1\n0.09,5,0\n")
    assert run("data", "convert", made, "-o", folder / "converted")[0] == 0
    before, after = (load_data(folder / name, "test") for name in ("events", "converted"))
    assert after.step_counts.tolist() == before.step_counts.tolist() == [5, 49, 49, 49]
    assert np.array_equal(after.events, before.events)


def test_bins_that_nothing_says_the_width_of_are_asked_for(folder, tmp_path):
    for width in (0.02, 0.04, 0.05):
        own_file(tmp_path / f"{width}.pt", training={"data": "data", "bin_s": width})
        assert run("compile", tmp_path / f"{width}.pt", "-o", tmp_path / f"{width}.loom")[0] == 0
    data = ("--data", folder / "data")
    assert run("estimate", tmp_path / "0.02.loom", *data)[::2] == (0, "")
    for width in (0.04, 0.05):
        said = refusal("estimate", tmp_path / f"{width}.loom", *data)
        assert f"0.02 s as nothing says another width, the network was trained on bins of {width} s" in said
    joined = as_json("estimate", tmp_path / "0.04.loom", *data, "--bin", "0.04")
    assert joined["chip_steps"] < as_json("estimate", tmp_path / "0.02.loom", *data)["chip_steps"]
    events = spikeloom.recordings(csv_folder(tmp_path / "events", samples=4))
    net = spikeloom.load(str(tmp_path / "0.05.loom"))
    refused(DataError, "read them with recordings(…, bin=0.05)", net.run, events.test)
    assert str(net.run(events)) == str(net.run(spikeloom.recordings(tmp_path / "events", bin=0.05).test))


def test_a_folder_of_another_name_is_no_doubt_where_classes_have_names(folder, tmp_path):
    for split in ("train", "test"):
        made = csv_folder(tmp_path / "taps" / split, samples=8)
        for file in made.iterdir():
            file.rename(file.with_name(file.name.replace("label_", "label_object")))
    words = ("--data", tmp_path / "taps", "--system", "counters", "--thresholds", "1,2")
    assert run("train", *words, "-o", tmp_path / "net.pt")[0] == 0
    assert run("compile", tmp_path / "net.pt", "-o", tmp_path / "net.loom")[0] == 0
    (tmp_path / "taps").rename(tmp_path / "other")
    assert (
        "are their classes the same?"
        not in run("run", tmp_path / "net.loom", "--data", tmp_path / "other")[2]
    )


def test_recordings_are_a_sequence(folder):
    data = load_data(csv_folder(folder / "sequence", samples=4), "test")
    assert len(data) == len(list(data)) == 4
    (*_, (events, label)), (again, _) = data, data[-1]
    assert (label, events.shape) == (int(data.labels[3]), (TAXELS, 2, data.steps_of(3)))
    assert np.array_equal(events, again)
    assert data[1:3].files == data.files[1:3]
    assert repr(data) == "sequence, test: 4 recordings, 6 taxels, up to 49 steps"
    with pytest.raises(IndexError):
        data[4]


def test_a_width_that_was_found_and_one_that_was_given_are_one_netlist(folder, half):
    network, _, _ = half
    own = ("compile", network, "--calibrate", folder / "data")
    assert run(*own, "--keep", "0", "-o", folder / "found.loom")[0] == 0
    assert run(*own, "--weight-bits", "8", "-o", folder / "given.loom")[0] == 0
    one, other = (machine_for(folder / name).netlist for name in ("found.loom", "given.loom"))
    assert one.provenance["digests"] == other.provenance["digests"]
