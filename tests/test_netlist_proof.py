"""Level EN: a netlist is what its checkpoint is lowered to, and every small damage that a file can hold has a name."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from commands import as_json, run
from made_files import csv_folder, events, own_file, state_dict, weights
from random_networks import random_checkpoint, ring
from test_truenorth_counting import random_counters
from timed_networks import events_of, written

from spikeloom.compiler import Options, Packing, compile_network, read_netlist, write_netlist
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.counters import write_counters
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.truenorth.netlist import read_crossbars, write_crossbars
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.machines.integer import integer_machine


def put(netlist, field, place, value):
    values = getattr(netlist, field).copy()
    values[place] = value
    return dataclasses.replace(netlist, **{field: values})


def added(field, place=0, by=1):
    return lambda net: put(net, field, place, getattr(net, field)[place] + by)


def exchanged(field, find):
    def damage(net):
        pair = find(net)
        return put(net, field, pair, getattr(net, field)[pair[::-1]])

    return damage


def of_layer(layer):
    return lambda net: net.compartments_of(layer)[:2]


def unlike_targets(net):
    """Two synapses of one list of several, with weights that differ."""
    starts = net.axon_synapses[:-1][np.diff(net.axon_synapses) > 1]
    first = next(s for s in starts if abs(int(net.synapse_weight[s]) - int(net.synapse_weight[s + 1])) > 40)
    return np.array([first, first + 1])


def largest(net):
    return int(np.argmax(np.abs(net.synapse_weight)))


def smallest(net):
    return int(np.argmin(np.where(net.synapse_weight == 0, 999, np.abs(net.synapse_weight))))


def without_axon(net):
    axon, ends = 3, net.axon_synapses
    gone = slice(ends[axon], ends[axon + 1])
    fields = {name: np.delete(getattr(net, name), gone) for name in ("synapse_target", "synapse_weight")}
    fields |= {name: np.delete(getattr(net, name), axon) for name in ("axon_source", "axon_format")}
    fields["axon_synapses"] = np.concatenate([ends[: axon + 1], ends[axon + 2 :] - (gone.stop - gone.start)])
    return dataclasses.replace(net, **fields, core_axons=net.core_axons - (net.core_axons > axon))


def layer_with(**changes):
    return lambda net: dataclasses.replace(net, layers=(dataclasses.replace(net.layers[0], **changes), *net.layers[1:]))


WEIGHTS = "weights (that are not the nearest,|than the compiler chose.*;) the farthest, from .* to neuron"
DAMAGES = {
    "sign": (lambda net: put(net, "synapse_weight", largest(net), -net.synapse_weight[largest(net)]), WEIGHTS),
    "sign of the least": (
        lambda net: put(net, "synapse_weight", smallest(net), -net.synapse_weight[smallest(net)]),
        WEIGHTS,
    ),
    "a step": (lambda net: added("synapse_weight", smallest(net), 2)(net), WEIGHTS),
    "axon dropped": (without_axon, WEIGHTS),
    "axon of another source": (exchanged("axon_source", lambda _: np.array([0, 1])), WEIGHTS),
    "targets": (exchanged("synapse_target", unlike_targets), WEIGHTS),
    "exponent": (added("format_exponent"), "limit|weights"),
    "threshold": (added("threshold"), r"conv1 neuron 0 has threshold (\d+) instead of \d+$"),
    "decay of a layer": (
        lambda net: added("decay_v", net.compartments_of(2))(net),
        "fc2 has decay registers 4095 and 3278 instead of 4095 and 3277",
    ),
    "decay of a neuron": (added("decay_u", by=-1), "layer conv1: has 2 values of decay_u"),
    "bias zeroed": (lambda net: put(net, "bias_mantissa", net.compartments_of(1)[0], 0), "fc1 has .*biases"),
    "neurons": (exchanged("neuron", of_layer(1)), WEIGHTS),
    "votes": (exchanged("readout_class", of_layer(3)), "fc3 has 2 of 4 neurons that vote for another class"),
    "window": (layer_with(depth=1), "conv1 has a window from step 1 instead of 0"),
    "theta": (layer_with(theta=0.6), "conv1 has theta 0.6 instead of 0.5"),
    "limit": (added("threshold", np.arange(9), np.arange(9)), "12 used, 8 allowed .loihi1.core.threshold_slots"),
}


@pytest.fixture(scope="module")
def netlists(place):
    """Of a small network; rounded to the nearest, and on recordings."""
    for name, words in (("nearest", []), ("calibrated", ["--calibrate", place / "data"])):
        assert run("compile", place / "net.pt", *words, "-o", place / f"{name}.loom")[0] == 0
    return {name: read_netlist(place / f"{name}.loom") for name in ("nearest", "calibrated")}


@pytest.mark.parametrize("rounded", ["nearest", "calibrated"])
@pytest.mark.parametrize("name", DAMAGES)
def test_verify_names_every_damage_and_fails(place, netlists, tmp_path, name, rounded):
    (damage, named), netlist = DAMAGES[name], netlists[rounded]
    assert bool(netlist.provenance["compensated"]) == (rounded == "calibrated")
    write_netlist(damage(netlist), tmp_path / "x.loom")
    words = ("--checkpoint", place / "net.pt", *(["--data", place / "data"] if name == "sign of the least" else []))
    code, out, _ = run("verify", tmp_path / "x.loom", *words)
    assert code == 1
    assert re.search(f"EN  NOT the rounding of this checkpoint: .*({named})", out, re.MULTILINE)
    assert run("verify", place / f"{rounded}.loom", *words)[0] == 0


def random_network(kind, seed, folder):
    if kind == "timed":  # clocks and lasting currents
        seen = written(folder / "net.pt", seed=seed)[1]
        return expand(read_checkpoint(folder / "net.pt"), seen), events_of(seed)
    checkpoint = random_checkpoint(taxels=6, features=4, sizes=(9, 8, 4), seed=seed)
    return expand(checkpoint, ring(6)), events(seed, samples=40)


MADE = {
    "4 bits": {"packings": (Packing(bits=4),), "keep_all": True},
    "pruned": {"packings": (Packing(bits=4, planes=2),), "prune_unused": True},
    "groups": {"packings": (Packing(planes=2, groups=4),)},
    "spike-exact": {"spike_exact": True},
    "cores": {"chips": 2, "cores_for": {"fc1": 2}},
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["graph", "timed"])
@pytest.mark.parametrize("name", MADE)
def test_whatever_the_compiler_makes_passes(tmp_path, kind, name, seed):
    network, training = random_network(kind, seed, tmp_path)
    recorded = {"prune_unused": name == "pruned"}
    for chosen in (training, *([None] if name in ("4 bits", "groups", "cores") else [])):
        netlist = compile_network(network, Options(**MADE[name], provenance=recorded, training_events=chosen)).netlist
        found = check_rounding(integer_machine(machine_of(netlist)), network)
        assert found.holds, found.text


CROSSBAR_DAMAGES = {
    "threshold": (added("threshold", 2), r"threshold\[2\] of \w+ neuron \d+ is .* instead of"),
    "weight": (added("weight", (1, 0)), r"weight\[1, 0\] of"),
    "leak": (added("leak", 0), r"leak\[0\] of votes neuron 0"),
    "phase": (added("initial", 0), r"initial\[0\] of votes"),
    "feeds": (exchanged("feed_channel", lambda _: np.array([0, 1])), r"feed_channel\[0\] is .*, and 1 more"),
    "votes": (exchanged("readout_class", lambda _: np.array([0, 1])), r"readout_class\[0\]"),
    "delay": (added("wire_delay", 0), r"wire_delay\[0\] is 2 instead of 1"),
    "bins": (lambda net: dataclasses.replace(net, bins=2), "bins is 2 instead of 1"),
}


def test_every_damage_to_a_crossbar_has_a_name(tmp_path):
    source, path, words = tmp_path / "c.pt", tmp_path / "x.loom", ("--checkpoint", tmp_path / "c.pt")
    write_counters(source, random_counters(3))
    assert run("compile", source, "--target", "truenorth", "-o", path)[0] == 0
    assert as_json("verify", path, *words) == {"faults": [], "holds": True}
    netlist = read_crossbars(path)
    for damage, named in CROSSBAR_DAMAGES.values():
        write_crossbars(damage(netlist), path)
        code, out, _ = run("verify", path, *words)
        assert code == 1
        assert re.search(f"EN NOT what the network of the file is lowered to: {named}", out)


# -- what need not be said again ---------------------------------------------------------------------------------------
def test_a_netlist_remembers_bins_and_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for split in ("train", "test"):
        csv_folder(tmp_path / "taps" / split, samples=24)
    words = ("--system", "counters", "--weight-bits", "4", "--data", "taps", "--bin", "0.1")
    assert run("train", *words, "-o", "c.pt")[0] == 0
    own_file(tmp_path / "net.pt", training={"data": "taps", "bin_s": 0.1})
    for words in (["c.pt"], ["c.pt", "--target", "truenorth"], ["net.pt", "--calibrate", "taps"]):
        made = as_json("compile", *words, "-o", "x.loom")
        assert {name: made["provenance"][name] for name in ("data", "bin_s")} == {"data": "taps", "bin_s": 0.1}
        assert run("run", "x.loom", "--data", "taps") == run("run", "x.loom", "--data", "taps", "--bin", "0.1")
    assert run("estimate", "x.loom", "--data", "taps")[1].startswith("per inference of 13 chip steps")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (
            "compile net.pt -o x.loom --calibrate few",
            "few: the network was trained on taps; calibrate on what it knows",
        ),
        ("run net.loom --data few", "few: the network was trained on taps; their classes are 0..1, the network's 0..3"),
        (
            "run net.loom --data four",
            "four: has events of taxels 0..3 only, the network has 6; are they of its sensor?",
        ),
    ],
)
def test_recordings_that_look_like_others_are_warned_of(tmp_path, monkeypatch, words, why):
    monkeypatch.chdir(tmp_path)
    csv_folder(tmp_path / "few", classes=2 if words.startswith("run") else 4)
    csv_folder(tmp_path / "four", taxels=4)
    own_file(tmp_path / "net.pt", training={"data": "taps"})
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    code, _, err = run(*words.split())
    assert (code, err.count(f"spikeloom: warning: {why}")) == (0, 1)


def test_graph_time_step_and_names_are_the_netlists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(state_dict(weights(taxels=39)), "bare.pt")
    assert run("compile", "bare.pt", "--graph", "knn:1", "-o", "net.loom")[0] == 0
    assert run("verify", "net.loom", "--checkpoint", "bare.pt")[0] == 0
    assert run("export", "net.loom", "--to", "nir", "-o", "net.nir")[0] == 0
    assert run("compile", "net.nir", "--dt", "0.01", "-o", "back.loom")[0] == 0
    netlist = read_netlist("back.loom")
    layers = tuple(dataclasses.replace(layer, name=f"l{k}") for k, layer in enumerate(netlist.layers))
    digests = dict(zip((layer.name for layer in layers), netlist.provenance["digests"].values(), strict=True))
    netlist = dataclasses.replace(netlist, layers=layers, provenance={**netlist.provenance, "digests": digests})
    write_netlist(netlist, "named.loom")
    assert run("verify", "named.loom", "--checkpoint", "net.nir")[0] == 0
    assert run("verify", "named.loom", "--checkpoint", "net.nir", "--dt", "0.02")[0] == 1
