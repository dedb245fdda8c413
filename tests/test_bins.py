"""Networks whose steps join bins of the recordings: trained, compiled and used as on recordings of longer bins."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_checkpoint import rebuilt

from spikeloom.compiler.dynamics import NO_CLOCKS
from spikeloom.compiler.errors import FormatError, ModelError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.targets.loihi1.netlist_file import netlist_bytes, read_netlist, write_netlist
from spikeloom.compiler.targets.truenorth.native import SYSTEM as NATIVE
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.recordings.release import write_released
from spikeloom.runtime.cli import main
from spikeloom.runtime.studies.stress import bench, disturbances

BINS = 3


TRAINED = ("--graph", "manual", "--epochs", "1")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, the same in longer bins, and a network of each."""
    folder = tmp_path_factory.mktemp("bins")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        splits = [
            replace(synthetic_grasps(per_class=2, steps=20, seed=seed, classes=("ring", "box")), split=split)
            for split, seed in (("train", 1), ("test", 2))
        ]
        write_released(folder / "fine", splits)
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


@pytest.fixture
def report(place, monkeypatch, capsys):
    """Run a command in the folder: its result."""
    monkeypatch.chdir(place)
    capsys.readouterr()

    def run(*words, code=0):
        assert main([*words, "--json"]) == code
        out, _ = capsys.readouterr()
        return json.loads(out)

    return run


@pytest.fixture
def refusal(place, monkeypatch, capsys):
    """Run a command in the folder that refuses: its line."""
    monkeypatch.chdir(place)
    capsys.readouterr()

    def run(*words):
        assert main(list(words)) == 2
        out, err = capsys.readouterr()
        assert not out
        return err.strip()

    return run


# --- training and files -----------------------------------------------------------------------------------------------
def test_it_is_the_network_of_recordings_in_longer_bins(place):
    own, plain = (read_checkpoint(place / f"{name}.pt") for name in ("x", "plain"))
    assert (own.bins, plain.bins) == (BINS, 1)
    for ours, theirs in zip((own.hops, own.dense[-1].weight), (plain.hops, plain.dense[-1].weight), strict=True):
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
    write_netlist(replace(read_netlist(place / "x.loom"), bins=bins), tmp_path / "y.loom")
    with pytest.raises(FormatError, match="the manifest has no usable bins; compile it again"):
        read_netlist(tmp_path / "y.loom")
    content = rebuilt((place / "x.pt").read_bytes(), lambda manifest, _: manifest.update(bins=bins))
    (tmp_path / "y.pt").write_bytes(content)
    with pytest.raises(ModelError, match="the manifest has no usable bins"):
        read_checkpoint(tmp_path / "y.pt")


def test_a_finished_training_of_other_bins_is_another(refusal):
    line = refusal("train", "--data", "fine", "--join", "2", *TRAINED, "--resume", "-o", "x.pt")
    assert line == "spikeloom: x.pt: holds another training (other bins); give its options, or another -o"


def test_networks_for_truenorth_take_bins_as_they_are(refusal):
    words = ("train", "--system", NATIVE, "--graph", "manual", "--data", "fine", "--join", "2", "-o", "y.pt")
    told = refusal(*words)
    assert f"--join 2: a network of system {NATIVE} takes bins as they are" in told
    assert "spikeloom data convert --join" in told


# --- every command that reads recordings ------------------------------------------------------------------------------
def test_it_decides_on_the_recordings_what_the_other_does_on_longer_bins(report):
    ours, theirs = (
        report("run", f"{name}.loom", "--data", data, "--detail", "counts")
        for name, data in (("x", "fine"), ("plain", "long"))
    )
    assert ours["counts"] == theirs["counts"]
    assert any(map(any, ours["counts"]))
    assert ours["predictions"] == theirs["predictions"]
    own, other = ours["costs"]["per_inference"], theirs["costs"]["per_inference"]
    assert own["energy_j"] == other["energy_j"]
    pace, others = (found["costs"]["pace"] for found in (ours, theirs))
    assert (pace["bin_s"], others["bin_s"]) == (pytest.approx(BINS * BIN_S), BIN_S)
    for table, watt in pace["real_time_w"].items():
        assert watt == pytest.approx(others["real_time_w"][table] / BINS)


def test_verify_and_explain(report):
    found = [
        report("verify", f"{name}.loom", "--checkpoint", f"{name}.pt", "--data", data, "--require", "E0")
        for name, data in (("x", "fine"), ("plain", "long"))
    ]
    assert found[0] == found[1]
    assert report("explain", "x.loom", "--checkpoint", "x.pt", "--data", "fine")["steps"] == 7


def test_a_netlist_of_other_bins_is_not_from_this_network(refusal):
    line = refusal("verify", "plain.loom", "--checkpoint", "x.pt", "--data", "fine")
    assert "netlist and checkpoint disagree" in line
    assert f"bins of a step {BINS}" in line


@pytest.mark.parametrize(
    "words",
    # what reads recordings in the same way in many runs, bits and lean, is left out: they take long
    [
        "anytime NET --data DATA --calibrate DATA",
        "stress NET --checkpoint CKPT --data DATA --seeds 1 --only taxels_dead,warm_state,longer,ties_fire",
    ],
)
def test_other_commands_find_what_they_find_on_longer_bins(report, words, place):
    found = []
    for name, data in (("x", "fine"), ("plain", "long")):
        names = {"NET": f"{name}.loom", "CKPT": f"{name}.pt", "DATA": data}
        found.append(_without_names(report(*(names.get(word, word) for word in words.split()))))
    assert found[0] == found[1]


def _without_names(value):
    """A report without names, hashes, commands, times, and what follows from the length of a step."""
    told = ("calibrated_on", "command", "source", "chosen", "name", "candidate", "data", "provenance", "netlist")
    told += ("checkpoint", "sha256")
    if isinstance(value, dict):
        return {key: _without_names(entry) for key, entry in value.items() if not any(word in key for word in told)}
    return [_without_names(entry) for entry in value] if isinstance(value, list) else value


def test_what_is_done_to_recordings_is_done_before_they_are_joined():
    events = np.zeros((1, 1, 2, 7), np.uint8)
    events[..., 4] = 1
    netlist = SimpleNamespace(bins=3, clocks=NO_CLOCKS)
    late = bench.whole(disturbances.start_late(events, 2), netlist, np.array([7]))
    assert late.events.tolist() == [[[0, 0, 1]] * 2]
    assert late.lengths.tolist() == [3]


# --- what else is made of them ----------------------------------------------------------------------------------------
def test_joined_networks_and_fine_tuned_ones_keep_them(report, refusal, place):
    report("join", "x.pt", "x.pt", "-o", "both.pt")
    assert (read_checkpoint(place / "both.pt").bins, read_checkpoint(place / "both.pt").towers) == (BINS, 2)
    report("finetune", "x.pt", "--data", "fine", "--weight-bits", "4", "--epochs", "1", "-o", "tuned.pt")
    report("finetune", "plain.pt", "--data", "long", "--weight-bits", "4", "--epochs", "1", "-o", "plain-tuned.pt")
    tuned, plain = (read_checkpoint(place / f"{name}.pt") for name in ("tuned", "plain-tuned"))
    assert (tuned.bins, plain.bins, len(tuned.forms)) == (BINS, 1, 4)
    assert_array_equal(tuned.dense[0].weight, plain.dense[0].weight)
    assert tuned.training["data_sha256"] == read_checkpoint(place / "x.pt").training["data_sha256"]
    assert "bins of a step (plain.pt)" in refusal("join", "x.pt", "plain.pt", "-o", "z.pt")
