import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import (
    LOIHI,
    compiled,
    dense_weights,
    float_networks,
    integer_chain,
    integer_networks,
    legal_partition,
    recordings_for,
    seated,
    small_target,
    tight_targets,
)

from spikeloom.compiler import Packing
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.ir import INPUT, fan_in
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage
from spikeloom.runtime.machines.loihi1 import spec
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


@settings(deadline=None, max_examples=20)
@given(st.data())
def test_the_chip_spikes_like_the_network(data):
    """Partition and emission change no spike: the specified chip step against the integer network."""
    packing = Packing(bits=data.draw(st.sampled_from([8, 6, 4, 2])), planes=data.draw(st.integers(1, 2)))
    network, _ = choose_storage(data.draw(float_networks()), LOIHI, packings=(packing,))
    target = data.draw(tight_targets())
    parts = legal_partition(network, target)
    netlist = seated(network, parts, target)
    events = data.draw(recordings_for(network.input.size, samples=1))
    expected = run_integer(network, events, membranes=True)
    trace = spec.simulate(netlist, events[0].T)
    for layer in range(len(network.populations)):
        np.testing.assert_array_equal(aligned(netlist, trace.spikes, layer), expected.spikes[layer][0])
        np.testing.assert_array_equal(aligned(netlist, trace.membranes, layer), expected.membranes[layer][0])


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
