"""What the compiler refuses: the class of the error, the words that its message must hold, and the call."""

import dataclasses
import itertools

import numpy as np
import pytest
import random_networks as nets
from commands import refusal
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from oracles import assert_same_network, refused
from random_netlists import Axon, Neuron, build

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import CapacityError, DataError, FormatError, ModelError, OptionError
from spikeloom.compiler.ir import INPUT, fan_in
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.storage import Exact, Packing
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, verify
from spikeloom.compiler.targets.loihi1.layout.choose import lay_out, least_cores
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.legalize import require_legal
from spikeloom.compiler.targets.loihi1.lift import lift
from spikeloom.compiler.targets.loihi1.netlist import Netlist, write_netlist
from spikeloom.compiler.targets.loihi1.options import Options
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage


@given(nets.integer_networks(), nets.tight_targets())
def test_the_netlist_holds_exactly_the_network(network, target):
    netlist = nets.seated(network, nets.legal_partition(network, target), target)
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
        for pre, weight in nets.dense_weights(network, post).items():
            assert_array_equal(dense[pre, post], weight)


def test_lists_are_sparse_where_that_saves_visits():
    """Four of ten neurons: sparse although dense would save no word; eight of ten: dense."""
    few, many = np.zeros((10, 1), int), np.full((10, 1), 2)
    few[[0, 3, 6, 9]] = 2
    many[[4, 5]] = 0
    assert nets.compiled(nets.integer_chain(few)).n_synapses == 4
    netlist = nets.compiled(nets.integer_chain(many))
    assert netlist.synapse_weight.tolist() == [2, 2, 2, 2, 0, 0, 2, 2, 2, 2]


def test_lists_are_dense_where_memory_is_short():
    """48 of 64 neurons: 11 words sparse, 9 dense."""
    weights = np.full((64, 1), 2)
    weights[1:33:2] = 0
    network = nets.integer_chain(weights)
    assert nets.compiled(network).n_synapses == 48
    assert nets.compiled(network, nets.small_target(core_synapse_words=9)).n_synapses == 64


def test_a_network_of_zeros_has_cores_but_no_axons():
    netlist = nets.compiled(nets.integer_chain(np.zeros((3, 2)), np.zeros((2, 3))))
    assert (netlist.n_cores, netlist.n_compartments, netlist.n_axons, netlist.n_synapses) == (1, 5, 0, 0)
    require_legal(netlist, nets.LOIHI)


def lower(network: IntegerNetwork, **limits: int) -> Netlist:
    """Netlist of a network on cores of these limits."""
    return nets.compiled(network, nets.small_target(**limits))


@given(nets.integer_networks(), st.sampled_from([1, 3, 1024]))
def test_emit_and_back(network, compartments):
    try:
        netlist = lower(network, core_compartments=compartments)
    except CapacityError:
        assume(False)
    found = lift(netlist)
    verify(found)  # a projection without synapses is kept
    assert_same_network(found, network)
    for index, layer in enumerate(netlist.layers):
        into = fan_in(network, index)
        assert (layer.synapses, layer.max_fan_in) == (into.sum(), into.max())
        assert layer.weight_bits == max(p.bits for p in network.projections if p.post == index)
    for ours, theirs in zip(found.populations, network.populations, strict=True):
        assert ours.name == theirs.name
        assert_array_equal(ours.scale, theirs.scale)
    assert all(np.all(projection.weight.data != 0) for projection in found.projections)
    formats = {(p.pre, p.post): (p.bits, p.exponent) for p in network.projections if np.any(p.weight.data)}
    kept = {(p.pre, p.post): (p.bits, p.exponent) for p in found.projections if p.weight.nnz}
    assert kept == formats


def netlist_of(*neurons: Neuron) -> Netlist:
    netlist = build(list(neurons), [Axon(source=0, targets=((0, 2),))], n_inputs=1, depths=[0, 0])
    return dataclasses.replace(netlist, readout_class=read_only([0] * len(neurons)))


@pytest.mark.parametrize("field", ["decay_u", "decay_v"])
def test_different_decays_in_a_layer_are_refused(field, tmp_path):
    netlist, file = netlist_of(Neuron(), Neuron(**{field: 7}), Neuron(layer=1)), tmp_path / "net.loom"
    refused(FormatError, f"layer0|2 values of {field}", lift, netlist)
    write_netlist(netlist, file)
    said = refusal("export", file, "--to", "nir", "-o", tmp_path / "out.nir")
    assert said.startswith(f"{file}: layer layer0: has 2 values of {field}")


@pytest.mark.parametrize(("votes", "layers"), [([-1, -1], 0), ([0, 0], 2)])
def test_one_layer_votes(votes, layers):
    netlist = dataclasses.replace(netlist_of(Neuron(), Neuron(layer=1)), readout_class=read_only(votes))
    refused(FormatError, f"{layers} layers vote", lift, netlist)


EVENTS = np.ones((2, 5, 2, 8), np.uint8)
WIDTHS = "2, 3, 4, 5, 6, 8"


def compiling(graph=5, **options):
    return lambda: compile_network(expand(nets.random_checkpoint(), nets.ring(graph)), Options(**options))


def rounding(weight=1.0, **options):
    return lambda: choose_storage(nets.chain([[weight]]), nets.LOIHI, **options)


def calibrating(shape):
    return lambda: calibrate(nets.chain([[1.0, 1.0]]), np.zeros(shape, bool))


def full(*sizes):
    return nets.integer_chain(*[nets.varied(post, pre) for pre, post in itertools.pairwise(sizes)])


def laying_out(sizes, target=nets.LOIHI, **cores_for):
    return lambda: lay_out(full(*sizes), target, cores_for=cores_for)


def cutting(sizes, **limits):
    return lambda: partition(full(*sizes), nets.small_target(**limits))


OPTIONS = [
    ("--prune-unused|--calibrate|--keep-all", compiling(prune_unused=True)),
    ("--prune-unused|--keep-all", compiling(prune_unused=True, training_events=EVENTS, keep_all=True)),
    ("--spike-exact|--calibrate", compiling(storage=Exact())),
    (f"--weight-bits 7|{WIDTHS}", compiling(storage=Exact(7), training_events=EVENTS)),
    *(
        (f"--weight-bits {bits}|{WIDTHS}", rounding(packings=(Packing(bits=bits),)))
        for bits in (-1, 0, 1, 7, 9)
    ),
    *((f"--planes {planes}|1 to 3", rounding(packings=(Packing(planes=planes),))) for planes in (0, 4)),
    *((f"--scale-groups {n}|8 thresholds|1 to 8", rounding(packings=(Packing(groups=n),))) for n in (0, 9)),
    ("--weight-bits: 2 layers|the network has 1", rounding(packings=(Packing(), Packing()))),
    ("--cores-for fc1=2|3 cores at least", laying_out((2496, 128), fc1=2)),
    # four neurons of seven output axons a core: three listening cores each let two of them sit together
    (
        "--cores-for fc1=1|2 cores at least",
        laying_out((1, 4, 9), nets.small_target(core_axons_out=7), fc1=1, fc2=3),
    ),
    (
        "--cores-for fc1=7|3 chips|6 cores",
        lambda: least_cores(full(6, 8), {"fc1": 7}, nets.small_target(chip_cores=2), 3),
    ),
]
NETWORKS = [("fc1|6 bits|32767 units|more bits", rounding(1e6, packings=(Packing(bits=6),)))]
RECORDINGS = [
    ("calibration|split is empty", compiling(training_events=EVENTS[:0])),
    ("calibration|split is empty", calibrating((0, 5, 2))),
    ("3 channels|has 2", calibrating((1, 5, 3))),
]
CAPACITIES = [
    (
        "fc1 neuron 0: 8 used, 7 allowed (loihi1.core.axons_out)",
        laying_out((1, 1, 8), nets.small_target(core_axons_out=7), fc2=8),
    ),
    ("chip: 129 used, 128 allowed (loihi1.chip.cores)", laying_out((3, 100, 100), fc1=100, fc2=29)),
    (
        "2 chips: 5 used, 4 allowed (loihi1.chip.cores)|--chips",
        lambda: partition(full(1, 5), nets.small_target(core_compartments=1, chip_cores=2), chips=2),
    ),
    ("fc1 neuron 0: 4097 used, 4096 allowed (loihi1.core.axons_in)", cutting((4097, 1))),
    (
        "neuron 0: 16385 used, 4096 allowed (loihi1.core.axons_in)|\n"
        "fc1 neuron 0: 119 used, 118 allowed (loihi1.core.synapse_words)",
        cutting((16385, 1), core_synapse_words=118),
    ),
    (
        "fc1 neuron 0: 5 used, 4 allowed (loihi1.core.axons_out); split the layers that it feeds",
        cutting((1, 1, 5), core_axons_out=4, core_compartments=1),
    ),
    ("fc1 neuron 0: 5 used, 4 allowed (loihi1.core.synapse_words)", cutting((5, 1), core_synapse_words=4)),
    *(
        (f"fc1 neuron 0: 1 used, 0 allowed (loihi1.core.{rule})", cutting((1, 1), **{f"core_{rule}": 0}))
        for rule in ("compartments", "threshold_slots", "compartment_configs")
    ),
]
TABLE = {OptionError: OPTIONS, ModelError: NETWORKS, DataError: RECORDINGS, CapacityError: CAPACITIES}


@pytest.mark.parametrize(
    ("error", "words", "call"), [(error, *row) for error, rows in TABLE.items() for row in rows]
)
def test_what_cannot_be_had_is_refused(error, words, call):
    refused(error, words, call)


def test_what_is_just_allowed():
    assert least_cores(full(2496, 128), {"fc1": 3}, nets.LOIHI) == {0: 3}
    assert least_cores(full(6, 8), {"fc1": 6}, nets.small_target(chip_cores=2), 3) == {0: 6}
    assert len(partition(full(4096, 1), nets.LOIHI)) == 1
    assert len(partition(full(1, 128 * 8), nets.small_target(core_compartments=8))) == 128
    assert len(cutting((1, 1, 5), core_axons_out=5, core_compartments=1)()) == 6
    assert len(partition(full(1, 4, 9), nets.small_target(core_axons_out=7), cores_for={1: 3})) == 5
