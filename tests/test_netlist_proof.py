"""Level EN: a netlist is what its checkpoint is lowered to, and every small damage that a file can hold has a name."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from commands import as_json, refusal, run
from hypothesis import given, settings
from hypothesis import strategies as st
from made_files import TAXELS, csv_folder, events, own_file, small_checkpoint, state_dict, weights
from random_crossbars import random_counters
from random_networks import chain, random_checkpoint, ring
from timed_networks import events_of, written

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.counters import write_counters
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Exact, Fixed, Packing
from spikeloom.compiler.targets.loihi1.netlist import read_netlist, write_netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.truenorth.netlist import read_crossbars, write_crossbars
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.machines.backends import machine_of


def changed(field, place, to):
    """Damage: other values of a field at a place, which may be found in the netlist."""

    def damage(netlist):
        values, at = getattr(netlist, field).copy(), place(netlist) if callable(place) else place
        values[at] = to(values[at])
        return dataclasses.replace(netlist, **{field: read_only(values)})

    return damage


def plus(by):
    return lambda values: values + by


def of_layer(layer, part=slice(None)):
    return lambda net: net.compartments_of(layer)[part]


def unlike_targets(net):
    """Two synapses of one list of several, with weights that differ."""
    starts = net.axon_synapses[:-1][np.diff(net.axon_synapses) > 1]
    first = next(s for s in starts if abs(int(net.synapse_weight[s]) - int(net.synapse_weight[s + 1])) > 40)
    return np.array([first, first + 1])


def largest(net):
    return int(np.argmax(np.abs(net.synapse_weight)))


def smallest(net):
    return int(np.argmin(np.where(net.synapse_weight == 0, 999, np.abs(net.synapse_weight))))


def from_layer(layer):
    """First synapse of the axons of a layer."""
    return lambda net: np.flatnonzero(
        np.isin(net.axon_source[net.axon_of_synapse()] - net.n_inputs, net.compartments_of(layer))
    )[:1]


def without_axon(net):
    axon, ends = 3, net.axon_synapses
    gone = slice(ends[axon], ends[axon + 1])
    fields = {name: np.delete(getattr(net, name), gone) for name in ("synapse_target", "synapse_weight")}
    fields |= {name: np.delete(getattr(net, name), axon) for name in ("axon_source", "axon_format")}
    fields["axon_synapses"] = np.concatenate([ends[: axon + 1], ends[axon + 2 :] - (gone.stop - gone.start)])
    return dataclasses.replace(net, **fields, core_axons=net.core_axons - (net.core_axons > axon))


def layer_with(**changes):
    return lambda net: dataclasses.replace(
        net, layers=(dataclasses.replace(net.layers[0], **changes), *net.layers[1:])
    )


WEIGHTS = "weights (that are not the nearest,|than the compiler chose.*;) the farthest, from .* to neuron"
BIASES = "fc1 has .*biases"
FIRST, PAIR = slice(1), slice(2)
DAMAGES = {
    "sign": (changed("synapse_weight", largest, np.negative), WEIGHTS),
    "sign of the least": (changed("synapse_weight", smallest, np.negative), WEIGHTS),
    "a step": (changed("synapse_weight", smallest, plus(2)), WEIGHTS),
    "axon dropped": (without_axon, WEIGHTS),
    "axon of another source": (changed("axon_source", PAIR, np.flip), WEIGHTS),
    "targets": (changed("synapse_target", unlike_targets, np.flip), WEIGHTS),
    "a loop": (
        changed("synapse_target", from_layer(2), np.zeros_like),
        "layer conv1: has synapses of layer fc2, which comes after it",
    ),
    "exponent": (changed("format_exponent", 0, plus(1)), WEIGHTS),
    "threshold": (changed("threshold", 0, plus(1)), r"conv1 neuron 0 has threshold (\d+) instead of \d+$"),
    "decay of a layer": (
        changed("decay_v", of_layer(2), plus(1)),
        "fc2 has decay registers 4095 and 3278 instead of 4095 and 3277",
    ),
    "decay of a neuron": (changed("decay_u", 0, plus(-1)), "layer conv1: has 2 values of decay_u"),
    "bias zeroed": (changed("bias_mantissa", of_layer(1, FIRST), np.zeros_like), BIASES),
    "bias at its end": (changed("bias_exponent", of_layer(1, FIRST), lambda _: 7), f"{BIASES} that are not"),
    "neurons": (changed("neuron", of_layer(1, PAIR), np.flip), WEIGHTS),
    "votes": (
        changed("readout_class", of_layer(3, PAIR), np.flip),
        "fc3 has 2 of 4 neurons that vote for another",
    ),
    "classes": (lambda netlist: dataclasses.replace(netlist, classes=5), "it has 5 classes, the network 4"),
    "window": (layer_with(depth=1), "conv1 has a window from step 1 instead of 0"),
    "theta": (layer_with(theta=0.6), "conv1 has theta 0.6 instead of 0.5"),
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
    recordings = ["--data", place / "data", "--min-agreement", "0"] if name == "sign of the least" else []
    words = ("--checkpoint", place / "net.pt", *recordings)
    code, out, _ = run("verify", tmp_path / "x.loom", *words)
    assert code == 1
    assert re.search(f"^EN  NOT what this network is lowered to: .*({named})", out, re.MULTILINE)
    assert ("\nmissed: EN: NOT what" in out) == bool(recordings)
    assert run("verify", place / f"{rounded}.loom", *words)[0] == 0


@pytest.mark.parametrize("rounded", ["nearest", "calibrated"])
def test_a_netlist_beyond_a_limit_is_refused(place, netlists, tmp_path, rounded):
    damage = changed("threshold", slice(9), plus(np.arange(9)))
    write_netlist(damage(netlists[rounded]), tmp_path / "x.loom")
    line = "12 used, 8 allowed (loihi1.core.threshold_slots)"
    for words in (
        ("verify", tmp_path / "x.loom", "--checkpoint", place / "net.pt"),
        ("inspect", tmp_path / "x.loom"),
    ):
        assert line in refusal(*words)


def random_network(kind, seed, folder):
    if kind == "timed":  # clocks and lasting currents
        seen = written(folder / "net.pt", seed=seed)[1]
        return expand(read_checkpoint(folder / "net.pt"), seen), events_of(seed)
    checkpoint = random_checkpoint(taxels=6, features=4, sizes=(9, 8, 4), seed=seed)
    return expand(checkpoint, ring(6)), events(seed, samples=40)


def checked(netlist, network, **provenance):
    netlist = dataclasses.replace(netlist, provenance=netlist.provenance | provenance)
    return machine_of(netlist).check_lowering(network)


MADE = {
    "4 bits": {"storage": Fixed((Packing(bits=4),)), "keep_all": True},
    "3 planes": {"storage": Fixed((Packing(bits=3, planes=3),))},
    "groups": {"storage": Fixed((Packing(planes=2, groups=4),))},
    "8 groups": {"storage": Fixed((Packing(groups=8),))},
    "2 planes": {"storage": Fixed((Packing(planes=2),)), "keep_all": True},
    "pruned": {"storage": Fixed((Packing(bits=4, planes=2),)), "prune_unused": True},
    "spike-exact": {"storage": Exact()},
    "cores": {"chips": 2, "cores_for": {"fc1": 2}},
}
"""What options make; if they need no recordings, without them, too."""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["graph", "timed"])
@pytest.mark.parametrize("name", MADE)
def test_whatever_the_compiler_makes_passes(tmp_path, kind, name, seed):
    network, training = random_network(kind, seed, tmp_path)
    recorded = {"prune_unused": name == "pruned"}
    for chosen in (training, *([] if name in ("pruned", "spike-exact") else [None])):
        netlist = compile_network(
            network, Options(**MADE[name], provenance=recorded, training_events=chosen)
        ).netlist
        found = checked(netlist, network)
        assert found.holds, found.text
        moved = [layer for layer, each in found.layers.items() if each.nearest < each.weights]
        assert moved == [layer for layer, each in found.layers.items() if each.compensated]
        assert all(f"{layer} " in found.text for layer in moved)
        alone = checked(netlist, network, compensated=[]).holds
        assert alone == (not moved) or (name == "pruned" and not moved)  # only biases
        if chosen is None:
            assert found.text.endswith(
                "weight, bias, threshold and decay is the checkpoint's, rounded to the nearest"
            )
            assert all(0 < each.nearest == each.weights for each in found.layers.values())
            assert all(
                0 < each.farthest_steps <= 0.5 + 1e-9 or "planes" in name for each in found.layers.values()
            )


def test_weights_that_the_range_cuts_off_are_at_its_end():
    network = chain([[1.0, 0.3, -0.2]])
    netlist = compile_network(network, Options()).netlist
    clipped = chain([[1000.0, 0.3, -0.2]])  # at the same scale
    assert checked(netlist, network).holds
    assert checked(netlist, clipped).holds == (np.abs(netlist.synapse_weight).max() == 254)


@pytest.fixture(scope="module", params=[2, 8])
def rounded(request, tmp_path_factory):
    network = expand(*small_checkpoint(tmp_path_factory.mktemp("small")))
    netlist = compile_network(network, Options(storage=Fixed((Packing(bits=request.param),)))).netlist
    assert checked(netlist, network).holds
    return netlist, network


@settings(max_examples=60)
@given(st.data())
def test_every_single_change_is_found(rounded, data):
    netlist, network = rounded
    field = data.draw(
        st.sampled_from(["synapse_weight", "bias_mantissa", "threshold", "decay_v", "decay_u"])
    )
    values = getattr(netlist, field)
    if field.startswith("decay"):
        place = netlist.compartments_of(data.draw(st.integers(0, len(netlist.layers) - 1)))
        by = -1 if values[place[0]] == 4095 else data.draw(st.sampled_from([-1, 1]))
    else:
        place = data.draw(st.integers(0, len(values) - 1))
        step = 512 >> netlist.layers[0].weight_bits if field == "synapse_weight" else 1
        by = step * (-1 if values[place] > 0 else 1)
    assert not checked(changed(field, place, plus(by))(netlist), network).holds


@pytest.mark.parametrize("calibrated", [False, True])
def test_another_checkpoint_graph_or_neuron_model(tmp_path, calibrated):
    checkpoint, adjacency = small_checkpoint(tmp_path)
    training = events(1, samples=40) if calibrated else None
    netlist = compile_network(expand(checkpoint, adjacency), Options(training_events=training)).netlist
    other, _ = small_checkpoint(tmp_path, last=weights(9))
    edges = np.array([[0, 2], [2, 0], [1, 3], [3, 1], [4, 5], [5, 4]])
    for network in (
        expand(other, adjacency),
        expand(checkpoint, normalised_adjacency(edges, TAXELS)),
        expand(dataclasses.replace(checkpoint, beta=0.3), adjacency),
        expand(dataclasses.replace(checkpoint, theta=0.4), adjacency),
    ):
        assert not checked(netlist, network).holds


CROSSBAR_DAMAGES = {
    "threshold": (changed("threshold", 2, plus(1)), r"threshold\[2\] of \w+ neuron \d+ is .* instead of"),
    "weight": (changed("weight", (1, 0), plus(1)), r"weight\[1, 0\] of"),
    "leak": (changed("leak", 0, plus(1)), r"leak\[0\] of votes neuron 0"),
    "phase": (changed("initial", 0, plus(1)), r"initial\[0\] of votes"),
    "feeds": (changed("feed_channel", PAIR, np.flip), r"feed_channel\[0\] is .*, and 1 more"),
    "votes": (changed("readout_class", PAIR, np.flip), r"readout_class\[0\]"),
    "delay": (changed("wire_delay", 0, plus(1)), r"wire_delay\[0\] is 2 instead of 1"),
    "bins": (lambda net: dataclasses.replace(net, bins=2), "bins is 2 instead of 1"),
}


def test_every_damage_to_a_crossbar_has_a_name(tmp_path):
    source, path, words = tmp_path / "c.pt", tmp_path / "x.loom", ("--checkpoint", tmp_path / "c.pt")
    write_counters(source, random_counters(3))
    assert run("compile", source, "--target", "truenorth", "-o", path)[0] == 0
    assert as_json("verify", path, *words) == {"layers": {}, "whole": [], "holds": True}
    netlist = read_crossbars(path)
    for damage, named in CROSSBAR_DAMAGES.values():
        write_crossbars(damage(netlist), path)
        code, out, _ = run("verify", path, *words)
        assert code == 1
        assert re.search(f"EN  NOT what this network is lowered to: {named}", out)


def test_a_netlist_remembers_bins_and_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for split in ("train", "test"):
        csv_folder(tmp_path / "taps" / split, samples=24)
    words = ("--system", "counters", "--weight-bits", "4", "--data", "taps", "--bin", "0.1")
    assert run("train", *words, "-o", "c.pt")[0] == 0
    own_file(tmp_path / "net.pt", training={"data": "taps", "bin_s": 0.1})
    for words in (["c.pt"], ["c.pt", "--target", "truenorth"], ["net.pt", "--calibrate", "taps"]):
        made = as_json("compile", *words, "-o", "x.loom")
        assert {name: made["provenance"][name] for name in ("data", "bin_s")} == {
            "data": "taps",
            "bin_s": 0.1,
        }
        assert run("run", "x.loom", "--data", "taps") == run(
            "run", "x.loom", "--data", "taps", "--bin", "0.1"
        )
    assert run("estimate", "x.loom", "--data", "taps")[1].startswith("per inference of 13 chip steps")
    # the same, whichever command reads them and whoever made the bins
    tap = "taps/test/tap_0_label_0.csv"
    *_, grasp, _ = map(json.loads, run("watch", "x.loom", "--input", tap, "--json")[1].splitlines())
    assert [grasp["counts"]] == as_json("run", "x.loom", "--data", tap)["counts"]
    said = "--bin 0.02: the network was trained on bins of 0.1 s; omit --bin"
    for words in ("run x.loom --data taps", "lean net.pt --data taps", f"watch x.loom --input {tap}"):
        assert said in run(*words.split(), "--bin", "0.02")[2]
    for width, code in (("0.1", 0), ("0.05", 0), ("0.04", 2)):  # two bins of 0.05 s are joined
        assert run("data", "convert", "taps", "--bin", width, "-o", f"binned{width}")[0] == 0
        assert run("run", "x.loom", "--data", f"binned{width}")[0] == code
        assert as_json("data", "describe", f"binned{width}")["bin_s"] == float(width)
    assert run("join", "net.pt", "net.pt", "-o", "wide.pt")[0] == 0
    made = {"wide.pt": (), "less.pt": ("lean", "net.pt", "--data", "taps", "--network", "less.pt")}
    made["tuned.pt"] = (
        "finetune",
        "net.pt",
        "--data",
        "taps",
        "--epochs",
        "1",
        "--weight-bits",
        "4",
        "-o",
        "tuned.pt",
    )
    for network, words in made.items():
        assert not words or run(*words)[0] == 0
        assert read_checkpoint(network).training["bin_s"] == 0.1
    assert run("export", "x.loom", "--to", "nir", "-o", "x.nir")[1].endswith("in steps of 0.1 s (euler)\n")
    assert as_json("compile", "x.nir", "-o", "again.loom")["provenance"]["bin_s"] == 0.1
    assert "--bin 0.1" in as_json("inspect", "c.pt")["training"]["command"]


OTHERS = {
    "compile net.pt -o x.loom --calibrate few": "trained on taps; calibrate on what it knows",
    "run net.loom --data few": "trained on taps; their classes are 0..1, the network's 0..3",
    "run net.loom --limit 1 --data few": "trained on taps; are their classes the same?",
    "run net.loom --data four": "events of taxels 0..3 only, the network has 6; are they of its sensor?",
}


@pytest.mark.parametrize(("words", "why"), OTHERS.items())
def test_recordings_that_look_like_others_are_warned_of(tmp_path, monkeypatch, words, why):
    monkeypatch.chdir(tmp_path)
    csv_folder(tmp_path / "few", classes=2 if words.startswith("run") else 4)
    csv_folder(tmp_path / "four", taxels=4)
    own_file(tmp_path / "net.pt", training={"data": "four" if "four" in words else "taps"})
    assert run("compile", "net.pt", "-o", "net.loom")[0] == 0
    code, _, err = run(*words.split())
    assert (code, err.count("warning: ")) == (0, 1)
    assert re.search(rf"^spikeloom: warning: {words.split()[-1]}: .*{re.escape(why)}$", err, re.MULTILINE)


def test_graph_time_step_and_names_are_the_netlists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(state_dict(weights(taxels=39)), "bare.pt")
    assert run("compile", "bare.pt", "--graph", "knn:1", "-o", "net.loom")[0] == 0
    assert run("verify", "net.loom", "--checkpoint", "bare.pt")[0] == 0
    code, out, _ = run("export", "net.loom", "--to", "nir", "-o", "net.nir")
    assert (code, "on the chip" in out) == (0, False)  # with all neurons
    assert run("compile", "net.nir", "-o", "back.loom")[0] == 0
    netlist = read_netlist("back.loom")
    layers = tuple(dataclasses.replace(layer, name=f"l{k}") for k, layer in enumerate(netlist.layers))
    digests = dict(
        zip((layer.name for layer in layers), netlist.provenance["digests"].values(), strict=True)
    )
    netlist = dataclasses.replace(
        netlist, layers=layers, provenance={**netlist.provenance, "digests": digests}
    )
    write_netlist(netlist, "named.loom")
    assert run("verify", "named.loom", "--checkpoint", "net.nir")[0] == 0
    code, _, err = run("verify", "named.loom", "--checkpoint", "net.nir", "--dt", "0.01")
    assert (code, "the file states steps of 0.02 s" in err) == (2, True)
