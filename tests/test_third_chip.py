"""A chip that inherits nothing of another one: put into the tuple of backends, every command takes it."""

from dataclasses import replace
from pathlib import Path

import abacus
import numpy as np
import pytest
from abacus import FILE, Abacus
from commands import as_json, refusal, run
from zoo import specimen

from spikeloom.compiler.archive import stated
from spikeloom.compiler.errors import FormatError, OptionError
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.machines import backends


@pytest.fixture
def made(monkeypatch, tmp_path):
    monkeypatch.setattr(backends, "BACKENDS", (*backends.BACKENDS, Abacus()))
    monkeypatch.chdir(tmp_path)
    return specimen("tactilesgnet")


def test_it_inherits_nothing_of_another_chip():
    text = Path(abacus.__file__).read_text()
    assert not any(f"{backend.name}." in text for backend in backends.BACKENDS)


def test_every_command_takes_it(made):
    compiled = as_json("compile", made.network, *made.reading, "--target", "abacus", "-o", "net.loom")
    assert stated(Path("net.loom"), "target") == "abacus"
    assert as_json("inspect", "net.loom") == compiled
    decided = as_json("run", "net.loom", "--data", made.data, "--spikes", "spikes.npz")
    with np.load("spikes.npz") as spikes:
        assert tuple(spikes) == backends.machine_for("net.loom").layers
        assert np.array_equal(decided["counts"], votes_of(spikes))
    assert as_json("estimate", "net.loom", "--data", made.data)["per_inference"]["energy_j"]["guess"] > 0
    words = ("net.loom", "--checkpoint", made.network, *made.reading, "--data", made.data)
    verdict = as_json("verify", *words, "--spec-samples", 1, "--require", "EN,E0,E1")
    shares = {level["name"]: level["share"] for level in verdict["levels"]}
    assert (shares["EN"], shares["E0"], shares["E1"], shares["E2"]) == (1, 1, 1, None)
    assert shares["E3"] == verdict["decision_agreement"] > 0.2
    assert (
        as_json("report", *words, "--spec-samples", 1, "-o", "page.html")["verify"]["levels"]
        == verdict["levels"]
    )
    assert "beads moved an inference" in Path("page.html").read_text()


def votes_of(spikes):
    """Votes of each recording by the spikes that were written."""
    netlist = backends.machine_for("net.loom").netlist
    voting = netlist.readout_class[netlist.layer == len(netlist.layers) - 1]
    return spikes[netlist.layers[-1]].sum(axis=1) @ np.eye(netlist.classes, dtype=np.int64)[voting]


def test_what_is_wrong_is_found(made, monkeypatch):
    as_json("compile", made.network, *made.reading, "--target", "abacus", "-o", "net.loom")
    words = ("--checkpoint", made.network, *made.reading, "--data", made.data, "--spec-samples", 1)
    netlist = FILE.read("net.loom")
    FILE.write(replace(netlist, threshold=netlist.threshold - 20), "net.loom")
    code, out, _ = run("verify", "net.loom", *words)
    assert code == 1
    assert "missed: EN: NOT what this network is lowered to: another threshold" in out
    assert "missed: E1" not in out, "nobody required it"
    right = abacus.specification
    monkeypatch.setattr(abacus, "specification", lambda netlist, channels: right(netlist, channels[::-1]))
    assert "missed: E0" in run("verify", "net.loom", *words)[1]


def test_what_it_does_not_have_is_refused_by_name(made):
    compiling = ("compile", made.network, *made.reading, "-o", "net.loom", "--target")
    assert refusal(*compiling, "abacus", "--planes", 2) == "--planes 2: is not for the abacus; omit it"
    assert refusal(*compiling, "loihi2").endswith("allowed: loihi1, truenorth, abacus")
    as_json(*compiling, "abacus")
    assert "is for Abacus, which anytime does not take" in refusal(
        "anytime", "net.loom", "--data", made.data
    )
    with pytest.raises(OptionError, match="--target abacus: takes no counting networks"):
        backends.backend_of("abacus").counting_bits  # noqa: B018
    netlist = FILE.read("net.loom")
    FILE.write(replace(netlist, layer=netlist.layer + 1), "damaged.loom")
    assert "damaged.loom: layer has values outside 0" in refusal("inspect", "damaged.loom")
    with pytest.raises(FormatError, match="holds a counting network, not yet compiled, this is for abacus"):
        FILE.read(shipped("pretrained:objects-counters"))
