import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import refused
from random_netlists import Axon, Neuron, build
from random_networks import (
    LOIHI,
    compiled,
    dense_weights,
    integer_chain,
    integer_networks,
    legal_partition,
    recordings_for,
    seated,
    small_target,
    tight_targets,
)

from spikeloom.compiler import lift
from spikeloom.compiler.errors import CapacityError, FormatError, NumericRangeError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import INPUT, IntegerNetwork, fan_in
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned


@settings(deadline=None, max_examples=25)
@given(integer_networks(), tight_targets())
def test_the_netlist_holds_exactly_the_network(network, target):
    netlist = seated(network, legal_partition(network, target), target)
    sizes = {INPUT: network.input.size} | {i: p.size for i, p in enumerate(network.populations)}
    dense = {(p.pre, p.post): np.zeros((sizes[p.post], sizes[p.pre]), np.int64) for p in network.projections}
    nonzero = 0
    for axon, core in enumerate(np.repeat(np.arange(netlist.n_cores), np.diff(netlist.core_axons))):
        source, form = int(netlist.axon_source[axon]), int(netlist.axon_format[axon])
        pre, column = INPUT, source
        if source >= netlist.n_inputs:
            compartment = source - netlist.n_inputs
            pre, column = int(netlist.layer[compartment]), int(netlist.neuron[compartment])
        held = slice(*netlist.axon_synapses[axon : axon + 2])
        targets, weights = netlist.synapse_target[held].tolist(), netlist.synapse_weight[held].tolist()
        if netlist.format_index_bits[form] == 0:
            # A dense list has no indices: its targets are consecutive, and it begins and ends with a synapse.
            assert targets == list(range(targets[0], targets[0] + len(targets)))
            assert weights[0] * weights[-1] != 0
        else:
            assert targets == sorted(set(targets))
            assert 0 not in weights
            assert targets[-1] < 2 ** int(netlist.format_index_bits[form])
        exponent, step = int(netlist.format_exponent[form]), 2 ** (9 - int(netlist.format_weight_bits[form]))
        first, last = netlist.core_compartments[core : core + 2]
        for where, weight in zip(targets, weights, strict=True):
            assert weight % step == 0
            assert first + where < last
            if weight:
                nonzero += 1
                row, post = int(netlist.neuron[first + where]), int(netlist.layer[first + where])
                dense[pre, post][row, column] += weight * 2**exponent if exponent >= 0 else weight // 2
    assert nonzero == sum(np.count_nonzero(p.weight.data) for p in network.projections)
    for post in range(len(network.populations)):
        for pre, weight in dense_weights(network, post).items():
            np.testing.assert_array_equal(dense[pre, post], weight)


@settings(deadline=None, max_examples=25)
@given(integer_networks(), tight_targets())
def test_compartments_hold_the_registers_of_their_neurons(network, target):
    parts = legal_partition(network, target)
    netlist = seated(network, parts, target, {"seed": 1})
    for index, population in enumerate(network.populations):
        ids = netlist.compartments_of(index)
        assert netlist.neuron[ids].tolist() == list(range(population.size))
        for field in ("threshold", "bias_mantissa", "bias_exponent", "scale"):
            np.testing.assert_array_equal(getattr(netlist, field)[ids], getattr(population, field))
        assert set(netlist.decay_u[ids].tolist()) == {population.decay_u}
        assert set(netlist.decay_v[ids].tolist()) == {population.decay_v}
        voting = index == network.readout.population
        expected = network.readout.label.tolist() if voting else [-1] * population.size
        assert netlist.readout_class[ids].tolist() == expected
        layer = netlist.layers[index]
        into = [p for p in network.projections if p.post == index]
        assert (layer.name, layer.neurons) == (population.name, population.size)
        assert layer.synapses == fan_in(network, index).sum()
        assert layer.max_fan_in == fan_in(network, index).max()
        assert layer.weight_bits == max(p.bits for p in into)
    assert (netlist.taxels, netlist.polarities) == (network.input.taxels, network.input.polarities)
    assert (netlist.classes, netlist.provenance, netlist.target) == (network.classes, {"seed": 1}, "loihi1")
    assert all(not getattr(netlist, name).flags.writeable for name in ("neuron", "axon_source", "synapse_weight"))


def test_lists_are_sparse_where_that_saves_visits():
    """Four of ten neurons: sparse although dense would save no word; eight of ten: dense."""
    few, many = np.zeros((10, 1), int), np.full((10, 1), 2)
    few[[0, 3, 6, 9]] = 2
    many[[4, 5]] = 0
    assert compiled(integer_chain(few)).n_synapses == 4
    netlist = compiled(integer_chain(many))
    assert netlist.synapse_weight.tolist() == [2, 2, 2, 2, 0, 0, 2, 2, 2, 2]


def test_lists_are_dense_where_memory_is_short():
    """48 of 64 neurons: 11 words sparse, 9 dense."""
    weights = np.full((64, 1), 2)
    weights[1:33:2] = 0
    network = integer_chain(weights)
    assert compiled(network).n_synapses == 48
    assert compiled(network, small_target(core_synapse_words=9)).n_synapses == 64


def test_a_network_of_zeros_has_cores_but_no_axons():
    netlist = compiled(integer_chain(np.zeros((3, 2)), np.zeros((2, 3))))
    assert (netlist.n_cores, netlist.n_compartments, netlist.n_axons, netlist.n_synapses) == (1, 5, 0, 0)
    require_legal(netlist, LOIHI)


# --- reading a netlist back -------------------------------------------------------------------------------------------
MANY = settings(max_examples=30, deadline=None, derandomize=True)


def lower(network: IntegerNetwork, **limits: int) -> Netlist:
    """Netlist of a network on cores of these limits."""
    return compiled(network, small_target(**limits))


def assert_same_network(found: IntegerNetwork, expected: IntegerNetwork) -> None:
    """Equal in everything but stored zeros and the division into projections."""
    assert found.input == expected.input
    assert found.classes == expected.classes
    assert found.readout.population == expected.readout.population
    np.testing.assert_array_equal(found.readout.label, expected.readout.label)
    for ours, theirs in zip(found.populations, expected.populations, strict=True):
        for name in ("name", "beta", "theta", "decay_u", "decay_v"):
            assert getattr(ours, name) == getattr(theirs, name), name
        for name in ("scale", "threshold", "bias_mantissa", "bias_exponent"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    for post in range(len(expected.populations)):
        ours, theirs = dense_weights(found, post), dense_weights(expected, post)
        for pre in set(ours) | set(theirs):
            nothing = np.zeros(1, np.int64)
            np.testing.assert_array_equal(*np.broadcast_arrays(ours.get(pre, nothing), theirs.get(pre, nothing)))
    assert all(np.all(projection.weight.data != 0) for projection in found.projections)


@MANY
@given(integer_networks(), st.sampled_from([1, 3, 1024]))
def test_emit_and_back(network, compartments):
    try:
        netlist = lower(network, core_compartments=compartments)
    except CapacityError:
        assume(False)
    found = lift(netlist)
    assert_same_network(found, network)
    formats = {(p.pre, p.post): (p.bits, p.exponent) for p in network.projections if np.any(p.weight.data)}
    kept = {(p.pre, p.post): (p.bits, p.exponent) for p in found.projections if p.weight.nnz}
    assert kept == formats


@MANY
@given(st.data())
def test_runs_like_the_chip(data):
    network = data.draw(integer_networks(exponents=(-1, 0)))
    netlist = lower(network, core_compartments=5)
    events = data.draw(recordings_for(network.input.size))
    try:
        trace = engine.simulate(netlist, events.transpose(0, 2, 1), spikes=True, membranes=True)
    except NumericRangeError:
        assume(False)
    activity = run_integer(lift(netlist), events, membranes=True)
    for layer in range(len(netlist.layers)):
        np.testing.assert_array_equal(activity.spikes[layer], aligned(netlist, trace.spikes, layer))
        np.testing.assert_array_equal(activity.membranes[layer], aligned(netlist, trace.membranes, layer))


@pytest.mark.parametrize("empty", [0, 1, 2])
def test_a_layer_without_synapses_keeps_its_projection(empty):
    weights = [np.full((3, 4), 50), np.full((2, 3), 60), np.full((2, 2), 70)]
    weights[empty] = np.zeros_like(weights[empty])
    network = integer_chain(*weights)
    found = lift(lower(network))
    verify(found)
    assert_same_network(found, network)
    assert [(p.pre, p.post, p.weight.nnz > 0) for p in sorted(found.projections, key=lambda p: p.post)] == [
        (post - 1 if post else INPUT, post, post != empty) for post in range(3)
    ]


def netlist_of(*neurons: Neuron) -> Netlist:
    netlist = build(list(neurons), [Axon(source=0, targets=((0, 2),))], n_inputs=1, depths=[0, 0])
    return dataclasses.replace(netlist, readout_class=read_only([0] * len(neurons)))


@pytest.mark.parametrize("field", ["decay_u", "decay_v"])
def test_different_decays_in_a_layer_are_refused(field):
    netlist = netlist_of(Neuron(), Neuron(**{field: 7}), Neuron(layer=1))
    refused(FormatError, f"layer0|2 values of {field}", lift, netlist)


@pytest.mark.parametrize(("votes", "layers"), [([-1, -1], 0), ([0, 0], 2)])
def test_one_layer_votes(votes, layers):
    netlist = dataclasses.replace(netlist_of(Neuron(), Neuron(layer=1)), readout_class=read_only(votes))
    refused(FormatError, f"{layers} layers vote", lift, netlist)
