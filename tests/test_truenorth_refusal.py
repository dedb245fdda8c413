"""Why a network does not fit crossbar cores: needs, sizes of the ways out, trials of them, and the command."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import timed_networks
from made_files import CLASSES, TAXELS, own_file, recordings_folder
from native_networks import random_network
from random_networks import chain, stored

from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.targets.base import CROSSBARS, load_target
from spikeloom.compiler.targets.truenorth.codebook import codebook
from spikeloom.compiler.targets.truenorth.core_counts import packed, relays, split
from spikeloom.compiler.targets.truenorth.lower import lower
from spikeloom.compiler.targets.truenorth.native_file import write_trained
from spikeloom.compiler.targets.truenorth.needs import CURRENT, FAN_IN, LEAK, TARGETS, WEIGHTS, needs
from spikeloom.runtime import cli
from spikeloom.runtime.machines.truenorth import retrained
from spikeloom.runtime.machines.truenorth.trials import Change, Trial

CHIP = load_target("truenorth", CROSSBARS)


# -- needs -------------------------------------------------------------------------------------------------------------


def wide(inputs: int, *sizes: int, beta=0.2, same: bool = False):
    """A chain of full layers; all weights equal, or all different."""
    rng, widths = np.random.default_rng(0), (inputs, *sizes)
    drawn = [rng.normal(size=(after, before)) for before, after in pairwise(widths)]
    return chain(*(np.ones_like(weight) if same else weight for weight in drawn), beta=beta)


def told(network) -> list[tuple[str, str]]:
    return [(need.kind, str(need.fault)) for need in needs(network, CHIP)]


def test_a_layer_that_breaks_no_rule():
    assert told(wide(256, 9, beta=0.0, same=True)) == []


def test_every_need_of_every_layer():
    found = told(wide(300, 5, 3))
    leak = "allowed an added leak (truenorth.neuron.leak); forget within a step, or leak by a constant"
    axons = "(truenorth.neuron.weight_bits); fewer weights, or each input on several axons of different types"
    assert found == [
        (LEAK, f"fc1, all 5 neurons: keep 0.2 of their membranes a step, {leak}"),
        (
            FAN_IN,
            "fc1, neuron 0 (and 4 more): 300 inputs, allowed 256 (truenorth.core.axons); "
            "split the sum, or give the layer fewer inputs",
        ),
        (WEIGHTS, f"fc1, neuron 0 (and 4 more): 300 different weights, allowed 1 with 1 axon an input {axons}"),
        (
            TARGETS,
            "fc1, all 5 neurons: send spikes to 2 axons at least, allowed 1 (truenorth.neuron.targets); "
            "copy the neurons, or split their spikes by relays",
        ),
        (LEAK, f"fc2, all 3 neurons: keep 0.2 of their membranes a step, {leak}"),
    ]


@pytest.mark.parametrize(("inputs", "kinds"), [(256, []), (257, [FAN_IN]), (64, []), (300, [FAN_IN])])
def test_the_limit_of_inputs(inputs, kinds):
    assert [kind for kind, _ in told(wide(inputs, 3, beta=0.0, same=True))] == kinds


@pytest.mark.parametrize(
    ("inputs", "distinct", "over"),
    [(64, 15, False), (64, 16, True), (85, 7, False), (86, 7, True), (128, 3, False), (129, 1, False), (129, 2, True)],
)
def test_the_limit_of_levels_follows_the_axons_that_are_left(inputs, distinct, over):
    weight = np.resize(np.arange(1, distinct + 1), inputs)[None].astype(float)
    assert [kind for kind, _ in told(chain(weight, beta=0.0))] == [WEIGHTS] * over


def test_zeros_are_no_level_and_the_worst_neuron_is_named():
    weight = np.zeros((3, 129))
    weight[0, :2], weight[2, :5] = 1, [1, 2, 3, 0, 4]
    (need,) = needs(chain(weight, beta=0.0), CHIP)
    assert need.fault.where == "fc1, neuron 2"
    assert need.fault.found == "4 different weights"


def test_a_lasting_current():
    network = wide(4, 2, beta=0.0, same=True)
    lasting = replace(network, populations=(replace(network.populations[0], alpha=0.5),))
    assert [kind for kind, _ in told(lasting)] == [CURRENT]


def test_targets_grow_with_the_cores_that_hear():
    for heard, axons in ((256, 2), (257, 4)):
        found = [need.fault.found for need in needs(wide(2, 2, heard, beta=0.0, same=True), CHIP)]
        assert found == [f"send spikes to {axons} axons at least"]


# -- sizes -------------------------------------------------------------------------------------------------------------


def test_cores_of_a_packed_layer():
    blocks = np.kron(np.eye(4), np.ones((64, 64)))  # four groups of 64 neurons, each with 64 inputs of its own
    assert [packed(stored(blocks, blocks > 0), copies, CHIP) for copies in (1, 2, 3, 4)] == [1, 2, 4, 4]
    assert packed(stored(blocks, blocks > 0), 5, CHIP) is None
    full = stored(np.ones((257, 10)))
    assert packed(full, 4, CHIP) == 2  # as many neurons as fit, then the next core


def test_cores_of_a_split_layer():
    found = split(2496, 128, 3, CHIP)
    assert (found.groups, found.inputs, found.partial_cores) == (30, 84, 30)
    assert found.sum_cores == 32  # 60 partial sums a neuron: four neurons and twelve axons of clocks
    assert found.cores == 62
    assert split(300, 200, 2, CHIP).partial_cores == 3 * 2  # 400 neurons of partial sums a group
    assert split(252 * 110 + 1, 1, 1, CHIP) is None  # 222 partial sums and 36 axons of clocks are two too many
    assert split(252 * 110, 1, 1, CHIP).sum_cores == 1


def test_cores_of_relays():
    assert [relays(size, 2, CHIP) for size in (1, 128, 129)] == [1, 1, 2]
    assert relays(5, 256, CHIP) == 5
    assert relays(1, 257, CHIP) is None


# -- trials ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trial():
    rng = np.random.default_rng(3)
    weights = [rng.normal(0, 0.8, (20, 8)), rng.normal(0, 0.5, (12, 20)), rng.normal(0, 0.6, (4, 12))]
    network = chain(*weights, biases=[rng.normal(0, 0.1, len(weight)) for weight in weights])
    return Trial(network, rng.random((20, 30, 8)) < 0.3, rng.integers(0, 4, 20))


def spikes_of(trial: Trial, changes):
    parts = [trial._run(part, changes, before) for part, before in zip(trial.parts, trial.spikes, strict=True)]
    return [np.concatenate(layer) for layer in zip(*parts, strict=True)]


def assert_as(trial, changes, network):
    events = np.concatenate(trial.parts)
    for mine, expected in zip(spikes_of(trial, changes), run_float(network, events).spikes, strict=True):
        assert np.count_nonzero(mine != expected) <= 2  # float32 against float64 at the threshold


def with_layer(network, layer, **changes):
    populations = list(network.populations)
    populations[layer] = replace(populations[layer], **changes)
    return replace(network, populations=tuple(populations))


def test_no_change_is_the_network(trial):
    assert_as(trial, {}, trial.network)
    assert_as(trial, {1: Change()}, trial.network)
    assert 0 <= trial.accuracy({}) == trial.accuracy({0: Change(), 2: Change()})


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_a_membrane_that_forgets(trial, layer):
    assert_as(trial, {layer: Change(beta=0.0)}, with_layer(trial.network, layer, beta=0.0))


def test_all_layers_at_once(trial):
    network = trial.network
    for layer in range(3):
        network = with_layer(network, layer, beta=0.0)
    assert_as(trial, dict.fromkeys(range(3), Change(beta=0.0)), network)


def test_a_constant_leak_by_hand():
    network = chain(np.array([[0.5]]), theta=1.0)
    events = np.array([[1, 1, 1, 0, 0, 1, 1, 1]], bool)[:, :, None]
    trial = Trial(network, events, np.zeros(1, np.int64))
    # 0.5, 0.75, 1.0, 0.75, 0.5, 0.75, 1.0, 1.25: above 1 in the last step only
    assert np.flatnonzero(spikes_of(trial, {0: Change(leak=0.25)})[0]).tolist() == [7]
    # a leak of the whole membrane forgets everything
    assert not spikes_of(trial, {0: Change(leak=0.5)})[0].any()
    assert np.flatnonzero(spikes_of(trial, {0: Change(leak=0.0)})[0]).tolist() == [2, 7]


def test_the_leak_that_moves_fewest_spikes(trial):
    for layer in range(3):
        chosen, theta = trial.leak_for(layer), trial.network.populations[layer].theta
        moved = dict.fromkeys((share * theta for share in (0.2, 0.4, 0.6, 0.8, 1.0)), 0)
        for leak in moved:
            for part, before in zip(trial.parts[:2], trial.spikes, strict=False):
                found = trial._run(part, {layer: Change(leak=leak)}, before)
                moved[leak] += np.count_nonzero(found[layer] != before[layer])
        assert moved[chosen] == min(moved.values())


def test_inputs_that_come_again_by_hand():
    network = chain(np.array([[1.0]]), theta=1.1, beta=0.4)
    events = np.array([[1, 1, 0, 1, 0, 0, 1]], bool)[:, :, None]
    trial = Trial(network, events, np.zeros(1, np.int64))
    # 1, 1.4, 0.56, 1.16, 0.4, 0.16, 1: a spike erases nothing, so that step 3 spikes where the membrane would not
    assert np.flatnonzero(spikes_of(trial, {0: Change(echoes=True)})[0]).tolist() == [1, 3]
    assert np.flatnonzero(trial.spikes[0][0]).tolist() == [1]


@pytest.mark.parametrize(("copies", "low", "high"), [(2, -1, 1), (3, -4, 3), (4, -8, 7)])
def test_codebooks(copies, low, high):
    rng = np.random.default_rng(copies)
    weight = rng.normal(size=(7, 40))
    found = codebook(weight, copies)
    assert found.level.min() >= low
    assert found.level.max() <= high
    assert np.array_equal(found.level, np.rint(found.level))
    error = np.square(found.level * found.step[:, None] - weight).sum(axis=1)
    assert np.all(error < np.square(weight).sum(axis=1) * (0.35, 0.1, 0.03)[copies - 2])
    # weights that are levels already stay
    exact = rng.integers(low, high + 1, (3, 12)) * 0.25
    exact[:, 0] = low * 0.25
    kept = codebook(exact, copies)
    assert np.array_equal(kept.level * kept.step[:, None], exact)


def test_parts_of_a_sum_saturate_and_are_counted():
    network = chain(np.ones((1, 6)), theta=2.5, beta=0.0)
    events = np.array([[[1, 1, 1, 0, 0, 0], [1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0], [1, 0, 0, 1, 1, 0]]], bool)
    trial = Trial(network, events, np.zeros(1, np.int64))
    levels = codebook(np.ones((1, 6)), 2)
    change = Change(levels=levels, inputs=3, most=2)
    # parts 3|0, 3|2, 0|0, 1|2 saturate at 2: sums 2, 4, 0, 3
    assert np.flatnonzero(spikes_of(trial, {0: change})[0]).tolist() == [1, 3]
    trial.accuracy({0: change})
    assert trial.saturated == 2 / 8
    trial.accuracy({0: replace(change, most=3)})
    assert trial.saturated == 0


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("refusal")
    own_file(folder / "small.pt")
    recordings_folder(folder / "data")
    return folder


@pytest.fixture(autouse=True)
def shipped(monkeypatch, tmp_path):
    """A folder of shipped networks, empty at first."""
    monkeypatch.setattr(retrained, "_files", lambda pattern: iter(sorted(tmp_path.glob(pattern))))
    return tmp_path


def refused(capsys, place, *words: str):
    path = f"{place}/net.loom"
    assert cli.main(["compile", f"{place}/small.pt", "--target", "truenorth", "-o", path, *words]) == 2
    found = capsys.readouterr()
    assert not (place / "net.loom").exists()
    return found


def test_the_refusal_is_priced(place, capsys):
    report = json.loads(refused(capsys, place, "--calibrate", f"{place}/data", "--json").out)
    assert [(entry["layer"], entry["kind"]) for entry in report["violations"]] == [
        *(("conv1", kind) for kind in (LEAK, TARGETS)),
        *(("fc1", kind) for kind in (LEAK, WEIGHTS, TARGETS)),
        *(("fc2", kind) for kind in (LEAK, TARGETS)),
        ("fc3", LEAK),
    ]
    assert report["samples"] == 6
    for violation in report["violations"]:
        ways = violation["ways"]
        assert len(ways) >= 2
        for way in ways:
            assert way["cores"] >= 1
            assert way["ticks"] >= 24 + 3
            assert (way["command"] is None) == (way["accuracy"] is not None)
            assert way["accuracy"] is None or 0 <= way["accuracy"] <= 1
            assert not way["exact"] or way["accuracy"] == report["accuracy"]
        if violation["kind"] != TARGETS:
            assert [way["note"] for way in ways if way["command"]] == ["after retraining"]
    assert [way["cores"] is not None for way in report["together"]] == [True] * 3


KNOWN = {"command": "spikeloom train …", "data": "data", "data_sha256": "c0ffee", "test_samples": 8}


def ship(path, *, taxels=TAXELS, towers=1, reached=None, training=None):
    """Write a network for the chip as if it were shipped."""
    network = random_network(1, taxels=taxels, classes=CLASSES, towers=towers, copies=2, clocks=0)
    record = training or KNOWN | (reached or {"clean": {"correct": 6}, "last": {"correct": 7}})
    write_trained(path, {"clean": network}, graph="ring", edges=np.zeros((0, 2), int), training=record)
    return network


def test_what_needs_training_has_the_figures_of_a_shipped_network(place, shipped, capsys):
    network = ship(shipped / "native.pt")
    ship(shipped / "other.pt", taxels=5)
    towers = [KNOWN | {"command": f"spikeloom train --seed {seed}"} for seed in (0, 1)]
    joined = {"command": "spikeloom join …", "towers": towers, "test": {"correct": 7, "samples": 8}}
    ship(shipped / "wide.pt", towers=2, training=joined)
    ship(shipped / "silent.pt", reached={"seed": 0})
    report = json.loads(refused(capsys, place, "--calibrate", f"{place}/data", "--json").out)
    assert [like["name"] for like in report["retrained"]] == ["pretrained:native", "pretrained:wide"]
    small, wide = report["retrained"]
    assert (small["accuracy"], small["cores"], small["ticks"]) == (6 / 8, lower(network, CHIP).n_cores, 24 + 3)
    assert (wide["accuracy"], wide["cores"], wide["towers"]) == (7 / 8, 2 * small["cores"], 2)
    assert wide["commands"] == [*(tower["command"] for tower in towers), "spikeloom join …"]
    for violation in report["violations"]:
        priced = [way for way in violation["ways"] if way["shipped"] is not None]
        named = {LEAK: ["trained with a leak that is added"], WEIGHTS: ["trained in 3 levels"], TARGETS: []}
        assert [way["name"] for way in priced] == named[violation["kind"]]
        for way in priced:
            assert (way["accuracy"], way["cores"], way["shipped"]) == (6 / 8, small["cores"], "pretrained:native")


def test_the_text_of_what_was_trained(place, shipped, capsys):
    ship(shipped / "native.pt")
    lines = refused(capsys, place, "--calibrate", f"{place}/data").out.splitlines()
    (leak, *_) = (line for line in lines if line.startswith("  trained with a leak that is added"))
    assert "75.0 % after retraining" in leak
    told = (
        "all of it at once, after retraining; accuracy on the 8 test recordings of data, cores and ticks of the whole "
    )
    at = lines.index(f"{told}network:")
    assert lines[at + 2].split()[:4] == ["pretrained:native", "75.0", "%", "after"]
    assert lines[at + 4 : at + 7] == [
        "what made the shipped networks:",
        "  pretrained:native:",
        "    spikeloom train …",
    ]


def test_networks_of_other_data_are_no_price(tmp_path, shipped, capsys):
    ship(shipped / "native.pt")
    (tmp_path / "own").mkdir()
    for digest, names in (("c0ffee", ["pretrained:native"]), ("0" * 64, [])):
        own_file(tmp_path / "own" / "x.pt", training={"data_sha256": digest})
        words = ["compile", f"{tmp_path}/own/x.pt", "--target", "truenorth", "-o", f"{tmp_path}/x.loom", "--json"]
        assert cli.main(words) == 2
        found = json.loads(capsys.readouterr().out)
        assert [like["name"] for like in found["retrained"]] == names


def test_the_sparsest_graph_has_the_figures_of_the_network_that_was_trained_on_it(shipped):
    ship(shipped / "native.pt")
    (like,) = retrained.shipped_networks(CHIP, taxels=TAXELS, classes=CLASSES)
    assert retrained.accuracy_on("mst:0", like) is None
    own_file(shipped / "native-mst0.pt", training=KNOWN | {"clean": {"correct": 5}})
    assert retrained.accuracy_on("mst:0", like) == ("pretrained:native-mst0", 5 / 8, "spikeloom train …")
    own_file(shipped / "native-mst0.pt", training=KNOWN | {"clean": {"correct": 5}, "data": "others"})
    assert retrained.accuracy_on("mst:0", like) is None


def test_the_refusal_without_recordings_has_cores_and_ticks(place, capsys):
    report = json.loads(refused(capsys, place, "--json").out)
    ways = [way for violation in report["violations"] for way in violation["ways"]]
    assert {way["accuracy"] for way in ways} == {None}
    assert {way["bin_ticks"] for way in ways} == {1}
    assert all(way["cores"] >= 1 for way in ways)


def test_the_text(place, capsys):
    out = refused(capsys, place, "--calibrate", f"{place}/data").out
    lines = out.splitlines()
    assert lines[0] == "small.pt does not fit IBM TrueNorth: 8 violations, nothing was written"
    leak = "keep 0.2 of their membranes a step, allowed an added leak (truenorth.neuron.leak)"
    assert f"conv1, all 30 neurons: {leak}" in lines
    assert any(line.startswith("  history-free as it is") and "%" in line for line in lines)
    assert any(line.startswith("  trained history-free ") and "after retraining" in line for line in lines)
    assert "all of it at once, without training (--in-time):" in lines
    bare = refused(capsys, place).out.splitlines()
    told = "cores of the layer, ticks of a data step; --calibrate DATA measures what the ways do to decisions"
    assert bare[1] == told
    assert any("not measured" in line and "1 a step" in line for line in bare)


def test_every_command_that_is_named_exists(place, capsys):
    report = json.loads(refused(capsys, place, "--json").out)
    commands = {way["command"] for violation in report["violations"] for way in violation["ways"] if way["command"]}
    assert len(commands) == 2
    for command in commands:
        program, *words = command.split()
        assert program == "spikeloom"
        cli.build_parser().parse_args(words)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--weight-bits", "4"], "--weight-bits: is for loihi1, not for truenorth; leave it away"),
        (["--spike-exact"], "--spike-exact: is for loihi1, not for truenorth; leave it away"),
        (["--chips", "2"], "--chips: is for loihi1, not for truenorth; leave it away"),
        (["--dump-after", "expand"], "--dump-after: is for loihi1, not for truenorth; leave it away"),
    ],
)
def test_options_of_the_other_chip(place, capsys, words, line):
    assert refused(capsys, place, *words).err == f"spikeloom: {line}\n"


def test_an_unknown_target_still_says_so(place, capsys):
    words = ["compile", f"{place}/small.pt", "--target", "loihi2", "-o", f"{place}/net.loom"]
    assert cli.main(words) == 2
    assert capsys.readouterr().err == (
        "spikeloom: --target loihi2: not modelled; no public per-event energies; allowed: loihi1, truenorth\n"
    )


def test_clocks_are_told_apart(tmp_path, capsys):
    path = tmp_path / "timed.pt"
    timed_networks.written(path)
    words = ["compile", str(path), "--target", "truenorth", "-o", f"{tmp_path}/net.loom"]
    for more in ([], ["--in-time", "3"]):
        assert cli.main([*words, *more]) == 2
        told = capsys.readouterr().err
        if more:
            assert told.startswith(f"spikeloom: {path}: has clocks; sums in time are for networks without; ")
        else:
            assert told == (
                f"spikeloom: {path}: hears clocks, of which ways out are not known; train one for the chip, which may "
                "hear them: spikeloom train --system tactilesgnet-truenorth\n"
            )


@pytest.mark.recordings
def test_the_released_network(released_checkpoint, objects_zip, tmp_path, capsys):
    words = ["compile", str(released_checkpoint), "--graph", "manual", "--target", "truenorth", "--json"]
    assert cli.main([*words, "--calibrate", str(objects_zip), "-o", f"{tmp_path}/x.loom"]) == 2
    report = json.loads(capsys.readouterr().out)
    kinds: dict[str, list[str]] = {}
    for violation in report["violations"]:
        kinds.setdefault(violation["layer"], []).append(violation["kind"])
    assert kinds == {
        "conv1": [LEAK, WEIGHTS, TARGETS],
        "fc1": [LEAK, FAN_IN, WEIGHTS, TARGETS],
        "fc2": [LEAK, WEIGHTS, TARGETS],
        "fc3": [LEAK, WEIGHTS],
    }
    assert len(report["violations"]) == 12
    assert report["accuracy"] > 0.95
    (fan_in,) = (v for v in report["violations"] if v["kind"] == FAN_IN)
    assert fan_in["found"] == "2,496 inputs"
    ternary, *_, retrained = fan_in["ways"]
    assert (ternary["cores"], ternary["ticks"]) == (42, 250 * 20 + 3 + 20)
    assert ternary["accuracy"] > 0.9
    assert "--features 3" in retrained["command"]
    three = report["together"][1]
    assert (three["cores"], three["ticks"]) == (113, 5043)
    assert three["accuracy"] > 0.8


def test_shipped_networks_for_the_sensor_of_the_paper(monkeypatch):
    monkeypatch.undo()
    for classes, name, samples in ((36, "objects", 144), (20, "containers", 60)):
        found = retrained.shipped_networks(CHIP, taxels=39, classes=classes)
        small = found[0]
        assert (small.name, small.samples) == (f"pretrained:{name}-truenorth", samples)
        assert (small.cores, small.depth, small.levels, small.inputs) == (32, 3, 7, 78)
