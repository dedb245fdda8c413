"""The float engine means what the interpreter means, and hands spikes back where the chip fires them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from numpy.testing import assert_array_equal
from random_networks import chain, compiled, float_networks, integer_chain, recordings_for

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.errors import SpikeloomError
from spikeloom.compiler.interpret import run_float
from spikeloom.runtime.equivalence import float_engine
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned, unpack
from spikeloom.runtime.machines.votes import readout_counts

REPEATABLE = settings(max_examples=30, deadline=None, derandomize=True)


def lively(weights=3, seed=0, sizes=(8, 6, 5, 4)):
    rng = np.random.default_rng(seed)
    matrices = [rng.normal(0, 1.0, (after, before)) for before, after in pairwise(sizes)]
    return chain(*matrices[:weights], biases=[rng.normal(0, 0.1, len(m)) for m in matrices[:weights]], polarities=2)


def random_inputs(channels, seed=0, samples=4, steps=30, rate=0.3):
    return (np.random.default_rng(seed).random((samples, channels, steps)) < rate).astype(np.uint8)


def spikes_of(prepared, netlist, inputs, **options):
    """Spikes of each layer as they come back packed, aligned with the data."""
    found = float_engine.run(prepared, inputs, **options)
    flags = unpack(found.packed, netlist.n_compartments)
    return found, [aligned(netlist, flags, layer) for layer in range(len(netlist.layers))]


@REPEATABLE
@given(float_networks().flatmap(lambda n: recordings_for(n.input.size).map(lambda events: (n, events))))
def test_any_wiring(drawn):
    network, events = drawn
    try:
        netlist = compile_network(network, Options(keep_all=True)).netlist
    except SpikeloomError:
        return
    inputs = np.ascontiguousarray(np.asarray(events, np.uint8).reshape(len(events), network.input.size, -1))
    found = float_engine.run(float_engine.prepare(network, netlist), inputs)
    wide = run_float(network, inputs.transpose(0, 2, 1).astype(bool), membranes=True)
    near = any(
        (np.abs(u - population.theta) < 1e-4).any()
        for u, population in zip(wide.membranes, network.populations, strict=True)
    )
    if not near:  # where no membrane is so near to its threshold that float32 may decide otherwise
        assert_array_equal(found.spikes, np.stack([s.sum(axis=(1, 2)) for s in wide.spikes], axis=1))


def test_spikes_lie_where_the_chip_fires_them():
    """A network of whole numbers that forgets at once spikes alike on both sides, word by word."""
    matrices, thresholds = ([[3, -1, 2], [2, 2, -3]], [[2, 1], [-1, 3]]), (2, 3)
    netlist = compiled(integer_chain(*(2 * np.array(m) for m in matrices), thresholds=[2 * t for t in thresholds]))
    netlist = replace(netlist, decay_v=np.full_like(netlist.decay_v, 4095))  # what is left is below one unit
    network = chain(*(np.array(m) / t for m, t in zip(matrices, thresholds, strict=True)), beta=0.0, theta=1.0)
    inputs = random_inputs(3, 7, samples=5, steps=20)
    found = float_engine.run(float_engine.prepare(network, netlist), inputs)
    trace = engine.simulate(netlist, inputs, packed=True)
    assert trace.counts.spikes.any()
    assert_array_equal(found.packed, trace.packed)


def test_neurons_that_the_chip_leaves_out_are_counted_elsewhere():
    network = lively(seed=2)
    netlist = compile_network(network).netlist
    first = netlist.compartments_of(0)
    smaller = replace(netlist, layer=netlist.layer.copy(), neuron=netlist.neuron)
    gone = int(netlist.neuron[first[0]])
    moved = smaller.layer.copy()
    moved[first[0]] = len(netlist.layers)  # of no layer any more
    smaller = replace(smaller, layer=moved)
    inputs = random_inputs(network.input.size, 2)
    wanted = run_float(network, inputs.transpose(0, 2, 1).astype(bool)).spikes[0]
    found = float_engine.run(float_engine.prepare(network, smaller), inputs)
    assert wanted[..., gone].any()
    assert_array_equal(found.elsewhere[:, 0], wanted[..., gone].sum(axis=1))
    quiet = replace(smaller, layers=(replace(netlist.layers[0], unread=(gone,)), *netlist.layers[1:]))
    found = float_engine.run(float_engine.prepare(network, quiet), inputs)
    assert not found.elsewhere.any()
    assert_array_equal(found.spikes[:, 0], np.delete(wanted, gone, axis=2).sum(axis=(1, 2)))


def test_shorter_recordings_and_late_beginnings():
    network = lively(seed=4)
    netlist = compile_network(network, Options(keep_all=True)).netlist
    prepared = float_engine.prepare(network, netlist)
    inputs, lengths, begin = random_inputs(network.input.size, 4), np.array([30, 11, 1, 20]), np.array([0, 5, 0, 19])
    found, spikes = spikes_of(prepared, netlist, inputs, lengths=lengths, begin=begin)
    for i, (length, first) in enumerate(zip(lengths.tolist(), begin.tolist(), strict=True)):
        alone = run_float(network, inputs[i : i + 1, :, :length].transpose(0, 2, 1).astype(bool)).spikes
        for ours, theirs in zip(spikes, alone, strict=True):
            assert_array_equal(ours[i, :length], theirs[0])
            assert not ours[i, length:].any()
        assert found.spikes[i].tolist() == [int(s[0, first:].sum()) for s in alone]
        assert_array_equal(found.votes[i], readout_counts(network.readout, network.classes, alone[-1][:, first:])[0])


def test_a_window_that_opens_late_misses_the_first_steps():
    network = lively(weights=2, seed=6)
    netlist = compile_network(network, Options(keep_all=True)).netlist
    late = replace(netlist, layers=(netlist.layers[0], replace(netlist.layers[1], depth=netlist.layers[1].depth + 3)))
    inputs = random_inputs(network.input.size, 6)
    first = run_float(network, inputs.transpose(0, 2, 1).astype(bool)).spikes[0]
    alone = chain(network.projections[1].weight.toarray(), biases=[network.populations[1].bias])
    heard_late = np.zeros_like(first)
    heard_late[:, :-3] = first[:, 3:]
    wanted = run_float(alone, heard_late).spikes[0]
    _, spikes = spikes_of(float_engine.prepare(network, late), late, inputs)
    assert_array_equal(spikes[1], wanted)
    assert not np.array_equal(wanted, run_float(network, inputs.transpose(0, 2, 1).astype(bool)).spikes[1])
