"""The command ``lean``: what it recommends is what it builds, and figures are those of the netlist."""

from dataclasses import replace

import numpy as np
import pytest
from made_files import (
    CLASSES,
    TAXELS,
    events,
    own_file,
    recorded,
    recordings_folder,
    small_checkpoint,
    weights,
)
from numpy.testing import assert_array_equal
from random_netlists import Axon, Neuron, build

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import channels_last, float_simulation
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import read_netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.remove import without_channels
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.votes import predictions
from spikeloom.runtime.studies.pruning import trials
from spikeloom.runtime.studies.search.measure import decisions

LEAN = ("lean", "net.pt", "--data", "data")
STEPS = 40


def made(seed, samples):
    found = events(seed, samples=samples, steps=STEPS, rate=0.3)
    found[:, 3] = 0  # a taxel that nothing touches
    return found


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A small network as it is loaded, what it was compiled to, and training recordings."""
    checkpoint, adjacency = small_checkpoint(tmp_path_factory.mktemp("small"), last=weights(3, gain=2.5))
    network = expand(checkpoint, adjacency)
    compilation = compile_network(network, Options(training_events=made(1, 24)))
    loaded = LoadedNetwork(network=network, sha256="", checkpoint=checkpoint)
    return loaded, compilation, recorded(made(1, 24))


def counts(netlist, seen):
    return engine.simulate(netlist, seen.events.reshape(len(seen.events), -1, STEPS)).counts.spikes


def test_what_is_written_decides_and_costs_as_reported(as_json):
    report = as_json(*LEAN, "--differ", "0.1", "-o", "lean.loom")
    row = report["rows"][report["taken"]]
    assert row["training"]["differ"] <= 2
    netlist = read_netlist("lean.loom")
    assert netlist.provenance["lean"] == {"differ": 0.1} | row["removed"]
    as_json("compile", "net.pt", "--weight-bits", 8, "--calibrate", "data", "-o", "whole.loom")
    whole = read_netlist("whole.loom")
    for split, key in (("train", "training"), ("test", "test")):
        data = load_data("data", split)
        flat = data.events.reshape(len(data), -1, STEPS)
        before, after = (
            predictions(each, engine.simulate(each, flat).counts.spikes) for each in (whole, netlist)
        )
        assert row[key]["differ"] == np.count_nonzero(before != after)
        assert row[key]["right"] == np.count_nonzero(after == data.labels)
        lost = np.count_nonzero((before == data.labels) & (after != data.labels))
        assert row["test"]["lost"] == lost or split == "train"
    costs = as_json("estimate", "lean.loom", "--data", "data")["per_inference"]
    assert costs["synaptic_operations"] == pytest.approx(row["operations"])
    assert costs["energy_j"] == pytest.approx(row["energy_j"])
    first, *others = report["rows"]
    assert (first["training"]["differ"], first["test"]["differ"]) == (0, 0)
    assert [other["name"] for other in others[:3]] == ["neurons", "taxels", "hop 0"]
    assert 3 in others[1]["removed"]["taxels"]
    assert max(other["training"]["differ"] for other in others[:2]) <= 2
    sent = load_data("data", "train").events.sum(axis=(0, 2, 3), dtype=int)
    assert [taxel["events"] for taxel in report["taxels"]] == sent.tolist()
    assert report["taxels"][3] == {"events": 0, "training_differ": 0}
    assert [layer["neurons"] for layer in report["layers"]] == [30, 9, 8, CLASSES]


def test_silenced_is_as_if_it_were_gone(compiled):
    _, compilation, seen = compiled
    netlist, taxels = compilation.netlist, np.array([1, 4])
    silent = trials.silenced(netlist, trials.channels_of(netlist, taxels))
    quiet = seen.events.copy()
    quiet[:, taxels] = 0
    assert_array_equal(counts(silent, seen), counts(netlist, replace(seen, held=quiet)))
    deaf = trials.laid_out(trials.without_taxels(compilation, taxels))
    gone = np.flatnonzero((netlist.layer == 1) & (netlist.neuron % 3 == 0))
    for less, same in (
        (deaf, silent),
        (trials.laid_out(compilation, gone), trials.silenced(netlist, netlist.n_inputs + gone)),
    ):
        assert_array_equal(decisions(less, seen), decisions(same, seen))
    for layer in range(4):
        kept = deaf.neuron[deaf.compartments_of(layer)]
        before = counts(silent, seen)[:, netlist.compartments_of(layer)]
        index = np.searchsorted(netlist.neuron[netlist.compartments_of(layer)], kept)
        assert_array_equal(counts(deaf, seen)[:, deaf.compartments_of(layer)], before[:, index])


@pytest.mark.parametrize("allowed", [0, 6])
def test_budgets_hold_and_what_does_nothing_is_spared(compiled, allowed):
    _, compilation, seen = compiled
    netlist = compilation.netlist
    wanted, spikes = decisions(netlist, seen), counts(netlist, seen).sum(axis=0)

    def fits(less):
        return np.count_nonzero(decisions(less, seen) != wanted) <= allowed

    gone = trials.spared_neurons(netlist, spikes, fits)
    assert fits(trials.laid_out(compilation, gone))
    assert set(np.flatnonzero((spikes == 0) & (netlist.readout_class < 0))) <= set(gone)
    assert np.all(netlist.readout_class[gone] < 0)
    changed = trials.changed_alone(netlist, seen, wanted)
    assert changed[3] == 0
    taxels = trials.spared_taxels(netlist, seen, changed, fits)
    assert 3 in taxels
    assert fits(trials.laid_out(trials.without_taxels(compilation, taxels)))


def test_a_layer_keeps_a_neuron(compiled):
    netlist = compiled[1].netlist
    built = trials.laid_out(compiled[1], np.flatnonzero(netlist.layer == 1))
    assert np.count_nonzero(built.layer == 1) == 1


def test_without_hops(compiled):
    loaded, compilation, _ = compiled
    checkpoint = loaded.checkpoint
    same, gone = (trials.without_hops(compilation, loaded, hops).integer for hops in ((), (1, 2, 3)))
    first = [
        next(p for p in network.projections if p.post == 0) for network in (compilation.integer, same, gone)
    ]
    held = compilation.netlist.neuron[compilation.netlist.compartments_of(0)]
    before, again, lean = (p.effective().toarray()[held] for p in first)
    step = np.gcd.reduce(again.astype(int), axis=None)
    assert abs(before - again).max() <= 2 * step  # here to the nearest, there so that errors cancel
    # hop 0 is the taxel itself
    features = np.arange(TAXELS * checkpoint.hops.shape[1])[held] // checkpoint.hops.shape[1]
    own = np.arange(2 * TAXELS) // 2 == features[:, None]
    assert not lean[~own].any()
    assert lean[own].any()
    louder = replace(loaded, checkpoint=replace(checkpoint, hops=checkpoint.hops * 1e4))
    assert trials.without_hops(compilation, louder, (1,)) is None
    assert gone.projections[1:] == tuple(p for p in compilation.integer.projections if p.post)


def test_an_integer_network_without_some_channels(compiled):
    integer = compiled[1].integer
    same = without_channels(integer, np.zeros(integer.input.size, bool))
    assert all(
        (p.weight != q.weight).nnz == 0 for p, q in zip(same.projections, integer.projections, strict=True)
    )
    deaf = without_channels(integer, np.ones(integer.input.size, bool))
    assert not any(p.weight.data.any() for p in deaf.projections if p.pre == INPUT)
    assert lift(compiled[1].netlist).input.size == integer.input.size


def chain():
    """An input to a neuron, that to another which votes."""
    neurons = [Neuron(layer=0, threshold=10), Neuron(layer=0, threshold=10), Neuron(layer=1, threshold=20)]
    axons = [
        Axon(source=0, targets=((0, 40), (1, 60))),
        Axon(source=2, targets=((2, 30),)),
        Axon(source=3, targets=((2, -10),)),
    ]
    netlist = build(neurons, axons, n_inputs=2, depths=[0, 1])
    return replace(netlist, readout_class=read_only([-1, -1, 0]))


def test_effects_are_shares_of_what_a_layer_sends():
    found = trials.effects(chain(), np.array([3, 1, 5]))
    assert found.tolist() == [0.9, 0.1, np.inf]
    assert trials.effects(chain(), np.array([0, 0, 0])).tolist() == [0, 0, np.inf]


def test_bisection_finds_the_largest_number():
    asked = []

    def fits(count):
        asked.append(count)
        return count <= 13

    assert trials.most_spared(20, 4, fits) == 13
    assert min(asked) > 4
    assert len(asked) <= 5
    assert trials.most_spared(20, 4, lambda _: False) == 4


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with recordings, some of them without labels, and checkpoints."""
    folder = tmp_path_factory.mktemp("lean")
    recordings_folder(folder / "data", train=made(1, 24), test=made(2, 12))
    own_file(folder / "net.pt", last=weights(3, gain=2.5))
    return folder


def test_what_is_pruned_can_be_trained_on(compiled, as_json, refusal):
    loaded, _, seen = compiled
    checkpoint, gone = loaded.checkpoint, {"fc1": np.array([0, 4]), "fc2": np.array([1])}
    narrow = trials.narrowed(checkpoint, gone)
    first, second, last = checkpoint.dense
    silent = [w.weight.copy() for w in (second, last)]
    for weight, numbers in zip(silent, gone.values(), strict=True):
        weight[:, numbers] = 0
    dense = (
        first,
        *(replace(each, weight=weight) for each, weight in zip((second, last), silent, strict=True)),
    )
    ran = [
        float_simulation(expand(each, loaded.network.convolution.propagation))
        .run(channels_last(seen.events))
        .spikes[3]
        for each in (narrow, replace(checkpoint, dense=dense))
    ]
    assert ran[0].any()
    assert_array_equal(*ran)

    report = as_json(*LEAN, "--differ", "0.2", "--network", "narrow.pt")
    gone = next(row for row in report["rows"] if row["name"] == "neurons")["removed"]["neurons"]
    made, whole = read_checkpoint("narrow.pt"), read_checkpoint("net.pt")
    assert made.neurons == {
        name: n - gone.get(name, 0) * (name != "conv1") for name, n in whole.neurons.items()
    }
    assert made.neurons != whole.neurons
    found = as_json(
        "finetune", "narrow.pt", "--data", "data", "--weight-bits", "4", "--epochs", "1", "-o", "tuned.pt"
    )
    assert (found["fine_tuned_from"], read_checkpoint("tuned.pt").neurons) == (made.sha256, made.neurons)
    assert "is no single checkpoint in floats" in refusal(
        "lean", "tuned.pt", "--data", "data", "--network", "n.pt"
    )
