"""NIR files: held to what their own packages run, node by node; written ones opened by the package nir."""

import itertools
from dataclasses import replace
from pathlib import Path

import nir
import numpy as np
import pytest
from hypothesis import given, settings
from made_nir import affine, chain, cuba, graph_with, lif, lowered, simulate, stepped
from numpy.testing import assert_allclose, assert_array_equal
from random_networks import chain as network_chain
from random_networks import float_networks
from timed_networks import events_of
from zoo import LAYERED, over, specimen

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.nir import writer as nir_export
from spikeloom.compiler.formats.nir.reader import read_nir
from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.ir import recurrent
from spikeloom.compiler.storage import Given
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.runtime.machines.loihi1 import engine

FILES = Path(__file__).parent / "nir"
"""Networks written by the package that each is named after, and what that package made of a recording."""


READ = {
    "snntorch_leaky": (1e-4, "euler"),
    "snntorch_conv": (1e-4, "euler"),
    "snntorch_recurrent": (1e-4, "euler"),
    "snntorch_one_to_one": (1e-4, "euler"),
    "norse_lif": (1e-6, "euler"),  # the square of its dt, which it multiplies into tau
    "norse_iaf": (1.0, "euler"),
    "sinabs_lif": (1.0, "exponential"),
    "sinabs_iaf": (1.0, "exponential"),
    "spikingjelly_lif": (0.02, "euler"),
    "spikingjelly_if": (0.02, "euler"),
    "spikingjelly_cuba": (0.02, "euler"),
}
"""Time step and convention that each package means."""


def recording(network, events, image=False):
    """Events of a file's input as a recording (1, taxels, polarities, steps)."""
    sensor = network.input
    if image:  # [polarities, height, width] in the file
        return (
            events.reshape(len(events), sensor.polarities, sensor.taxels)
            .transpose(2, 1, 0)[None]
            .astype(np.uint8)
        )
    return (
        events.reshape(len(events), sensor.taxels, sensor.polarities)
        .transpose(1, 2, 0)[None]
        .astype(np.uint8)
    )


def float_spikes(network, events, image=False):
    given = with_clocks(recording(network, events, image), network.input.clocks)
    found = run_float(network, np.ascontiguousarray(given.transpose(0, 2, 1)).astype(bool)).spikes
    return {
        population.name: spikes[0] for population, spikes in zip(network.populations, found, strict=True)
    }


@pytest.mark.parametrize("name", READ)
def test_every_spike_is_that_of_the_package_that_wrote_the_file(name):
    dt, convention = READ[name]
    found = read_nir(FILES / f"{name}.nir", dt=dt, convention=convention)
    run = np.load(FILES / f"{name}.npz")
    spikes = float_spikes(found.network, run["events"], image=run["events"].shape[1] == 50)
    for node in set(run.files) - {"events"}:
        # as SpikingJelly calls it, and as snnTorch the neurons of a recurrent layer
        layer = next(name for name in (node, f"_{node}", f"{node}.lif") if name in spikes)
        assert run[node].sum() > 4
        assert_array_equal(spikes[layer], run[node])


def test_what_snntorch_loses_of_a_synaptic_neuron():
    found = read_nir(FILES / "snntorch_synaptic.nir", dt=1e-4)
    assert any(fact.startswith("a reset leaves currents as they are") for fact in found.facts)
    run = np.load(FILES / "snntorch_synaptic.npz")
    spikes = float_spikes(found.network, run["events"])["1"]
    first = int(np.argmax(run["1"].any(axis=1)))  # up to the first reset both are alike
    assert_array_equal(spikes[: first + 1], run["1"][: first + 1])
    assert not np.array_equal(spikes, run["1"])


def bits(seed, size, steps=60, share=0.3):
    return np.random.default_rng(seed).random((steps, size)) < share


def compare(graph, shape, *, convention="euler", least=10, late=()):
    """Every spiking node against the second reading; inputs of several axes count channel by channel."""
    events = bits(1, int(np.prod(shape)))
    network = lowered(graph, 0.02, convention).network
    ours = float_spikes(network, events, image=len(shape) > 1)
    theirs = simulate(graph, events, 0.02, convention, late)
    for name, spikes in theirs.items():
        assert spikes.sum() >= least
        assert_array_equal(ours[name], spikes)
    return network


def image(rng, **more):
    """A convolution on (2, 5, 6)."""
    said = {
        "stride": (2, 1),
        "padding": (1, 0),
        "dilation": (1, 2),
        "weight": rng.normal(size=(4, 2, 3, 2)),
    } | more
    return nir.Conv2d(input_shape=(5, 6), bias=rng.normal(size=4) * 0.1, groups=1, **said)


def row(shape, out, **nodes):
    """Nodes in a row."""
    return graph_with(nodes, [*itertools.pairwise(nodes)], shape, out)


def leaky(seed):
    rng = np.random.default_rng(seed)
    first = lif(
        9, tau=0.07, r=rng.uniform(1, 3, 9), threshold=rng.uniform(0.3, 0.8, 9), leak=0.2, reset=-0.3
    )
    last = lif(4, tau=0.04, r=2.0, leak=rng.uniform(-0.1, 0.1, 4), reset=0.1)
    return chain(affine(rng, 9, 6, 1.5), first, affine(rng, 4, 9, 1.5), last)


def pooled():
    rng = np.random.default_rng(7)
    window = {"stride": np.array([1, 1]), "padding": np.array([0, 0]), "kernel_size": np.array([2, 2])}
    wide = window | {"stride": np.array([2, 3]), "kernel_size": np.array([2, 3])}
    return row(
        (2, 5, 6),
        (3,),
        a=image(rng),
        b=nir.IF(r=np.full((4, 3, 4), 40.0), v_threshold=np.ones((4, 3, 4))),
        c=nir.SumPool2d(**window),
        d=nir.Threshold(np.full((4, 2, 3), 1.5)),
        e=nir.AvgPool2d(**wide),
        f=nir.Flatten(np.array([4, 1, 1]), 0, -1),
        g=affine(rng, 3, 4, 2.0),
        h=nir.Scale(np.array([1.0, 2.0, 0.5])),
        i=lif(3, r=2.0, threshold=0.2),
    )


def padded(**more):
    conv = image(np.random.default_rng(8), weight=np.random.default_rng(8).normal(size=(4, 2, 3, 3)), **more)
    shape = stepped(conv, np.zeros((2, 5, 6)), {}, 1.0, "euler").shape
    size = int(np.prod(shape))
    flat = nir.Flatten(np.array(shape), 0, -1)
    return row((2, 5, 6), (size,), a=conv, b=flat, c=nir.Threshold(np.full(size, 0.5)))


def one_axis():
    rng = np.random.default_rng(9)
    said = {"stride": 2, "padding": 1, "dilation": 1, "groups": 2}
    conv = nir.Conv1d(
        input_shape=7, weight=rng.normal(size=(4, 1, 3)), bias=rng.normal(size=4) * 0.2, **said
    )
    return row((2, 7), (16,), a=conv, b=nir.Flatten(np.array([4, 4]), 0, -1), c=lif(16, r=3.0))


IMAGE = (2, 5, 6)
GRAPHS = {
    **{f"leaky {seed}": (lambda seed=seed: leaky(seed), (6,)) for seed in range(4)},
    "every stage on images": (pooled, IMAGE),
    "one axis in groups": (one_axis, (2, 7)),
    "padding same": (lambda: padded(padding="same", stride=1, dilation=1), IMAGE),
    "padding valid": (lambda: padded(padding="valid", stride=1, dilation=1), IMAGE),
    "one number for all axes": (lambda: padded(padding=1, stride=2, dilation=1), IMAGE),
}


@pytest.mark.parametrize("convention", ["euler", "exponential"])
@pytest.mark.parametrize("name", GRAPHS)
def test_graphs_node_by_node(name, convention):
    made, shape = GRAPHS[name]
    compare(made(), shape, convention=convention, least=5)


@pytest.mark.parametrize("convention", ["euler", "exponential"])
def test_currents_and_the_biases_that_go_through_them(convention):
    rng = np.random.default_rng(3)
    nodes = [
        affine(rng, 9, 6),
        cuba(9, r=2.0, weight=rng.uniform(1, 2, 9), leak=0.1),
        affine(rng, 7, 9),
        lif(7, r=2.0),
        affine(rng, 4, 7),
        cuba(4, tau_syn=0.08, r=2.5, weight=2.0),
    ]
    network = compare(chain(*nodes), (6,), convention=convention)
    assert network.input.clocks.channels == 1
    assert [population.name for population in network.populations] == [
        "n1",
        "always1",
        "n3",
        "always2",
        "n5",
    ]


def test_a_leaky_integrator_is_the_filter_of_what_follows():
    rng = np.random.default_rng(5)
    filter_ = nir.LI(tau=np.full(9, 0.06), r=np.full(9, 3.0), v_leak=np.full(9, 0.1))
    nodes = [
        affine(rng, 9, 6),
        filter_,
        affine(rng, 8, 9),
        lif(8, r=2.0),
        affine(rng, 4, 8, 2.0),
        lif(4, r=2.0),
    ]
    network = compare(chain(*nodes), (6,))
    assert network.populations[0].alpha == pytest.approx(1 - 0.02 / 0.06)


def test_branches_and_nested_graphs():
    rng = np.random.default_rng(10)
    inner = chain(affine(rng, 8, 6, 2.0), lif(8, r=2.0))
    parts = {"a": affine(rng, 8, 6, 2.0), "b": lif(8, r=2.0), "c": affine(rng, 4, 8), "d": affine(rng, 4, 8)}
    nodes = {**parts, "deep": inner, "e": lif(4, r=2.0)}
    edges = [("a", "b"), ("b", "c"), ("deep", "d"), ("c", "e"), ("d", "e"), ("input", "deep")]
    nested = lowered(graph_with(nodes, edges, (6,), (4,))).network
    flat = {**parts, "deep.n0": inner.nodes["n0"], "deep.n1": inner.nodes["n1"], "e": nodes["e"]}
    pairs = [("a", "b"), ("b", "c"), ("input", "deep.n0"), ("deep.n0", "deep.n1"), ("deep.n1", "d")]
    graph = graph_with(flat, [*pairs, ("c", "e"), ("d", "e")], (6,), (4,))
    events = bits(1, 6)
    ours, theirs = float_spikes(nested, events), simulate(graph, events, 0.02)
    for name, spikes in theirs.items():
        assert spikes.sum() > 10
        assert_array_equal(ours[name], spikes)


def loop(neurons, *stages):
    """A recurrent layer of nine, fed back through stages, one after it, and which edge is late."""
    rng = np.random.default_rng(12)
    names = [f"w{place}" for place in range(len(stages))]
    nodes = {"a": affine(rng, 9, 6, 1.5), "b": neurons, **dict(zip(names, stages, strict=True))}
    nodes |= {"c": affine(rng, 4, 9, 2.0), "d": lif(4, r=2.0)}
    ring = [*itertools.pairwise(["b", *names, "b"])]
    return graph_with(nodes, [("a", "b"), *ring, ("b", "c"), ("c", "d")], (6,), (4,)), {ring[0]}


@pytest.mark.parametrize("convention", ["euler", "exponential"])
@pytest.mark.parametrize("kind", ["lif", "thresholds", "cuba", "if", "threshold"])
def test_a_recurrent_layer(kind, convention):
    rng = np.random.default_rng(13)
    neurons = {
        "lif": lif(9, tau=0.07, r=2.0, leak=0.1, reset=-0.2),
        "thresholds": lif(9, r=2.0, threshold=rng.uniform(0.3, 0.9, 9)),
        "cuba": cuba(9, r=2.0, weight=2.0),
        "if": nir.IF(r=np.full(9, 40.0), v_threshold=np.ones(9), v_reset=np.zeros(9)),
        "threshold": nir.Threshold(np.full(9, 0.7)),
    }[kind]
    graph, late = loop(neurons, affine(rng, 9, 9, 1.5))
    network = compare(graph, (6,), convention=convention, late=late)
    assert recurrent(network) == ("b",)
    graph.edges.remove(("w0", "b"))
    alone = simulate(graph, bits(1, 6), 0.02, convention)
    assert np.count_nonzero(alone["b"] != float_spikes(network, bits(1, 6))["b"]) > 20


def test_loops_of_several_stages_and_of_none():
    rng = np.random.default_rng(14)
    stages = affine(rng, 5, 9), nir.Linear(rng.normal(size=(9, 5))), nir.Scale(np.full(9, 0.5))
    graph, late = loop(lif(9, r=2.0), *stages)
    compare(graph, (6,), late=late)
    graph, late = loop(lif(9, r=2.5))
    network = compare(graph, (6,), late=late)
    assert_array_equal(network.projections[1].weight.toarray(), np.eye(9))


def test_a_loop_through_an_image():
    rng = np.random.default_rng(15)
    nodes = {
        "a": image(rng),
        "b": nir.IF(r=np.full((4, 3, 4), 40.0), v_threshold=np.ones((4, 3, 4))),
        "w": nir.Conv2d(
            input_shape=(3, 4), weight=rng.normal(size=(4, 4, 3, 3)) * 0.3, bias=rng.normal(size=4) * 0.1, groups=1,
            stride=1, padding=1, dilation=1,
        ),
        "c": nir.Flatten(np.array([4, 3, 4]), 0, -1),
        "d": affine(rng, 3, 48),
        "e": lif(3, r=2.0, threshold=0.2),
    }  # fmt: skip
    edges = [("a", "b"), ("b", "w"), ("w", "b"), ("b", "c"), ("c", "d"), ("d", "e")]
    compare(graph_with(nodes, edges, (2, 5, 6), (3,)), IMAGE, least=5, late={("b", "w")})


def test_groups_of_neurons_vote_for_a_class():
    rng = np.random.default_rng(11)
    votes = np.zeros((2, 6))
    votes[[0, 1, 1, 0, 0, 1], np.arange(6)] = 0.5
    network = lowered(chain(affine(rng, 6, 4), lif(6), nir.Linear(votes))).network
    assert network.classes == 2
    assert network.readout.label.tolist() == [0, 1, 1, 0, 0, 1]


@settings(max_examples=10)
@given(float_networks(betas=(0.0, 0.2, 0.9)))
def test_the_nir_file_alone_has_the_integers_and_the_decays(tmp_path_factory, network):
    path = tmp_path_factory.mktemp("nir") / "net.nir"
    netlist = compile_network(network).netlist
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    integer = lift(netlist)
    found = read_nir(path, dt=0.02, polarities=network.input.polarities).network
    assert [one.name for one in found.populations] == [
        one.name.replace(".", "_") for one in integer.populations
    ]
    for post, (ours, chip) in enumerate(zip(found.populations, integer.populations, strict=True)):
        units = chip.threshold / ours.theta  # thresholds that differ are one threshold in other units
        assert ours.beta == pytest.approx(chip.realised_beta, abs=1e-6)
        assert_allclose(ours.bias * units * 64, chip.bias, rtol=1e-12)
        for pre in {projection.pre for projection in integer.projections if projection.post == post}:
            chips = sum(
                p.effective().toarray() for p in integer.projections if (p.pre, p.post) == (pre, post)
            )
            read = [p.weight.toarray() for p in found.projections if (p.pre, p.post) == (pre, post)]
            if chips.any():
                assert_allclose(read[0] * units[:, None], chips, rtol=1e-12)
    assert_array_equal(found.readout.label, integer.readout.label)


def test_another_program_that_follows_nir_makes_nearly_the_same_spikes(tmp_path):
    netlist, path = specimen("timed").machine.netlist, tmp_path / "net.nir"
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    graph = nir.read(path)
    events = with_clocks(events_of(5, samples=1, steps=60), netlist.clocks)
    chip = engine.simulate(netlist, events, spikes=True)
    theirs = simulate(graph, events[0].T, 0.02)
    for index, layer in enumerate(netlist.layers):
        ids = netlist.compartments_of(index)
        ours = chip.spikes[0][layer.depth : layer.depth + 60, ids]
        other = theirs[layer.name][:, netlist.neuron[ids]]
        assert ours.sum() > 20
        assert (ours != other).mean() <= 0.02  # a register is cut to a whole number in every step


def test_a_membrane_that_keeps_all_is_an_if(tmp_path):
    netlist = compile_network(network_chain(np.full((2, 2), 0.3), beta=1.0)).netlist
    path = tmp_path / "net.nir"
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    graph = nir.read(path)
    assert [type(node).__name__ for node in graph.nodes.values()].count("IF") == 1
    assert read_nir(path, dt=0.02).network.populations[0].beta == 1


@over(LAYERED)
def test_what_a_netlist_exports_compiles_to_its_own_integers(name, tmp_path):
    netlist, path = specimen(name).machine.netlist, tmp_path / "net.nir"
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    found = read_nir(path).network
    assert found.forms is not None
    back = compile_network(found, Options(storage=Given(found.forms), keep_all=True)).netlist
    assert (back.clocks, back.bins, back.polarities) == (netlist.clocks, netlist.bins, netlist.polarities)
    for ours, theirs in zip(lift(back).projections, lift(netlist).projections, strict=True):
        assert (ours.pre, ours.post) == (theirs.pre, theirs.post)
        assert not (ours.effective() != theirs.effective()).nnz
    for ours, theirs in zip(lift(back).populations, lift(netlist).populations, strict=True):
        assert_array_equal(ours.threshold, theirs.threshold)
        assert_array_equal(ours.bias, theirs.bias)
        assert (ours.decay_u, ours.decay_v) == (theirs.decay_u, theirs.decay_v)


def test_layers_that_are_called_as_synapses_would_be(tmp_path):
    network = network_chain(np.full((2, 2), 0.3), np.full((2, 2), 0.4))
    names = ("x", "input_to_x")
    populations = [replace(one, name=name) for one, name in zip(network.populations, names, strict=True)]
    netlist = compile_network(replace(network, populations=tuple(populations))).netlist
    path = tmp_path / "net.nir"
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    assert [one.name for one in read_nir(path).network.populations] == [*names]


def test_relays_of_clocks_come_back_as_relays(tmp_path):
    netlist, path = specimen("timed").machine.netlist, tmp_path / "net.nir"
    path.write_bytes(nir_export.export(lift(netlist), 0.02))
    found = read_nir(path).network
    assert found.populations[0].relays == netlist.clocks.channels > 0
    assert [one.relays for one in found.populations[1:]] == [0] * (len(found.populations) - 1)
