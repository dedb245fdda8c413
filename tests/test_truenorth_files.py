"""Files and rules of crossbar cores: round trips, what is refused, the smallest network that breaks each rule."""

import json
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_crossbars import CHIP, crossbars, relays, with_limit
from random_networks import chain

from spikeloom.compiler import archive
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, history_free
from spikeloom.compiler.targets.truenorth.legalize import faults, needs
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


SOURCE = "core 0, neuron 0"


def made(draft: Draft, **changes):
    netlist = draft.netlist(taxels=1, polarities=1, classes=1)
    return replace(netlist, **{name: np.array([value]) for name, value in changes.items()})


def broken(netlist, chip=CHIP) -> list[tuple[str, str, str]]:
    """Owner, what was found, and the rule."""
    return [(fault.owner, fault.used, fault.rule.removeprefix("truenorth.")) for fault in faults(netlist, chip)]


def with_neuron(**changes) -> Draft:
    draft = relays()
    draft.cores[0].neurons[0] = (replace(Neuron(), **changes), 0, 0)
    return draft


@pytest.mark.parametrize(
    ("name", "low", "high", "found", "rule"),
    [
        ("leak", -256, 255, "leak", "leak_bits"),
        ("threshold", 0, 2**18 - 1, "threshold", "threshold_bits"),
        ("negative_threshold", 0, 2**18 - 1, "negative threshold", "threshold_bits"),
        ("mask_bits", 0, 18, "random bits", "mask_bits"),
        ("reset", -256, 255, "reset value", "reset_bits"),
        ("initial", -(2**19), 2**19 - 1, "initial membrane", "membrane_bits"),
        ("reset_mode", 0, 2, "reset mode", "reset_mode"),
        ("leak_reversal", 0, 1, "leak reversal", "leak_reversal"),
        ("negative_saturates", 0, 1, "saturation", "negative_saturates"),
        ("weights", -256, 255, "weight of type 1", "weight_bits"),
    ],
)
def test_parameters_and_their_registers(name, low, high, found, rule):
    for value in (low - 1, low, high, high + 1):
        expected = [] if low <= value <= high else [(SOURCE, f"{found} {value}", f"neuron.{rule}")]
        assert broken(made(with_neuron(**{name: (0, value) if name == "weights" else value}))) == expected


def more(change, times: int = 1):
    draft = relays()
    for _ in range(times):
        change(draft)
    return made(draft)


@pytest.mark.parametrize(
    ("netlist", "faults"),
    [
        (made(relays()), []),
        *((made(relays(), wire_delay=n), [(SOURCE, f"delay {n}", "neuron.delay")]) for n in (0, 16, -1)),
        (made(relays(), wire_x=64), [(SOURCE, "target at (64, 0)", "mesh")]),
        (made(relays(), wire_y=6), [(SOURCE, "target at (1, 6), where no core is", "target")]),
        (made(relays(), wire_line=7), [(SOURCE, "target line 7 of core 1, which has no axon there", "target")]),
        (more(lambda d: d.wire((0, 0), 1, d.axon(1))), [(SOURCE, "2 targets on one core", "neuron.targets")]),
        (
            more(lambda d: d.wire((0, 0), d.core(2, 0), d.axon(2))),
            [(SOURCE, "targets on 2 cores without a splitter", "neuron.targets")],
        ),
        (
            more(lambda d: d.wire((1, 0), 0, 0)),
            [("core 1, neuron 0", "votes and has a target on the chip", "neuron.targets")],
        ),
        (more(lambda d: d.axon(0, 2, line=0)), [("core 0, axon 0", "types 0 and 2", "core.axon_types")]),
        (more(lambda d: d.axon(0, 0, line=0)), [("core 0, axon 0", "there twice", "core.axons")]),
        *((more(lambda d, n=n: d.axon(0, n)), [("core 0, axon 1", f"type {n}", "core.axon_types")]) for n in (4, -1)),
        (
            more(lambda d: d.axon(0), 256),
            [("core 0", "257 axons", "core.axons"), ("core 0, axon 256", "line 256", "core.axons")],
        ),
        (more(lambda d: d.core(0, 0)), [("core 2", "at (0, 0) as core 0", "mesh")]),
        (
            more(lambda d: d.core(len(d.cores) % 64, len(d.cores) // 64), 4095),
            [("core 4096", "at (0, 64)", "mesh"), ("chip", "4097 cores", "chip.cores")],
        ),
        (more(lambda d: d.clock(0, 0, period=0)), [("clock 0", "a period of 0 ticks", "clock")]),
        (more(lambda d: d.clock(1, 9, period=1)), [("clock 0", "line 9 of core 1", "target")]),
        (more(lambda d: d.feed(0, 0, 3)), [("input channel 0", "line 3 of core 0", "target")]),
        (more(lambda d: d.feed(0, 0, 0, tick=-1)), [("input channel 0", "tick -1 of a data step", "feed")]),
        (
            more(lambda d: d.neuron(0, Neuron(leak=300)), 3),
            [("core 0, neuron 1 (and 2 more on this core)", "leak 300", "neuron.leak_bits")],
        ),
    ],
)
def test_rules(netlist, faults):
    assert broken(netlist) == faults


def test_limits_are_parameters():
    assert broken(made(relays()), with_limit("mesh.reach", 0)) == [(SOURCE, "1 cores away", "mesh.reach")]
    assert broken(made(with_neuron(leak=2047)), with_limit("neuron.leak_bits", 12)) == []


# -- needs of float networks -------------------------------------------------------------------------------------------
def wide(inputs: int, *sizes: int, beta=0.0):
    """A chain of full layers of equal weights."""
    return chain(*(np.ones((after, before)) for before, after in pairwise((inputs, *sizes))), beta=beta)


def needed(network) -> list[tuple[str, str]]:
    return [(need.used, need.rule.removeprefix("truenorth.")) for need in needs(network, CHIP)]


def test_every_need_of_every_layer():
    rng = np.random.default_rng(0)
    network = chain(rng.normal(size=(5, 300)), rng.normal(size=(3, 5)), beta=0.2)
    assert needed(network) == [
        ("keep 0.2 of their membranes a step", "neuron.leak"),
        ("300 inputs", "core.axons"),
        ("300 different weights", "neuron.weight_bits"),
        ("send spikes to 2 axons at least", "neuron.targets"),
        ("keep 0.2 of their membranes a step", "neuron.leak"),
    ]
    worst = needs(network, CHIP)[2]
    assert (worst.owner, worst.allowed) == ("fc1, neuron 0 (and 4 more)", "1 with 1 axon an input")


@pytest.mark.parametrize(
    ("network", "found"),
    [
        (wide(256, 3), []),
        (wide(257, 3), [("257 inputs", "core.axons")]),
        (wide(2, 2, 256), [("send spikes to 2 axons at least", "neuron.targets")]),
        (wide(2, 2, 257), [("send spikes to 4 axons at least", "neuron.targets")]),
    ],
)
def test_limits_of_inputs_and_targets(network, found):
    assert needed(network) == found


@pytest.mark.parametrize(
    ("inputs", "distinct", "over"),
    [(64, 15, False), (64, 16, True), (85, 7, False), (86, 7, True), (128, 3, False), (129, 1, False), (129, 2, True)],
)
def test_the_limit_of_levels_follows_the_axons_that_are_left(inputs, distinct, over):
    weight = np.resize(np.arange(1, distinct + 1), inputs)[None].astype(float)
    assert needed(chain(weight, beta=0.0)) == [(f"{distinct} different weights", "neuron.weight_bits")] * over


def test_zeros_are_no_level_and_the_worst_neuron_is_named():
    weight = np.zeros((3, 129))
    weight[0, :2], weight[2, :5] = 1, [1, 2, 3, 0, 4]
    (need,) = needs(chain(weight, beta=0.0), CHIP)
    assert (need.owner, need.used) == ("fc1, neuron 2", "4 different weights")


def test_a_lasting_current():
    network = wide(4, 2)
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.5),))
    assert needed(lasting) == [("keep 0.5 of their currents a step", "neuron.leak")]
