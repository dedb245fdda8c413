"""Damage done to netlist and float network alike: what changes, what does not, and that both change by as much."""

import numpy as np
import pytest
from made_files import ring, sparse_events
from numpy.testing import assert_allclose, assert_array_equal
from random_networks import chain, compiled, integer_chain, random_checkpoint
from timed_networks import written

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Fixed, Packing
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.registers import decay_registers
from spikeloom.models.graphs import normalised_adjacency
from spikeloom.runtime.machines.loihi1 import engine, spec
from spikeloom.runtime.machines.loihi1.blocks import lay_out_blocks
from spikeloom.runtime.studies.robustness.pair import Pair, float_layers
from spikeloom.runtime.studies.robustness.perturbations import (
    fewer_bits,
    layers_late,
    neurons_firing,
    neurons_silent,
    scale_thresholds,
    shorter_decay,
    weight_bit_flips,
)


def made(seed=0, packing=None, taxels=6):
    """What the chip stores of a small TactileSGNet."""
    checkpoint = random_checkpoint(taxels=taxels, features=4, sizes=(9, 8, 4), seed=seed)
    network = expand(checkpoint, normalised_adjacency(ring(taxels).edges, taxels))
    return Pair(
        netlist=compile_network(
            network, Options(storage=Fixed() if packing is None else Fixed(packing))
        ).netlist,
        network=network,
    ).memory


def timed(folder):
    """The same of a network with clocks and lasting currents."""
    _, seen = written(folder / "net.pt")
    network = expand(read_checkpoint(folder / "net.pt"), seen)
    return Pair(netlist=compile_network(network).netlist, network=network).memory


def drawn(seed=0):
    return np.random.default_rng(seed)


def inputs(memory, seed=0, samples=5, steps=24):
    return sparse_events(drawn(seed), samples, memory.netlist.n_inputs, steps, rate=0.3)


def weights(stage):
    return [projection.weight.toarray() for projection in stage.projections]


def in_model_units(netlist):
    """Weights that the chip has, in the float model's units, by layer."""
    found = []
    integer = lift(netlist)
    for post, population in enumerate(integer.populations):
        whole = sum(p.effective().toarray() for p in integer.projections if p.post == post)
        found.append(whole / population.scale[:, None])
    return found


def moved(before, after):
    """How far weights of both sides moved; they must have moved alike."""
    ours = [b - a for a, b in zip(weights(before.network), weights(after.network), strict=True)]
    theirs = [
        b - a for a, b in zip(in_model_units(before.netlist), in_model_units(after.netlist), strict=True)
    ]
    for one, other in zip(ours, theirs, strict=True):
        assert_allclose(one, other, atol=1e-9)
    return ours


@pytest.mark.parametrize("packing", [None, (Packing(bits=4),), (Packing(planes=2),)])
def test_float_weights_move_as_the_stored_ones_do(packing):
    memory = made(packing=packing)
    after = weight_bit_flips(memory, 0.02, drawn(1))
    assert any(m.any() for m in moved(memory, after))
    for old, new in zip(memory.network.projections, after.network.projections, strict=True):
        same = old.weight.toarray() == new.weight.toarray()
        assert same.mean() > 0.5


def test_flipped_bits_are_as_many_as_asked_and_two_flips_undo_each_other():
    memory = made()
    bits = 8 * memory.netlist.n_synapses
    after = weight_bit_flips(memory, 0.1, drawn(2))
    codes = [(p.netlist.synapse_weight.astype(int) // 2) & 255 for p in (memory, after)]
    flipped = sum(int(x).bit_count() for x in codes[0] ^ codes[1])
    assert abs(flipped - 0.1 * bits) < 5 * np.sqrt(0.09 * bits)
    assert np.all(after.netlist.synapse_weight % 2 == 0)
    assert after.netlist.synapse_weight.min() >= -256
    assert after.netlist.synapse_weight.max() <= 254
    none = weight_bit_flips(memory, 0.0, drawn())
    for same in (weight_bit_flips(after, 0.1, drawn(2)), none):
        assert_array_equal(same.netlist.synapse_weight, memory.netlist.synapse_weight)
    pairs = zip(none.network.projections, memory.network.projections, strict=True)
    assert all(ours.weight is theirs.weight for ours, theirs in pairs)


def test_fewer_bits_round_to_a_coarser_grid_and_hold_the_rest():
    memory = made()
    code = memory.netlist.synapse_weight.astype(int) // 2
    for width in (7, 5, 3, 2):
        after = fewer_bits(memory, width)
        kept = after.netlist.synapse_weight.astype(int) // 2
        step = 2 ** (8 - width)
        assert np.all(kept % step == 0)
        assert np.abs(kept // step).max() <= 2 ** (width - 1) - 1
        inside = np.abs(code) < step * (2 ** (width - 1) - 1)
        assert np.abs(kept - code)[inside].max() <= step // 2
        moved(memory, after)
    assert_array_equal(fewer_bits(memory, 8).netlist.synapse_weight, memory.netlist.synapse_weight)


def both_spikes(memory, events):
    """Whether each neuron of each side fires in each step: of the chip, and of the float network by layer."""
    trace = engine.simulate(memory.netlist, events, spikes=True)
    pair = Pair(netlist=memory.netlist, network=memory.network)
    return trace.spikes, list(float_layers(pair, events, np.full(len(events), events.shape[2])))


@pytest.mark.parametrize("firing", [False, True])
def test_stuck_neurons_fire_in_every_step_or_never_on_both_sides(firing):
    memory = made()
    after = (neurons_firing if firing else neurons_silent)(memory, 0.4, drawn(3))
    stuck = np.flatnonzero(after.netlist.threshold == 0) if firing else _silenced(memory, after)
    assert len(stuck) == round(0.4 * len(memory.hidden))
    assert np.all(after.netlist.readout_class[stuck] < 0)
    events = inputs(memory)
    spikes, model = both_spikes(after, events)
    for compartment in stuck.tolist():
        layer = after.netlist.layer[compartment]
        depth = after.netlist.layers[layer].depth
        window = slice(depth, depth + events.shape[2])
        assert np.all(spikes[:, window, compartment] == firing)
        assert np.all(model[layer][..., after.netlist.neuron[compartment]] == firing)


def _silenced(before, after):
    """Compartments whose bias and weights are all zero now."""
    target = after.netlist.synapse_compartment()
    heard = np.bincount(target, np.abs(after.netlist.synapse_weight), after.netlist.n_compartments)
    was = np.bincount(target, np.abs(before.netlist.synapse_weight), after.netlist.n_compartments)
    return np.flatnonzero((heard == 0) & (was > 0) & (after.netlist.bias_mantissa == 0))


def test_voters_and_relays_are_spared(tmp_path):
    memory = timed(tmp_path)
    network = memory.network
    netlist = memory.netlist
    relays = (netlist.layer == 0) & (netlist.neuron >= network.populations[0].size - 3)
    assert relays.sum() == 3
    hidden = memory.hidden
    assert not relays[hidden].any()
    assert np.all(netlist.readout_class[hidden] < 0)
    assert len(hidden) == netlist.n_compartments - 3 - np.count_nonzero(netlist.readout_class >= 0)
    after = scale_thresholds(memory, 3.0)
    assert_array_equal(after.netlist.threshold[relays], netlist.threshold[relays])
    assert_array_equal(after.netlist.threshold[~relays], 3 * netlist.threshold[~relays])


def test_thresholds_change_on_both_sides_by_the_same_factor():
    memory = made()
    after = scale_thresholds(memory, 1.5)
    assert_array_equal(after.netlist.threshold, np.rint(1.5 * memory.netlist.threshold))
    for post, (old, new) in enumerate(
        zip(memory.network.populations, after.network.populations, strict=True)
    ):
        ids = memory.netlist.compartments_of(post)
        held = memory.netlist.neuron[ids]
        factor = memory.netlist.threshold[ids] / after.netlist.threshold[ids]
        assert_allclose(new.bias[held], old.bias[held] * factor)
        rows = [
            p.weight.toarray()[held]
            for p in (memory.network.projections[post], after.network.projections[post])
        ]
        assert_allclose(rows[1], rows[0] * factor[:, None])


def test_a_tie_does_not_fire_and_does_with_the_threshold_one_unit_lower():
    netlist = compiled(integer_chain([[2]], thresholds=[2]))
    network = chain([[0.5]])
    memory = Pair(netlist=netlist, network=network).memory
    events = np.ones((1, 1, 1), np.uint8)
    lower = memory.with_thresholds(memory.thresholds - 1)
    for one, fires in ((memory, False), (lower, True)):
        spikes, model = both_spikes(one, events)
        assert spikes.any() == fires
        assert model[0].any() == fires


def test_shorter_decay_on_both_sides(tmp_path):
    memory = timed(tmp_path)
    network = memory.network
    after = shorter_decay(memory, 0.5)
    for post, (old, new) in enumerate(zip(network.populations, after.network.populations, strict=True)):
        u, v = decay_registers(0.5 * old.beta, 0.5 * old.alpha)
        ids = memory.netlist.compartments_of(post)
        assert set(after.netlist.decay_u[ids].tolist()) == {u}
        assert set(after.netlist.decay_v[ids].tolist()) == {v}
        assert (new.alpha, new.beta) == ((4095 - u) / 4096, (4096 - v) / 4096)
        assert_allclose([new.alpha, new.beta], [0.5 * old.alpha, 0.5 * old.beta], atol=1e-3)


def test_windows_that_open_late_are_those_of_the_specification():
    memory = layers_late(made(), 2)
    assert [layer.depth for layer in memory.netlist.layers] == [0, 3, 4, 5]
    assert isinstance(lay_out_blocks(memory.netlist), str)
    events = inputs(memory, samples=1)
    fast, slow = (
        engine.simulate(memory.netlist, events, spikes=True),
        spec.simulate(memory.netlist, events[0]),
    )
    assert_array_equal(fast.spikes[0], slow.spikes)
