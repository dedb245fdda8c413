"""The command ``anytime``: figures of a stopped chip are those of a chip that stopped, and what cannot be asked."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_files import CLASSES, events, own_file, recordings_folder, weights
from numpy.testing import assert_allclose, assert_array_equal

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist, write_netlist
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime import cli
from spikeloom.runtime.machines.integer import integer_machine_of
from spikeloom.runtime.machines.loihi1 import engine, kernel
from spikeloom.runtime.machines.loihi1.costs import cost, cumulative, estimate
from spikeloom.runtime.machines.loihi1.trace import Counts
from spikeloom.runtime.machines.votes import class_counts, predictions
from spikeloom.runtime.studies.anytime import exits

STEPS = 60

WORDS = ("anytime", "net.loom", "--data", "data")
ALL = (*WORDS, "--checkpoint", "net.pt", "--calibrate", "data")


def _recordings(seed, samples):
    return events(seed, samples=samples, steps=STEPS, rate=0.3)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, a checkpoint and its netlist."""
    folder = tmp_path_factory.mktemp("anytime")
    recordings_folder(folder / "data", train=_recordings(1, 40), test=_recordings(2, 12))
    own_file(folder / "net.pt", last=weights(3, gain=2.5))
    own_file(folder / "wide.pt", last=weights(sizes=(10, 8, CLASSES)))
    assert cli.main(["compile", str(folder / "net.pt"), "-o", str(folder / "net.loom"), "--json"]) == 0
    return folder


@pytest.fixture
def report(spikeloom, place):
    """What the command found with everything, made once."""
    if not (place / "all.json").exists():
        code, out, err = spikeloom(*ALL, "--differ", "0.25", "-o", "all.json", "--picture", "all.png", "--json")
        assert (code, err) == (0, "")
        assert json.loads((place / "all.json").read_text()) == json.loads(out)
        assert (place / "all.png").read_bytes().startswith(b"\x89PNG")
    return json.loads((place / "all.json").read_text())


def test_text(spikeloom, golden):
    code, out, err = spikeloom(*ALL)
    assert (code, err) == (0, "")
    golden("anytime.txt", out)


def test_without_labels_checkpoint_and_calibration(spikeloom, tmp_path):
    grasp = tmp_path / "grasp.npy"
    np.save(grasp, events(5, samples=1)[0].astype(np.float32))
    code, out, _ = spikeloom("anytime", "net.loom", "--data", grasp, "--picture", tmp_path / "proof.png")
    assert code == 0
    lines = out.splitlines()
    assert lines[0].split() == [
        *("stop", "when", "votes", "ahead", "steps", "operations", "davies2018", "sanafe", "time,", "sanafe", "differ"),
        "right",
    ]
    assert [line.split()[0] for line in lines if line] == ["stop", "all", "proven", "all", "live:"]


def test_all_figures_of_a_stopped_chip(report, place, monkeypatch):
    monkeypatch.chdir(place)
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    target, flat = load_target("loihi1"), with_clocks(data.events, netlist.clocks)
    stepped, meter = engine.prepare(netlist, stepwise=True), cost.prepare(netlist, target)
    assert [rule["allowed"] for rule in report["rules"]] == [None, 0.0, 0.005, 0.01, 0.02, 0.05, 0.25]
    assert report["chosen"] == 6
    full, whole = engine.simulate(netlist, flat), estimate.estimate(netlist, target, flat)[1]
    joule = {name: each.sum(axis=1) for name, each in whole.costs.energy.items()}
    second = {name: each.duration_ns.sum(axis=1) * 1e-9 for name, each in whole.simple.items()}
    assert report["decisions"] == predictions(netlist, full.counts.spikes).tolist()
    for rule in (report["rules"][0], report["rules"][6]):
        for i, ends in enumerate(rule["samples"]["chip_steps"]):
            state = kernel.state_of(netlist)
            engine.advance(stepped, state, flat[i], length=STEPS, steps=ends)
            updates = np.bincount(netlist.layer, state.updates)[None].astype(np.int64)
            counts = Counts(
                inputs=state.inputs[None], spikes=state.spikes[None], updates=updates, saturations=0 * updates
            )
            assert rule["samples"]["decisions"][i] == predictions(netlist, counts.spikes)[0]
            found = cost.estimate(meter, counts, ends - netlist.max_depth)
            left = whole.costs.synaptic_operations[i].sum() - found.synaptic_operations.sum()
            assert rule["samples"]["saved_operations"][i] == left
            for name, each in found.energy.items():
                assert_allclose(rule["samples"]["saved_energy_j"][name][i], joule[name][i] - each.sum(), atol=1e-18)
            spent = whole.simple["sanafe"].duration_ns[i, :ends].sum() * 1e-9
            assert_allclose(rule["samples"]["saved_time_s"]["sanafe"][i], second["sanafe"][i] - spent, atol=1e-15)
    proof = report["rules"][0]
    assert proof["differ"] == proof["gained"] == proof["lost"] == 0
    assert proof["samples"]["decisions"] == report["decisions"]
    assert_allclose(
        proof["mean"]["energy_j"]["sanafe"], (1 - proof["saved"]["energy_j"]["sanafe"]) * joule["sanafe"].mean()
    )
    assert report["rules"][report["savings"]["identical"]]["differ"] == 0
    assert report["rules"][report["savings"]["one_lost"]]["correct"] >= report["full"]["correct"] - 1


def test_windows_are_those_of_shortened_recordings(report, spikeloom):
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    assert [window["percent"] for window in report["windows"]] == list(range(5, 101, 5))
    for window in report["windows"]:
        steps = max(STEPS * window["percent"] // 100, 1)
        assert window["bins"] == steps
        flat = with_clocks(data.events[..., :steps], netlist.clocks)
        decided = predictions(netlist, engine.simulate(netlist, flat).counts.spikes)
        assert window["chip"]["correct"] == np.count_nonzero(decided == data.labels)
    recordings_folder(Path("short"), test=_recordings(2, 12)[..., : STEPS // 2])
    cut = json.loads(spikeloom("verify", "net.loom", "--checkpoint", "net.pt", "--data", "short", "--json")[1])
    assert report["windows"][9]["float"]["correct"] == round(cut["accuracy"]["float"] * len(data))
    assert report["windows"][9]["chip"]["correct"] == round(cut["accuracy"]["chip"] * len(data))


def test_recordings_of_different_length_end_on_their_own(place, monkeypatch):
    monkeypatch.chdir(place)
    netlist, data = read_netlist("net.loom"), load_data("data", "test")
    lengths = np.array([60, 1, 7, 24, 33, 2, 50, 59, 60, 60, 3, 40])
    ran = cumulative.run(netlist, load_target("loihi1"), with_clocks(data.events, netlist.clocks), lengths)
    at = exits.standing(ran.votes, lengths)
    sure = exits.proven(ran.votes, at, exits.most_votes(integer_machine_of(netlist), STEPS))
    ends = exits.exits(sure, at)
    assert np.all(ends < lengths)
    for i, length in enumerate(lengths):
        flat = with_clocks(data.events[i : i + 1, ..., :length], netlist.clocks)
        counts, alone = estimate.estimate(netlist, load_target("loihi1"), flat)
        assert_array_equal(ran.votes[i, -1], class_counts(netlist, counts.spikes)[0])
        assert at.leader[i, ends[i]] == predictions(netlist, counts.spikes)[0]
        assert ran.operations[i, -1] == alone.costs.synaptic_operations.sum()
        for name, each in alone.costs.energy.items():
            assert_allclose(ran.energy[name][i, -1], each.sum())
        assert_allclose(ran.time["sanafe"][i, -1], alone.simple["sanafe"].duration_ns.sum() * 1e-9)


def test_several_chips_have_no_times(spikeloom, tmp_path):
    netlist = read_netlist("net.loom")
    far = replace(netlist, core_tile=netlist.core_tile + np.arange(netlist.n_cores) * 32)
    if netlist.n_cores > 1:
        write_netlist(far, tmp_path / "far.loom")
        report = json.loads(spikeloom("anytime", tmp_path / "far.loom", "--data", "data", "--json")[1])
        assert report["full"]["time_s"] == {}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--differ", "0.1"], ["--differ 0.1: ", "add --calibrate"]),
        (["--calibrate", "data", "--differ", "1"], ["--differ 1: ", "from 0 to below 1"]),
        (["--graph", "manual"], ["--graph: ", "--checkpoint", "not given"]),
        (["--dt", "0.02"], ["--dt: ", "--checkpoint", "not given"]),
        (["-o", "net.loom"], ["-o net.loom: ", "an input", "another name"]),
        (["--picture", "none/x.png"], ["--picture none/x.png: ", "folder does not exist"]),
        (["--checkpoint", "wide.pt"], ["netlist and checkpoint disagree", "fc1 9", "fc1 10"]),
    ],
)
def test_mistakes(spikeloom, words, said):
    code, out, err = spikeloom(*WORDS, *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert all(word in err for word in said)
