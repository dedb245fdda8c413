"""``--explain-cost``: what was simulated and why, and that nothing is simulated twice."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_files import STEPS
from random_netlists import Axon, Neuron, build, large_netlist

from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.equivalence import reference
from spikeloom.runtime.machines.loihi1 import blocks, engine

RUN = ("run", "net.loom", "--data", "data")
VERIFY = ("verify", "net.loom", "--checkpoint", "net.pt", "--data", "data")
LAYERS = ["conv1", "fc1", "fc2", "fc3"]


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
        (("estimate", *RUN[1:], "--detail", "cycle"), "cycle"),
    ],
)
def test_every_recording_is_run_once(spikeloom, passes, words, part):
    _, out, err = spikeloom(*words, "--explain-cost", "--json")
    assert passes == [6]
    entry, absent = json.loads(out)["explained_cost"]
    assert (entry.pop("seconds") > 0, bool(entry.pop("why"))) == (True, True)
    known = {"part": part, "ran": True, "arithmetic": "chip integers", "recordings": 6, "data_steps": 6 * STEPS}
    assert entry == known | {"layers": LAYERS, "kernel": "layer by layer, 64 neurons at a time"}
    assert (absent["ran"], absent["recordings"], absent["layers"]) == (False, 0, [])
    assert len(err.splitlines()) == 2


def test_parts_of_verify(spikeloom):
    checks = [
        "float32 reference",
        "float64 beside it",
        "chip",
        "specification",
        *(f"ladder: {rung}" for rung in ("beta", "weights", "bias_threshold", "proven")),
        "first divergence",
        "certificate",
    ]
    _, out, err = spikeloom(*VERIFY, "--spec-samples", 2, "--explain-cost", "--json")
    entries = {entry["part"]: entry for entry in json.loads(out)["explained_cost"]}
    assert list(entries) == checks
    assert entries["specification"]["recordings"] == 2
    assert not entries["ladder: proven"]["ran"]
    assert entries["first divergence"]["data_steps"] == STEPS
    assert len(err.splitlines()) == len(checks)


def test_a_rung_that_is_proven_is_what_it_would_be(as_json, monkeypatch):
    proven = as_json(*VERIFY, codes=(0, 1))["ladder"]
    monkeypatch.setattr(reference, "prove_ranges", lambda _: [type("Proof", (), {"holds": False})()])
    report = as_json(*VERIFY, "--explain-cost", codes=(0, 1))
    assert report["ladder"] == proven
    assert "ladder: rounding" in [entry["part"] for entry in report["explained_cost"] if entry["ran"]]


def test_why_a_netlist_runs_step_by_step(place):
    netlist = read_netlist(place / "net.loom")
    axon = Axon(source=0, targets=((0, 254),), exponent=7)
    one, two = (build([Neuron()], [axon] * axons, n_inputs=1, depths=[0]) for axons in (1, 2))
    slow = replace(netlist, decay_v=read_only(np.zeros(netlist.n_compartments)))
    wiring = "a layer is recurrent or receives from others than the one before it"
    assert blocks.lay_out_blocks(large_netlist(1, proved=True)) == wiring
    for each, large in ((netlist, False), (one, False), (two, True), (slow, True)):
        why = blocks.lay_out_blocks(each)
        assert (
            (why == "a sum may leave 16 bits, or a membrane or current its register") == isinstance(why, str) == large
        )
