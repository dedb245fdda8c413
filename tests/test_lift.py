"""Reading a netlist back as a network: nothing but cores and zeros is forgotten."""

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import refused
from random_netlists import Axon, Neuron, build
from random_networks import compiled, dense_weights, integer_chain, integer_networks, recordings_for, small_target

from spikeloom.compiler import lift
from spikeloom.compiler.errors import CapacityError, FormatError, NumericRangeError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import INPUT, IntegerNetwork
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned

MANY = settings(max_examples=60, deadline=None, derandomize=True)


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
