"""Recurrent layers, from the float network to the chip, its commands and other programs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from oracles import refused
from random_networks import LOIHI, chain, compiled, integer_chain, small_target, stored

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.interpret import channels_last, run_float, run_integer
from spikeloom.compiler.ir import IntegerProjection, Projection
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.prune import never_fires, removable
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned

SETTINGS = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def with_loop(network, post, weight):
    """A network with one more projection, from a population to itself."""
    own = Projection(pre=post, post=post, weight=stored(np.asarray(weight, float)))
    return replace(network, projections=(*network.projections, own))


def drawn(seed, *, hidden=12, gain=1.0, alpha=0.0):
    """Ten channels, a recurrent layer, four classes; weights of no special values."""
    rng = np.random.default_rng(seed)
    first, last = rng.normal(size=(hidden, 10)) * 0.4, rng.normal(size=(4, hidden)) * 0.5
    network = chain(first, last, beta=0.6, biases=[rng.normal(size=hidden) * 0.05, np.zeros(4)], polarities=2)
    recurring = replace(network.populations[0], alpha=alpha)
    network = replace(network, populations=(recurring, network.populations[1]))
    return with_loop(network, 0, rng.normal(size=(hidden, hidden)) * gain / hidden**0.5)


def events_for(seed, samples=6, steps=50):
    """Recordings (samples, taxels, polarities, steps) of five taxels."""
    return (np.random.default_rng(seed).random((samples, 5, 2, steps)) < 0.3).astype(np.uint8)


# -- what it means -----------------------------------------------------------------------------------------------------
def test_what_is_fired_in_a_step_arrives_in_the_next():
    """The second neuron keeps itself firing once it is hit; it stops the third a step after each spike."""
    network = chain(np.eye(3), np.eye(3), beta=0.0)
    network = with_loop(network, 0, [[0, 0, 0], [0, 1, 0], [0, -1, 0]])
    events = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1], [1, 0, 1]], bool)[None]
    for steps in (run_float(network, events), run_integer(choose_storage(network, LOIHI)[0], events)):
        assert steps.spikes[0][0].astype(int).tolist() == [[1, 0, 1], [0, 1, 1], [0, 1, 0], [1, 1, 0]]
        assert_array_equal(steps.spikes[1], steps.spikes[0])


@SETTINGS
@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_whole_numbers_without_leak_are_exact_in_floats(seed, hidden):
    """Every spike and membrane of the float network is the chip's, where its numbers are."""
    rng = np.random.default_rng(seed)
    first, own, last = (2 * rng.integers(-60, 61, shape) for shape in ((hidden, 4), (hidden, hidden), (3, hidden)))
    integer = integer_chain(first, last)
    loop = IntegerProjection(pre=0, post=0, weight=stored(own), exponent=0, bits=8)
    integer = replace(
        integer,
        populations=tuple(replace(population, decay_v=0) for population in integer.populations),
        projections=(*integer.projections, loop),
    )
    network = with_loop(chain(first, last, beta=1.0, theta=100.0), 0, own)
    events = rng.random((2, 30, 4)) < 0.4
    wanted = run_float(network, events, membranes=True)
    netlist = compiled(integer)
    trace = engine.simulate(netlist, events.transpose(0, 2, 1).astype(np.uint8), spikes=True, membranes=True)
    for layer in range(2):
        assert_array_equal(aligned(netlist, trace.spikes, layer), wanted.spikes[layer])
        assert_array_equal(aligned(netlist, trace.membranes, layer), wanted.membranes[layer] * 64)


# -- rounding and pruning ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_every_spike_of_the_calibration_is_kept_if_asked(alpha):
    network, events = drawn(1, gain=1.5, alpha=alpha), events_for(2)
    made = compile_network(network, Options(training_events=events, spike_exact=True))
    assert [layer.flips for layer in made.exactness] == [0, 0]
    given_ = channels_last(events)
    wanted, found = run_float(network, given_), run_integer(made.integer, given_)
    assert all(spikes.sum() > 30 for spikes in wanted.spikes)
    for ours, theirs in zip(found.spikes, wanted.spikes, strict=True):
        assert_array_equal(ours, theirs)


def test_spikes_are_judged_on_what_the_layer_itself_fired_a_step_before():
    network, events = drawn(3, gain=1.5), events_for(4)
    calibration = calibrate(network, channels_last(events))
    late = calibration.source(0, 0)
    assert_array_equal(late[:, 1:], calibration.spikes[0][:, :-1])
    assert not late[:, 0].any()
    assert calibration.source(0, 1) is calibration.spikes[0]
    for packing in (Packing(), Packing(planes=2), Packing(groups=4)):
        _, choices = choose_storage(network, LOIHI, packings=(packing,), calibration=calibration)
        assert choices[0].flips < 0.1 * choices[0].spikes


def test_neurons_that_only_excite_each_other_are_silent():
    """Nothing starts the ring of the first two; the third is driven, and keeps the fourth going."""
    network = chain([[0, 0], [0, 0], [1, 1], [0, 0]], np.ones((1, 4)))
    own = np.zeros((4, 4))
    own[0, 1] = own[1, 0] = own[3, 2] = 2
    network = with_loop(network, 0, own)
    assert never_fires(network)[0].tolist() == [False, False, False, False]  # a ring might keep itself going
    cut = chain([[0.05, 0.05], [0.05, 0], [1, 1], [0, 0]], np.ones((1, 4)))
    cut = with_loop(cut, 0, own * [0.1, 0.1, 1, 0])
    assert never_fires(cut)[0].tolist() == [True, True, False, False]
    silent, unread = removable(compile_network(cut, Options(keep_all=True)).integer)
    assert silent[0].tolist() == [True, True, False, False]
    assert not unread[0].any()


def test_neurons_that_only_feed_each_other_are_left_out():
    """The first drives the second, which votes; the third and the fourth talk among themselves."""
    network = chain(np.ones((4, 2)), [[1, 1, 0, 0]])
    own = np.zeros((4, 4))
    own[1, 0] = own[3, 2] = 1
    network = with_loop(network, 0, own)
    made = compile_network(network)
    assert [removal.unread for removal in made.removals] == [2, 0]
    assert made.netlist.layers[0].unread == (2, 3)
    own[2, 2] = 1  # a neuron that receives itself counts as received
    made = compile_network(with_loop(replace(network, projections=network.projections[:2]), 0, own))
    assert made.netlist.layers[0].unread == (3,)


# -- cores -------------------------------------------------------------------------------------------------------------
def in_pairs(own):
    """Four neurons with one input."""
    integer = integer_chain(np.full((4, 1), 2))
    loop = IntegerProjection(pre=0, post=0, weight=stored(2 * own, own), exponent=0, bits=8)
    return replace(integer, projections=(*integer.projections, loop))


def test_a_layer_is_cut_so_that_its_axons_to_itself_are_enough():
    pairs = np.kron(np.eye(2, dtype=int), np.ones((2, 2), int))
    target = small_target(core_axons_out=3)
    parts = partition(in_pairs(pairs), target)
    assert [[(chunk.first, chunk.last) for chunk in core] for core in parts] == [[(0, 2)], [(2, 3)], [(3, 4)]]
    require_legal(emit(in_pairs(pairs), parts, (0, 1, 2), target, {}), target)
    words = "fc1 neuron 0: 4 used, 3 allowed (loihi1.core.axons_out)"
    refused(CapacityError, words, partition, in_pairs(np.ones((4, 4), int)), target)
