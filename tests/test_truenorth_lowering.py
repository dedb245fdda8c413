"""Networks on crossbar cores, whole numbers and sums that travel in time: every spike is the model's."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import random_crossbars as cores
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import chain

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks, with_clocks
from spikeloom.compiler.errors import CapacityError, ModelError
from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.targets.truenorth import codebook as book
from spikeloom.compiler.targets.truenorth import legalize, native
from spikeloom.compiler.targets.truenorth.builder import crossing_points
from spikeloom.compiler.targets.truenorth.in_time import first_spikes, lower_in_time
from spikeloom.compiler.targets.truenorth.native import lower
from spikeloom.compiler.targets.truenorth.passes import compile_crossbars
from spikeloom.models.truenorth.network import run_network
from spikeloom.runtime.machines.truenorth import engine, spec
from spikeloom.runtime.machines.truenorth.twins import find_twins
from spikeloom.runtime.machines.votes import class_counts

NETWORKS = st.builds(
    cores.random_network,
    st.integers(0, 2**31),
    copies=st.sampled_from([2, 3, 4]),
    blocks=st.sampled_from([1, 2, 4]),
    hidden=st.sampled_from([(), (4,), (8, 4)]),
    clocks=st.integers(0, 3),
)


@pytest.mark.parametrize("weights", [*native.BASES.values(), *book.WEIGHTS.values()])
def test_axons_of_an_input_make_every_level(weights):
    levels = np.arange(min(weights), sum(weight for weight in weights if weight > 0) + 1)
    points = crossing_points(levels, weights)
    assert set(np.unique(points)) == {0, 1}
    np.testing.assert_array_equal(points @ np.array(weights), levels)


@given(NETWORKS, st.integers(0, 2**31))
def test_chip_and_model_and_definition_agree_in_every_spike(network, seed):
    assert native.faults(network) == []
    netlist = lower(network, cores.CHIP)
    assert legalize.faults(netlist, cores.CHIP) == ()
    events = cores.random_events(seed, network)
    channels = with_clocks(events, network.clocks)
    trace = engine.simulate(netlist, channels, spikes=True, membranes=True)
    cores.assert_equal(spec.simulate(netlist, channels[0]), cores.recording_of(trace))
    model = run_network(network, events)
    depths = {stage.name: depth for depth, stage in enumerate(network.stages)}
    for sample, recording in enumerate(events):
        defined = cores.defined_spikes(network, recording)
        for name, depth in depths.items():
            chosen = np.flatnonzero(netlist.layer == netlist.layers.index(name))
            assert set(netlist.neuron[chosen]) == set(range(defined[name].shape[1]))
            on_chip = trace.spikes[sample, depth : depth + 12][:, chosen]
            np.testing.assert_array_equal(on_chip, defined[name][:, netlist.neuron[chosen]], name)
            np.testing.assert_array_equal(model[name][sample], defined[name], name)
        votes = defined[list(depths)[-1]].sum(axis=0).reshape(-1, network.classes).sum(axis=0)
        np.testing.assert_array_equal(class_counts(netlist, trace.counts.votes)[sample], votes)
    assert trace.counts.overflows.sum() == trace.counts.merged.sum() == 0


def test_leaks_rest_in_the_ticks_before_the_first_data():
    network = cores.random_network(3, hidden=(4, 4))
    steep = tuple(
        replace(stage, leak=native.steepest_leak(stage.threshold, depth) * (-1) ** np.arange(stage.neurons))
        for depth, stage in enumerate(network.stages)
    )
    network = replace(network, stages=steep)
    netlist = lower(network, cores.CHIP)
    nothing = np.zeros((1, netlist.n_inputs, 8), np.uint8)
    trace = engine.simulate(netlist, nothing, spikes=True, membranes=True)
    for depth, stage in enumerate(steep[1:], 1):
        chosen = netlist.layer == netlist.layers.index(stage.name)
        assert not trace.spikes[0, :depth, chosen].any()
        assert not trace.membranes[0, depth - 1, chosen].any()


def test_a_neuron_is_there_once_for_each_axon_that_it_reaches():
    # 300 voters take two cores, both of which receive all 120 neurons on 2 axons: 480, again two cores
    network = cores.random_network(0, copies=2, blocks=1, taxels=4, features=25, hidden=(120,), classes=150, clocks=0)
    netlist = lower(network, cores.CHIP)
    count = {name: np.bincount(netlist.neuron[netlist.layer == i]) for i, name in enumerate(netlist.layers)}
    assert set(count["fc2"]) == {1}
    assert set(count["fc1"]) == set(count["conv1"]) == {4}
    assert netlist.n_cores == 2 + 2 + 2
    assert len(find_twins(netlist, 32).first_neuron) == 100 + 120 + 300


def test_networks_beyond_the_chip():
    network = cores.random_network(0, taxels=65, features=1, blocks=1, hidden=(), copies=2, clocks=0)
    with pytest.raises(CapacityError, match=r"core 1: 260 axons, 256 allowed .*core\.axons"):
        compile_crossbars(network)
    network = cores.random_network(0, hidden=())
    assert lower(network, cores.CHIP).n_cores == 3
    with pytest.raises(CapacityError, match=r"chip: 3 used, 2 allowed .*chip\.cores.*; train with fewer"):
        lower(network, cores.with_limit("chip.cores", 2))


def test_what_contradicts_itself_is_named():
    network = cores.random_network(0)
    first, *rest = network.stages

    def wrong(**changes):
        return native.faults(replace(network, stages=(replace(first, **changes), *rest)))

    assert native.faults(replace(network, copies=5)) == ["5 copies of an input, allowed are 2, 3, 4"]
    assert native.faults(replace(network, stages=())) == ["8 voting neurons for 3 classes"]
    assert wrong(level=first.level * 4)[0] == "conv1: levels beyond 3, the most of 3 copies"
    assert wrong(threshold=0 * first.threshold)[0].endswith("outside 1 <= threshold <= floor <= 131072")
    assert wrong(leak=first.leak + 300) == ["conv1: leaks that the ticks before the first data cannot undo"]
    assert wrong(leak=first.leak[1:]) == ["conv1: 7 values of leak for 8 neurons"]
    assert wrong(inputs=first.inputs * 0) == ["conv1: 1 blocks do not share 8 inputs among them"]
    assert native.faults(replace(network, classes=5)) == ["12 voting neurons for 5 classes"]
    assert native.faults(replace(network, clocks=NO_CLOCKS)) == [
        f"{stage.name}: receives 2 clocks of 0" for stage in rest
    ]


NARROW = cores.with_limit("core.axons", 60)
"""The same chip with few axons, so that small layers are split."""


def forgetful(seed, *sizes, spread=0.5, bias=0.3):
    rng = np.random.default_rng(seed)
    weights = [rng.normal(0, spread, (after, before)) for before, after in pairwise(sizes)]
    return chain(*weights, biases=[rng.normal(0, bias, len(weight)) for weight in weights], beta=0.0)


def assert_equal(levels, netlist, recording):
    """Every spike of every copy is the model's, in its tick, and no other tick of its data has one."""
    trace = cores.both(netlist, recording)
    assert trace.counts.overflows.sum() == 0
    model, sums = book.run_levels(levels, recording)
    steps = recording.shape[1]
    for name, first in first_spikes(levels).items():
        chosen = np.flatnonzero(netlist.layer == netlist.layers.index(name))
        on_chip = trace.spikes[first : first + steps * book.BIN_TICKS][:, chosen]
        due = np.zeros_like(on_chip)
        due[:: book.BIN_TICKS] = model[name][:, netlist.neuron[chosen]]
        np.testing.assert_array_equal(on_chip, due, name)
    expected = np.bincount(levels.label, weights=model[levels.layers[-1].name].sum(axis=0), minlength=levels.classes)
    np.testing.assert_array_equal(class_counts(netlist, trace.counts.votes[None])[0], expected)
    return model, sums


@pytest.mark.parametrize("largest", [1, 2, 3, -4])
def test_weights_in_levels_are_found_again(largest):
    weight = 0.37 * np.array([[largest, 0, 1, -1], [largest, largest, 0, 0]])
    level, step = book.codebook(weight, 3)
    np.testing.assert_allclose(level * step[:, None], weight, rtol=1e-6)


def test_a_network_in_levels_is_the_float_network_with_rounded_weights():
    network = forgetful(0, 20, 15, 8, 4)
    levels = book.in_levels(network, 3, cores.CHIP)
    books = [book.codebook(projection.weight.toarray(), 3) for projection in network.projections]
    rounded = chain(
        *(level * step[:, None] for level, step in books),
        biases=[population.bias for population in network.populations],
        beta=0.0,
    )
    events = (np.random.default_rng(1).random((20, 30)) < 0.3).astype(np.uint8)
    spikes, sums = book.run_levels(levels, events)
    for mine, expected in zip(spikes.values(), run_float(rounded, events.T[None]).spikes, strict=True):
        np.testing.assert_array_equal(mine, expected[0])
    assert sums == ()


def test_partial_sums_saturate_and_are_counted():
    layer = book.Layer(name="fc1", level=np.full((1, 60), 1), threshold=np.array([book.MOST + 21]), copies=2, width=40)
    network = book.LevelNetwork(taxels=60, polarities=1, classes=1, layers=(layer,), label=np.array([0]))
    events = np.zeros((60, 3), np.uint8)
    events[:25, 0] = events[:19, 1] = 1
    events[40:, :2] = 1
    spikes, sums = book.run_levels(network, events)
    assert sums == (book.PartialSums("fc1", 6, 3, 25),)
    assert sums[0] + book.PartialSums("fc1", 4, 1, 30) == book.PartialSums("fc1", 10, 4, 30)
    assert spikes["fc1"][:, 0].tolist() == [False, False, False]  # 19 and 19 of 25 and 20
    for threshold, spiked in ((39, False), (38, True)):
        other = replace(network, layers=(replace(layer, threshold=np.array([threshold])),))
        assert book.run_levels(other, events)[0]["fc1"][0, 0] == spiked


def test_layers_that_receive_a_clock_take_three_axons_an_input():
    levels = book.in_levels(forgetful(2, 8, 300, 6, bias=0.0), 4, cores.CHIP)
    assert [(layer.copies, layer.is_split) for layer in levels.layers] == [(4, False), (3, True)]
    lifted = book.in_levels(forgetful(2, 8, 30, 6, bias=3.0), 4, cores.CHIP)  # some would spike without inputs
    assert {layer.copies for layer in lifted.layers} == {3}


def test_what_cannot_be_in_levels():
    network = forgetful(0, 6, 5, 3)
    (one, two), (first, second) = network.populations, network.projections
    for changes, said in (
        ({"populations": (one, replace(two, beta=0.2))}, "fc2: keeps 0.2 of its membranes"),
        ({"populations": (one, replace(two, alpha=0.5))}, "fc2: keeps 0.5 of its currents"),
        ({"projections": (first, replace(second, pre=-1))}, "fc2: does not receive from the layer before"),
        ({"input": replace(network.input, clocks=Clocks(channels=2, steps=5))}, "has clocks"),
        ({"input": replace(network.input, bins=2)}, "a step joins 2 bins"),
    ):
        with pytest.raises(ModelError, match=said):
            book.in_levels(replace(network, **changes), 3, cores.CHIP)


SHAPES = st.sampled_from([(9, 12, 4), (24, 30, 12, 3), (30, 4), (25, 26, 5), (8, 40, 33, 6)])


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**31), shape=SHAPES, copies=st.sampled_from(book.COPIES), bias=st.sampled_from([0.0, 0.3, 2.0])
)
def test_every_spike_on_the_chip_is_the_models(seed, shape, copies, bias):
    levels = book.in_levels(forgetful(seed, *shape, bias=bias), copies, NARROW)
    netlist = lower_in_time(levels, NARROW)
    assert legalize.faults(netlist, NARROW) == ()
    recording = (np.random.default_rng(seed).random((shape[0], 6)) < 0.5).astype(np.uint8)
    assert_equal(levels, netlist, recording)


@pytest.mark.parametrize("sign", [1, -1])
def test_sums_that_saturate_leave_nothing_for_the_next_step(sign):
    level = sign * np.array([[3] * 60, [1] * 60])
    threshold = np.array([sign * 2 * book.MOST + (sign < 0), 1])
    layer = book.Layer(name="fc1", level=level, threshold=threshold, copies=3, width=30)
    network = book.LevelNetwork(taxels=60, polarities=1, classes=2, layers=(layer,), label=np.array([0, 1]))
    recording = np.zeros((60, 5), np.uint8)
    recording[:, 0] = recording[:, 2] = 1
    recording[3, 3] = 1
    model, (sums,) = assert_equal(network, lower_in_time(network, cores.CHIP), recording)
    assert sums.saturated == 8
    assert model["fc1"][0].any() == (sign > 0)
