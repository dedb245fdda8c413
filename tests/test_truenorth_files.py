"""Files of crossbar cores: round trip, what is refused, the commands that take them; and those for RANC's simulator,
with equal spikes where its binary is named by ``RANC_SIM``.
"""

import json
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import as_json, refusal, run
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from made_files import recordings_folder
from numpy.testing import assert_array_equal
from oracles import refused
from random_crossbars import IN_RANCS_TERMS, alone, crossbars, events

from spikeloom.compiler import archive
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import FormatError, ModelError
from spikeloom.compiler.formats import ranc
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.truenorth import netlist as crossbar
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, history_free
from spikeloom.runtime.machines.truenorth import spec

ARRAYS = crossbar.FILE.arrays


def network() -> crossbar.CrossbarNetlist:
    """Two of three taxels; a neuron each receives one and votes for its own class."""
    draft = Draft()
    core = draft.core(3, 4)
    for taxel in range(2):
        draft.axon(
            core, taxel, [draft.neuron(core, history_free((1, 1, 0, 0), 1), layer="out", number=taxel)]
        )
        for polarity in range(2):
            draft.feed(2 * taxel + polarity, core, taxel)
        draft.vote((core, taxel), taxel)
    return draft.netlist(taxels=3, polarities=2, classes=2, provenance={"made": "by hand"})


@pytest.fixture
def path(tmp_path):
    crossbar.write_crossbars(network(), tmp_path / "net.loom")
    return tmp_path / "net.loom"


@settings(max_examples=15)
@given(crossbars())
def test_round_trip(tmp_path_factory, netlist):
    path = tmp_path_factory.mktemp("crossbars") / "x.loom"
    crossbar.write_crossbars(netlist, path)
    again = crossbar.read_crossbars(path)
    assert crossbar.crossbar_bytes(again) == crossbar.crossbar_bytes(netlist) == path.read_bytes()
    assert crossbar.inconsistencies(again) == []


def test_numpy_alone_reads_it_and_a_reader_of_other_files_names_it(path):
    with np.load(path) as members:
        manifest = json.loads(str(members["manifest"]))
        assert (manifest["format"], manifest["provenance"]) == (crossbar.FILE.format, {"made": "by hand"})
        assert members["weight"].tolist() == [[1, 1, 0, 0]] * 2
    assert is_netlist(path)
    refused(
        FormatError,
        "holds crossbar cores (--target truenorth), this is for | (--target loihi1)",
        read_netlist,
        path,
    )


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"threshold": np.zeros(3, np.int8)}, "threshold has 3 entries, 2 are needed"),
        ({"weight": np.zeros(8, np.int8)}, "weight is no table of integers"),
        ({"wire_x": np.zeros(1, np.int8)}, "wire_x has 1 entries, 0 are needed"),
        ({"synapse_neuron": np.array([0, 2], np.int8)}, "synapse_neuron points beyond its core"),
        ({"core_axons": np.array([0, 1], np.int8)}, "core_axons does not divide 2 entries in 1 parts"),
        ({"feed_channel": np.array([0, 1, 2, 6], np.int8)}, "feed_channel has values outside 0 … 5"),
        ({"layer": np.array([0, 1], np.int8)}, "layer has values outside 0 … 0"),
        ({"manifest": {"bin_ticks": 0}}, "the manifest has no usable bin_ticks"),
        ({"manifest": {"layers": []}}, "the manifest has no usable layers"),
        ({"manifest": {"clocks": {"channels": 0}}}, "the manifest has no usable clocks"),
        ({"manifest": {"target": "loihi1"}}, "is for 'loihi1', this program knows truenorth"),
        ({"manifest": {"version": 3}}, "has format version 3, this program reads 2"),
        (
            {"axon_synapses": np.array([0, 2, 2], np.int8), "synapse_neuron": np.array([1, 1], np.int8)},
            "synapse_neuron does not rise along an axon",
        ),
    ],
)
def test_files_that_mean_nothing(path, changes, line):
    """The same file with other arrays and a fitting hash."""
    members = archive.read_members(path)
    manifest = json.loads(str(members["manifest"])) | changes.get("manifest", {})
    path.write_bytes(
        archive.archive_bytes(manifest, {name: changes.get(name, members[name]) for name in ARRAYS})
    )
    with pytest.raises(FormatError, match=re.escape(line)):
        crossbar.read_crossbars(path)


@pytest.fixture
def place(path, tmp_path):
    """A folder with the network and four recordings of its sensor: touches of taxel 0, 1, 1 and 2."""
    recordings = np.zeros((4, 3, 2, 6), np.uint8)
    for sample, (taxel, touches) in enumerate([(0, 2), (1, 3), (1, 1), (2, 4)]):
        recordings[sample, taxel, 0, :touches] = 1
        recordings[sample, taxel, 1, 0] = 1  # the same axon in the same tick
    recordings_folder(tmp_path / "data", train=recordings, test=recordings, classes=2)
    return tmp_path


def test_four_touches_counted_by_hand(place):
    words = (place / "net.loom", "--data", place / "data")
    report = as_json("run", *words, "--spikes", place / "s.npz")
    assert report["predictions"] == [0, 1, 1, 0]
    assert report["counts"] == [[2, 0], [0, 3], [0, 1], [0, 0]]
    assert report["accuracy"] == 0.5
    with np.load(place / "s.npz") as spikes:
        assert spikes["out"].shape == (4, 6, 2)
        assert spikes["out"].sum(axis=1).tolist() == report["counts"]

    report = as_json("estimate", *words)
    assert report["per_inference"]["spikes"] == 1.5
    # every arrival meets one crossing point: 2, 3, 1 and 0 of them, and one of two polarities is merged in each
    found = {
        name: report["per_inference"][name]
        for name in ("synaptic_events", "spikes", "merged_spikes", "ticks")
    }
    assert found == {"synaptic_events": 1.5, "spikes": 1.5, "merged_spikes": 0.75, "ticks": 6}
    assert report["per_inference"]["time_s"] == pytest.approx(6e-3)
    all_in, marginal = report["energy"]
    assert (all_in["table"], all_in["floor_j"]) == ("all_in", None)
    assert all_in["total_j"] == pytest.approx(1.5 * 26e-12)
    assert marginal["floor_j"] == pytest.approx(0.0644 * 6e-3)
    assert marginal["floor_of_used_cores_j"] == pytest.approx(0.0644 * 6e-3 / 4096)
    assert marginal["total_j"] == pytest.approx(0.0644 * 6e-3 + 1.5 * 2.3e-12)
    assert report["pace"]["real_time"] is True
    out = run("estimate", *words)[1]
    assert "per inference on 1 of 4,096 cores, over 4 recordings:" in out
    assert "a data step takes 1 ms: keeps the sensor's pace of 20 ms a step" in out


@pytest.mark.parametrize("name", ["inspect", "run", "estimate"])
def test_every_broken_rule_is_named(place, name):
    crossbar.write_crossbars(
        replace(network(), leak=read_only([300, 0]), reset=read_only([0, 300])), place / "net.loom"
    )
    data = [] if name == "inspect" else ["--data", place / "data"]
    leak, reset = run(name, place / "net.loom", *data)[2].splitlines()
    assert "core 0, neuron 0: leak 300, -256 … 255 allowed (truenorth.neuron.leak_bits)" in leak
    assert "core 0, neuron 1: reset value 300, -256 … 255 allowed (truenorth.neuron.reset_bits)" in reset


def small(**changes):
    """Two cores with a corner of the mesh at (5, 2); the second neuron votes, the third has no target."""
    draft = Draft()
    draft.core(5, 2)
    draft.core(6, 3)
    draft.neuron(
        0, Neuron(weights=(0, 4, 0, 0), threshold=3, negative_threshold=2, **changes), layer="layer0"
    )
    for number in range(2):
        draft.neuron(
            1, Neuron(weights=(0, 0, 0, 1), reset_mode=crossbar.RESET_LINEAR), layer="layer1", number=number
        )
    draft.axon(0, 1, [0])
    draft.axon(1, 3, [0, 1], line=2)
    draft.feed(0, 0, 0, tick=1)
    draft.clock(1, 2, period=3, phase=1)
    draft.wire((0, 0), 1, 2, 15)
    draft.vote((1, 0), 0, first=1)
    return draft.netlist(taxels=1, polarities=1, classes=1, bin_ticks=2)


def test_the_schema_of_ranc():
    written = json.loads("\n".join(ranc.export(small(), np.array([[1, 0]], np.uint8))))
    sizes = {"num_neurons": 256, "num_axons": 256, "num_weights": 4, "num_cores_x": 2, "num_cores_y": 2}
    sizes |= {"max_tick_offset": 16, "neuron_reset_type": 0}
    assert {
        key: value for key, value in written.items() if key.startswith(("num", "max", "neuron_r"))
    } == sizes
    assert written["output_bus"] == {"coordinates": [1, 0], "num_outputs": 2}
    packet = {"destination_core": [1, 1], "destination_axon": 2, "destination_tick": 0}
    fed = {"destination_core": [0, 0], "destination_axon": 0, "destination_tick": 0}
    assert written["packets"] == [[], [fed, packet], [], [], [packet]]
    first, second = written["cores"]
    neuron = {"weights": [0, 4, 0, 0], "leak": 0, "positive_threshold": 3, "negative_threshold": -2}
    neuron |= {"reset_potential": 0, "reset_mode": 0, "current_potential": 0}
    neuron |= {"destination_core_offset": [1, 1], "destination_axon": 2, "destination_tick": 14}
    assert first == {"axons": [1], "connections": [[1]], "coordinates": [0, 0], "neurons": [neuron]}
    assert second["axons"] == [0, 0, 3]
    assert second["connections"] == [[0, 0, 1], [0, 0, 1]]
    voter, lost = second["neurons"]
    assert (voter["destination_core_offset"], voter["destination_axon"], voter["destination_tick"]) == (
        [0, -1],
        0,
        0,
    )
    assert (lost["destination_core_offset"], lost["destination_axon"]) == ([0, -1], 1)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"leak": -1, "leak_reversal": True}, "no leak with reversal (1 neurons)"),
        ({"leak": -1, "reset_mode": crossbar.RESET_NONE}, "1 neurons might reach theirs after 2 ticks"),
        (
            {"leak": -1, "reset_mode": crossbar.RESET_LINEAR, "negative_saturates": True},
            "1 neurons might reach theirs after 2",
        ),
    ],
)
def test_what_ranc_has_not(changes, what):
    with pytest.raises(ModelError, match=re.escape(what)):
        list(ranc.export(small(**changes), np.array([[1, 0]], np.uint8)))


def test_the_file_says_how_long_it_is_exact():
    kept = json.loads("\n".join(ranc.export(small(leak=-1, reset_mode=crossbar.RESET_NONE))))
    assert kept["exact_ticks"] == 2
    assert json.loads("\n".join(ranc.export(small())))["exact_ticks"] is None


@settings(max_examples=50)
@given(crossbars(IN_RANCS_TERMS), st.integers(0, 2**31))
def test_neurons_in_the_terms_of_ranc_spike_the_same(netlist, seed):
    recording = events(seed, 3, 20)
    try:
        terms = ranc.expressed(netlist, netlist.ticks(20))
    except ModelError:
        assume(False)
    assert not terms.netlist.negative_saturates.any()
    assert not (terms.netlist.reset_mode == crossbar.RESET_NONE).any()
    expected, found = spec.simulate(netlist, recording), spec.simulate(terms.netlist, recording)
    assert_array_equal(found.spikes, expected.spikes)
    assert_array_equal(found.membranes, expected.membranes * terms.scale + terms.shift)


def test_the_command_for_ranc(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draft = alone(Neuron(), channels=0)
    draft.feed(3, 0, 0)
    draft.vote((0, 0), 0, first=2)
    crossbar.write_crossbars(draft.netlist(taxels=2, polarities=2, classes=2), "net.loom")
    recordings = np.zeros((2, 2, 2, 5), np.uint8)
    recordings[0, 1, 1, [0, 4]] = recordings[1, 1, 1, [1, 4]] = 1
    recordings_folder(tmp_path / "data", train=recordings, test=recordings)
    words = ["export", "net.loom", "--to", "ranc", "-o", "net.json"]
    first, second = run(*words)[1].splitlines()
    assert json.loads(Path("net.json").read_text("utf-8"))["packets"] == [[]]
    assert "1 neurons on the chip and 1 synapses for ranc" in first
    assert second.startswith("run: ranc_sim net.json net.out net.json TICKS")
    for command in ("anytime", "explain --checkpoint x", "stress --checkpoint x"):
        name, *more = command.split()
        said = refusal(name, "net.loom", *more, "--data", "data")
        assert (
            said == f"net.loom: is for IBM TrueNorth, which {name} does not take; give one for another chip"
        )
    assert "this is for cores of compartments (--target loihi1)" in refusal(
        *words[:3], "nir", "-o", "net.nir"
    )
    costs = run("estimate", "net.loom", "--data", "data")[1]
    assert "static power of a chip: 42 mW (idle_0v70), 65 mW (typical_0v75)" in costs
    words += ["--data", "data", "--recording"]
    assert as_json(*words, "1")["ticks"] == 5 + 2 + 1
    packets = json.loads(Path("net.json").read_text("utf-8"))["packets"]
    assert [len(tick) for tick in packets] == [0, 1, 0, 0, 1, 0, 0]
    assert "--recording 2: --data has recordings 0 to 1" in refusal(*words, "2")


@pytest.fixture(scope="module")
def simulator():
    path = os.environ.get("RANC_SIM")
    if not path:
        pytest.skip("RANC's simulator is not named by RANC_SIM")
    return path


def outputs_of(text, voters):
    """Spikes of the voters, (ticks, voters), from RANC's output of a run of one tick more."""
    rows = [[word == "1" for word in line.split()] for line in text.splitlines() if line.strip()]
    assert {len(row) for row in rows} == {voters + 1}  # the last is the share of all others
    return np.array(rows[1:], np.bool_).reshape(-1, voters + 1)[:, :voters]


@settings(max_examples=60)
@given(crossbars(IN_RANCS_TERMS), st.integers(0, 2**31))
def test_ranc_spikes_the_same(simulator, tmp_path, netlist, seed):
    recording = events(seed, 3, 20)
    expected = spec.simulate(netlist, recording)
    voters = np.flatnonzero(netlist.readout_class >= 0)
    source, result = tmp_path / "in.json", tmp_path / "out.txt"
    try:
        source.write_text("\n".join(ranc.export(netlist, recording)), "utf-8")
    except ModelError:
        assume(False)
    ticks = str(int(expected.counts.ticks) + 1)
    done = subprocess.run(
        [simulator, source, result, source, ticks], capture_output=True, text=True, check=True
    )
    assert "ERROR" not in done.stdout
    assert_array_equal(outputs_of(result.read_text("utf-8"), len(voters)), expected.spikes[:, voters])
