"""``--explain-cost``: what was simulated and why, and that nothing is simulated twice."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_files import STEPS, own_file, recordings_folder
from random_netlists import Axon, Neuron, build, large_netlist

from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist, write_netlist
from spikeloom.runtime import cli
from spikeloom.runtime.equivalence import ladder
from spikeloom.runtime.machines.loihi1 import blocks, engine

RUN = ("run", "net.loom", "--data", "data")
ESTIMATE = ("estimate", "net.loom", "--data", "data")
VERIFY = ("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data")
LAYERS = ["conv1", "fc1", "fc2", "fc3"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, a checkpoint and its netlist."""
    folder = tmp_path_factory.mktemp("cost")
    recordings_folder(folder / "data")
    own_file(folder / "net.pt")
    assert cli.main(["compile", str(folder / "net.pt"), "-o", str(folder / "net.loom"), "--json"]) == 0
    return folder


@pytest.fixture
def spikeloom(capsys, place, monkeypatch):
    """Run a command in that folder; returns standard output and standard error."""
    monkeypatch.chdir(place)

    def command(*words):
        capsys.readouterr()
        assert cli.main([str(word) for word in words]) == 0
        return tuple(capsys.readouterr())

    return command


@pytest.fixture
def passes(monkeypatch):
    """Recordings of every pass of the engine."""
    found, simulate = [], engine.simulate

    def counted(netlist, events, **options):
        found.append(len(events))
        return simulate(netlist, events, **options)

    monkeypatch.setattr(engine, "simulate", counted)
    return found


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (RUN, "spikes"),
        ((*RUN, "--spikes", "out.npz"), "spikes kept"),
        ((*RUN, "--detail", "counts", "--spikes", "out.npz"), "counts"),
        ((*ESTIMATE, "--detail", "cycle"), "cycle"),
    ],
)
def test_every_recording_is_run_once(spikeloom, passes, words, part):
    out, err = spikeloom(*words, "--explain-cost", "--json")
    assert passes == [6]
    entry, absent = json.loads(out)["explained_cost"]
    assert (entry.pop("seconds") > 0, bool(entry.pop("why"))) == (True, True)
    kernel = "layer by layer, 64 neurons at a time"
    assert entry == {
        "part": part,
        "ran": True,
        "arithmetic": "chip integers",
        "recordings": 6,
        "data_steps": 6 * STEPS,
        "layers": LAYERS,
        "kernel": kernel,
    }
    assert (absent["ran"], absent["recordings"], absent["layers"]) == (False, 0, [])
    first, second = err.splitlines()
    assert first.startswith(f"spikeloom: simulated {part} (6 recordings, 144 steps, 4 layers, chip integers, {kernel})")
    assert second.startswith("spikeloom: not simulated, float: ")


def test_nothing_is_said_unasked(spikeloom):
    for words in (RUN, ESTIMATE, VERIFY):
        out, err = spikeloom(*words, "--json")
        assert "explained_cost" not in json.loads(out)
        assert err == ""


def test_spikes_are_the_same_in_every_detail(spikeloom, place):
    kept = {}
    for detail in ("spikes", "counts", "cycle"):
        spikeloom(*RUN, "--detail", detail, "--spikes", f"{detail}.npz")
        kept[detail] = dict(np.load(place / f"{detail}.npz"))
    assert list(kept["spikes"]) == LAYERS
    for detail in ("counts", "cycle"):
        for name, spikes in kept["spikes"].items():
            np.testing.assert_array_equal(kept[detail][name], spikes, strict=True)


def test_parts_of_verify_and_report(spikeloom, tmp_path):
    checks = [
        "float32 reference",
        "float64 beside it",
        "chip",
        "specification",
        *(f"ladder: {rung}" for rung in ("beta", "weights", "bias_threshold", "proven")),
        "first divergence",
        "certificate",
    ]
    out, err = spikeloom(*VERIFY, "--spec-samples", 2, "--explain-cost", "--json")
    entries = {entry["part"]: entry for entry in json.loads(out)["explained_cost"]}
    assert list(entries) == checks
    assert entries["specification"]["recordings"] == 2
    assert not entries["ladder: proven"]["ran"]
    assert entries["first divergence"]["data_steps"] == STEPS
    assert len(err.splitlines()) == len(checks)
    words = (*VERIFY[1:], "-o", tmp_path / "page.html", "--explain-cost", "--json")
    out, _ = spikeloom("report", *words)
    assert [entry["part"] for entry in json.loads(out)["explained_cost"]] == [*checks, "costs", "the recording"]


def test_a_rung_that_is_proven_is_what_it_would_be(spikeloom, monkeypatch):
    proven = json.loads(spikeloom(*VERIFY, "--json")[0])["ladder"]
    monkeypatch.setattr(ladder, "prove_ranges", lambda _: [type("Proof", (), {"holds": False})()])
    out, _ = spikeloom(*VERIFY, "--explain-cost", "--json")
    report = json.loads(out)
    assert report["ladder"] == proven
    assert "ladder: rounding" in [entry["part"] for entry in report["explained_cost"] if entry["ran"]]


def test_why_a_netlist_runs_step_by_step(spikeloom, tmp_path):
    netlist = read_netlist("net.loom")
    assert blocks.obstacle(netlist) is None
    assert (
        blocks.obstacle(large_netlist(1, proved=True))
        == "a layer is recurrent or receives from others than the one before it"
    )
    axon = Axon(source=0, targets=((0, 254),), exponent=7)
    assert blocks.obstacle(build([Neuron()], [axon], n_inputs=1, depths=[0])) is None
    assert (
        blocks.obstacle(build([Neuron()], [axon, axon], n_inputs=1, depths=[0]))
        == "a sum may leave 16 bits, or a membrane or current its register"
    )
    slow = replace(netlist, decay_v=read_only(np.zeros(netlist.n_compartments)))
    write_netlist(slow, tmp_path / "slow.loom")
    out, _ = spikeloom("run", tmp_path / "slow.loom", "--data", "data", "--explain-cost", "--json")
    assert json.loads(out)["explained_cost"][0]["kernel"] == (
        "step by step: a sum may leave 16 bits, or a membrane or current its register"
    )
