"""Files of crossbar cores: round trip, what is refused, and the commands that take them."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_crossbars import CHIP, crossbars

from spikeloom.compiler import archive
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.targets.truenorth.builder import Draft, history_free
from spikeloom.compiler.targets.truenorth.legalize import faults
from spikeloom.compiler.targets.truenorth.netlist import (
    FILE,
    CrossbarNetlist,
    crossbar_bytes,
    inconsistencies,
    read_crossbars,
    write_crossbars,
)
from spikeloom.runtime import cli
from spikeloom.runtime.machines.truenorth import engine

ARRAYS = FILE.arrays


def network() -> CrossbarNetlist:
    """Two of three taxels; a neuron each receives one and votes for its own class."""
    draft = Draft()
    core = draft.core(3, 4)
    for taxel in range(2):
        draft.axon(core, taxel, [draft.neuron(core, history_free((1, 1, 0, 0), 1), layer="out", number=taxel)])
        for polarity in range(2):
            draft.feed(2 * taxel + polarity, core, taxel)
        draft.vote((core, taxel), taxel)
    return draft.netlist(taxels=3, polarities=2, classes=2, provenance={"made": "by hand"})


@pytest.fixture
def path(tmp_path):
    write_crossbars(network(), tmp_path / "net.loom")
    return tmp_path / "net.loom"


@settings(max_examples=15, deadline=None)
@given(crossbars())
def test_round_trip(tmp_path_factory, netlist):
    path = tmp_path_factory.mktemp("crossbars") / "x.loom"
    write_crossbars(netlist, path)
    again = read_crossbars(path)
    assert crossbar_bytes(again) == crossbar_bytes(netlist) == path.read_bytes()
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(netlist, name), name)
    assert inconsistencies(again) == []


def test_numpy_alone_reads_it_and_a_reader_of_other_files_names_it(path):
    with np.load(path) as members:
        manifest = json.loads(str(members["manifest"]))
        assert (manifest["format"], manifest["provenance"]) == (FILE.format, {"made": "by hand"})
        assert members["weight"].tolist() == [[1, 1, 0, 0]] * 2
    assert is_netlist(path)
    with pytest.raises(FormatError, match=r"holds crossbar cores \(TrueNorth\), this is for .* \(Loihi\)"):
        read_netlist(path)


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
        ({"manifest": {"clocks": {"channels": 0}}}, "the manifest has no usable clocks"),
        ({"manifest": {"target": "loihi1"}}, "is for 'loihi1', this program knows truenorth"),
        ({"manifest": {"version": 2}}, "has format version 2, this program reads 1"),
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
    path.write_bytes(archive.archive_bytes(manifest, {name: changes.get(name, members[name]) for name in ARRAYS}))
    with pytest.raises(FormatError, match=f"{re.escape(line)}; (compile it again|update spikeloom)"):
        read_crossbars(path)


@settings(max_examples=30, deadline=None)
@given(crossbars(), st.sampled_from(ARRAYS), st.randoms(use_true_random=False))
def test_any_numbers_are_refused_or_run(tmp_path_factory, netlist, name, random):
    array = np.array(getattr(netlist, name))
    if array.size:
        array.flat[random.randrange(array.size)] = random.choice(
            [-(2**31), -300, -2, -1, 0, 1, 2, 5, 20, 300, 2**31 - 1]
        )
    path = tmp_path_factory.mktemp("any") / "x.loom"
    write_crossbars(replace(netlist, **{name: array}), path)
    try:
        found = read_crossbars(path)
    except FormatError:
        return
    if not faults(found, CHIP):
        assert found.drain < 2**20
        engine.simulate(replace(found, readout_first=np.minimum(found.readout_first, 9)), np.ones((1, 3, 4), np.uint8))


# -- commands ----------------------------------------------------------------------------------------------------------
@pytest.fixture
def place(path, tmp_path):
    """A folder with the network and four recordings of its sensor: touches of taxel 0, 1, 1 and 2."""
    recordings = np.zeros((4, 3, 2, 6), np.uint8)
    for sample, (taxel, touches) in enumerate([(0, 2), (1, 3), (1, 1), (2, 4)]):
        recordings[sample, taxel, 0, :touches] = 1
        recordings[sample, taxel, 1, 0] = 1  # the same axon in the same tick
    for split in ("train", "test"):
        (tmp_path / "data" / split).mkdir(parents=True)
        for sample, label in enumerate([0, 1, 0, 1]):
            np.save(tmp_path / "data" / split / f"sample_{sample}_label_{label}.npy", recordings[sample])
    return tmp_path


@pytest.fixture
def command(place, capsys):
    """Run a command on a netlist, with recordings where it takes them; its JSON object, or its error."""

    def run(words: str, code: int = 0):
        name, *options = words.split()
        data = [] if name == "inspect" else ["--data", f"{place}/data"]
        assert cli.main([name, f"{place}/net.loom", *data, *options, "--json"]) == code
        out, err = capsys.readouterr()
        return err if code else json.loads(out)

    return run


def test_run(place, command):
    report = command(f"run --spikes {place}/s.npz --detail counts")
    assert report["predictions"] == [0, 1, 1, 0]
    assert report["counts"] == [[2, 0], [0, 3], [0, 1], [0, 0]]
    assert report["accuracy"] == 0.5
    assert report["costs"]["per_inference"]["spikes"] == 1.5
    with np.load(place / "s.npz") as spikes:
        assert spikes["out"].shape == (4, 6, 2)
        assert spikes["out"].sum(axis=1).tolist() == report["counts"]


def test_estimate(place, command, capsys):
    report = command("estimate")
    # every arrival meets one crossing point: 2, 3, 1 and 0 of them, and one of two polarities is merged in each
    found = {name: report["per_inference"][name] for name in ("synaptic_events", "spikes", "merged_spikes", "ticks")}
    assert found == {"synaptic_events": 1.5, "spikes": 1.5, "merged_spikes": 0.75, "ticks": 6}
    assert report["per_inference"]["time_s"] == pytest.approx(6e-3)
    all_in, marginal = report["energy"]
    assert (all_in["table"], all_in["floor_j"]) == ("all_in", None)
    assert all_in["total_j"] == pytest.approx(1.5 * 26e-12)
    assert marginal["floor_j"] == pytest.approx(0.0644 * 6e-3)
    assert marginal["floor_of_used_cores_j"] == pytest.approx(0.0644 * 6e-3 / 4096)
    assert marginal["total_j"] == pytest.approx(0.0644 * 6e-3 + 1.5 * 2.3e-12)
    assert report["pace"]["real_time"] is True
    assert cli.main(["estimate", f"{place}/net.loom", "--data", f"{place}/data"]) == 0
    out = capsys.readouterr().out
    assert "per inference on 1 of 4,096 cores, over 4 recordings:" in out
    assert "a data step takes 1 ms: keeps the sensor's pace of 20 ms a step" in out


@pytest.mark.parametrize("name", ["inspect", "run", "estimate"])
def test_every_broken_rule_is_named(place, command, name):
    zero = dict.fromkeys(("clock_core", "clock_line", "clock_period", "clock_phase"), read_only([0]))
    write_crossbars(replace(network(), leak=read_only([300, 0]), **zero), place / "net.loom")
    leak, clock = command(name, code=2).splitlines()
    assert "core 0, neuron 0: leak 300, -256 … 255 allowed (truenorth.neuron.leak_bits)" in leak
    assert "clock 0: a period of 0 ticks, 1 or more allowed (truenorth.clock)" in clock
