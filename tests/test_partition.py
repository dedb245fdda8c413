import itertools
from dataclasses import replace

import numpy as np
import pytest
import random_networks as nets
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from oracles import refused

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.ir import INPUT, Input, Readout
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerProjection
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, index_bits
from spikeloom.compiler.targets.loihi1.layout.partition import core_bound, partition
from spikeloom.compiler.targets.loihi1.layout.place import core_traffic, place
from spikeloom.compiler.targets.loihi1.legalize import (
    REMEDIES,
    LimitUse,
    list_words,
    measure,
    require_legal,
    words_of_axons,
)


def sizes(parts):
    return [[(chunk.population, chunk.first, chunk.last) for chunk in core] for core in parts]


@given(
    st.integers(0, 1024), st.sampled_from([2, 3, 4, 5, 6, 8]), st.sampled_from([0, 6, 7, 8, 9, 10, 11, 12])
)
def test_words_of_any_list(entries, weight_bits, index):
    words = int(list_words(np.array(entries), weight_bits, index, nets.LOIHI))
    assert words == nets.words_of_list(entries, weight_bits, index)
    # Growing a list never frees a word, which the search for the largest chunk relies on.
    assert words <= int(list_words(np.array(entries + 1), weight_bits, index, nets.LOIHI))


@pytest.mark.parametrize(
    ("highest", "bits"), [(0, 6), (63, 6), (64, 7), (127, 7), (128, 8), (511, 9), (1023, 10)]
)
def test_a_sparse_index_is_as_narrow_as_it_can_be(highest, bits):
    assert index_bits(highest, nets.LOIHI) == bits


@pytest.mark.parametrize(("neurons", "cores"), [(1024, 1), (1025, 2), (2048, 2), (2496, 3)])
def test_a_layer_is_split_at_1024_compartments(neurons, cores):
    network = nets.integer_chain(np.full((neurons, 1), 2))
    assert len(partition(network, nets.LOIHI)) == core_bound(network, nets.LOIHI) == cores


def with_thresholds(count):
    """Twenty neurons of so many thresholds."""
    return nets.integer_chain(np.full((20, 1), 2), thresholds=[[*range(1, count + 1), *[1] * (20 - count)]])


@pytest.mark.parametrize(
    ("network", "target", "cores"),
    [
        # 128 neurons of fan-in 2496 need 44,928 words; up to 46 cost 6 words a list (46 * 8 + 10 bits), 47 cost 7
        (
            nets.integer_chain(nets.varied(128, 2496)),
            nets.LOIHI,
            [[(0, 0, 46)], [(0, 46, 92)], [(0, 92, 128)]],
        ),
        # nine thresholds are one too many for a core
        (with_thresholds(8), nets.LOIHI, [[(0, 0, 20)]]),
        (with_thresholds(9), nets.LOIHI, [[(0, 0, 8)], [(0, 8, 20)]]),
        # each neuron feeds three cores, a core may have seven output axons
        (
            nets.integer_chain(np.full((4, 1), 2), np.full((9, 4), 2)),
            nets.small_target(core_axons_out=7, core_compartments=3),
            [[(0, 0, 2)], [(0, 2, 4)], [(1, 0, 3)], [(1, 3, 6)], [(1, 6, 9)]],
        ),
    ],
)
def test_a_layer_is_split_by_memory_thresholds_and_output_axons(network, target, cores):
    assert sizes(partition(network, target)) == cores


def fan_in_of_formats(exponents):
    """One neuron with four inputs through projections of these exponents."""
    return IntegerNetwork(
        input=Input(taxels=4, polarities=1),
        populations=(nets.integer_population("fc1", 1),),
        projections=tuple(
            IntegerProjection(
                pre=INPUT, post=0, weight=nets.stored(np.array([[2, 2, 4, 6]])), exponent=exponent, bits=8
            )
            for exponent in exponents
        ),
        readout=Readout(population=0, label=np.array([0])),
        classes=1,
    )


def test_seven_formats_fit_a_core_and_eight_do_not():
    for exponents, formats in ((range(7), 7), ([0] * 9, 1)):  # projections of one format share its slot
        netlist = nets.compiled(fan_in_of_formats(exponents))
        assert (netlist.n_cores, len(netlist.format_exponent)) == (1, formats)
    words = "fc1 neuron 0: 8 used, 7 allowed (loihi1.core.synapse_formats)"
    refused(CapacityError, words, partition, fan_in_of_formats(range(-1, 7)), nets.LOIHI)


@given(nets.integer_networks(), nets.tight_targets())
def test_every_limit_is_kept(network, target):
    parts = nets.legal_partition(network, target)
    netlist = nets.seated(network, parts, target)
    used = nets.counted(netlist, target)
    for core, uses in enumerate(used):
        for rule, amount in uses.items():
            assert amount <= target.limit(rule), (core, rule)
    per_core = [
        LimitUse(name=rule, used=used[core][rule], allowed=target.limit(rule), core=core)
        for rule in used[0]
        for core in range(netlist.n_cores)
    ]
    tiles = target.limit("mesh.width") * target.limit(
        "mesh.height"
    )  # a core is on each: the next are another chip's
    cores = LimitUse(name="chip.cores", used=min(netlist.n_cores, tiles), allowed=128, core=None)
    assert measure(netlist, target) == (*per_core, cores)
    assert require_legal(netlist, target) == measure(netlist, target)


def groupings(items):
    """All ways to split a list in groups."""
    if not items:
        yield []
        return
    head, *tail = items
    for rest in groupings(tail):
        yield [[head], *rest]
        for i, group in enumerate(rest):
            yield [*rest[:i], [head, *group], *rest[i + 1 :]]


@settings(max_examples=15)
@given(nets.integer_networks(exponents=(0,), bits=(8,)), nets.roomy_targets())
def test_no_grouping_of_the_chunks_needs_fewer_cores(network, target):
    parts = nets.legal_partition(network, target)
    chunks = [chunk for core in parts for chunk in core]
    assume(2 <= len(chunks) <= 6)
    known = {}

    def legal(group):
        """Whether these chunks keep every limit on one core; each other chunk sits alone."""
        if frozenset(group) not in known:
            cores = (tuple(group), *((chunk,) for chunk in chunks if chunk not in group))
            netlist = nets.seated(network, cores, target)
            used = nets.counted(netlist, target, cores)[0]
            known[frozenset(group)] = all(amount <= target.limit(rule) for rule, amount in used.items())
        return known[frozenset(group)]

    fewest = min(len(groups) for groups in groupings(chunks) if all(legal(group) for group in groups))
    assert len(parts) == fewest


def test_among_equal_packings_the_one_with_least_traffic_is_taken():
    """Three layers, two to a core: the pair with most spikes between them stays together."""
    network = nets.integer_chain(np.full((3, 1), 2), np.full((3, 3), 2), np.full((3, 3), 2))
    target = nets.small_target(core_compartments=6)

    def rates(first, second):
        return tuple(np.full(3, rate) for rate in (first, second, 0.1))

    assert sizes(partition(network, target, rates(0.9, 0.1))) == [[(0, 0, 3), (1, 0, 3)], [(2, 0, 3)]]
    assert sizes(partition(network, target, rates(0.1, 0.9))) == [[(0, 0, 3)], [(1, 0, 3), (2, 0, 3)]]


def test_what_a_convolution_repeats_is_stored_once_for_every_257_compartments():
    """Three lists of three synapses start below 257, 514 and 771; two of one and two of two are cut by the ends."""
    weights = sum(np.eye(600, 602, k, int) * weight for k, weight in enumerate((2, -4, 6)))
    network = nets.integer_chain(weights)
    netlist = nets.seated(network, partition(network, nets.LOIHI), nets.LOIHI)
    words = [use.used for use in measure(netlist, nets.LOIHI) if use.name == "core.synapse_words"]
    assert (words, words_of_axons(netlist, nets.LOIHI).sum()) == ([7], 602)
    assert len(partition(network, nets.small_target(core_synapse_words=7))) == 1
    assert len(partition(network, nets.small_target(core_synapse_words=6))) == 2


def test_a_list_declared_dense_takes_memory_from_its_first_place_to_its_last():
    """A file may leave places out, and their order open."""
    network = nets.integer_chain(np.array([[2, 0], [0, 4], [0, 0], [6, 0], [8, 10]]))
    sparse = nets.seated(network, partition(network, nets.LOIHI), nets.LOIHI)
    turned = sparse.synapse_target.copy()
    turned[:2] = turned[1::-1]  # out of order
    netlist = replace(
        sparse, format_index_bits=np.zeros_like(sparse.format_index_bits), synapse_target=turned
    )
    used = {use.name: use.used for use in measure(netlist, nets.LOIHI)}
    words = list_words(np.array([5, 4]), netlist.format_weight_bits[0], 0, nets.LOIHI)
    assert words_of_axons(netlist, nets.LOIHI).tolist() == words.tolist()
    assert (used["core.synapse_words"], used["core.dense_base"]) == (words.sum(), 1)


def test_the_neuron_that_breaks_a_rule_most_is_named():
    weights = np.full((4, 9), 2)
    weights[0, 5:] = weights[1, 2:] = weights[3, 7:] = 0
    words = "fc1 neuron 2: 9 used, 4 allowed (loihi1.core.axons_in)"
    refused(CapacityError, words, partition, nets.integer_chain(weights), nets.small_target(core_axons_in=4))


def test_an_illegal_netlist_is_refused_with_every_violation():
    network = nets.integer_chain(nets.varied(4, 3), nets.varied(2, 4), thresholds=[[1, 2, 3, 4], 5])
    used = {
        "core.compartments": 6,
        "core.axons_in": 7,
        "core.axons_out": 4,
        "core.synapse_words": 7,
        "core.threshold_slots": 5,
        "core.synapse_formats": 1,
        "core.compartment_configs": 1,
        "chip.cores": 1,
    }
    target = nets.small_target(**{rule.replace(".", "_", 1): amount - 1 for rule, amount in used.items()})
    with pytest.raises(CapacityError) as caught:
        require_legal(nets.compiled(network), target)
    lines = str(caught.value).splitlines()
    for line, (rule, amount) in zip(lines, used.items(), strict=True):
        where = "chip" if rule == "chip.cores" else "core 0 (fc1, fc2)"
        assert line == f"{where}: {amount} used, {amount - 1} allowed (loihi1.{rule}); {REMEDIES[rule]}"
    assert [violation.rule for violation in caught.value.violations] == [f"loihi1.{rule}" for rule in used]


def test_a_dense_list_that_starts_too_high_is_refused():
    network = nets.integer_chain(np.full((300, 1), 2), np.full((40, 300), 2))
    cores = ((Chunk(population=0, first=0, last=300), Chunk(population=1, first=0, last=40)),)
    netlist = nets.seated(network, cores, nets.small_target(core_dense_base=400))
    words = "core 0 (fc1, fc2): 300 used, 256 allowed (loihi1.core.dense_base)"
    refused(CapacityError, words, require_legal, netlist, nets.LOIHI)


@pytest.mark.parametrize(("layers", "cores"), [(10, 5), (12, 6)])
def test_any_two_of_many_layers_fit_a_core_and_no_three_do(layers, cores):
    """The worst case of the exhaustive search; more chunks are packed by first fit."""
    network, target = (
        nets.integer_chain(*[np.full((3, 3), 2)] * layers),
        nets.small_target(core_compartments=6),
    )
    assert len(partition(network, target)) == core_bound(network, target) == cores


def cost(traffic, tiles, width):
    """Spikes times hops of a layout, or of each of several (…, cores)."""
    x, y = np.asarray(tiles) % width, np.asarray(tiles) // width
    ways = abs(x[..., :, None] - x[..., None, :]) + abs(y[..., :, None] - y[..., None, :])
    return (traffic * ways).sum(axis=(-1, -2))


def brute_force(traffic, width, height, tile_cores):
    """Least cost of all layouts."""
    layouts = np.array(list(itertools.product(range(width * height), repeat=len(traffic))))
    held = (layouts[:, :, None] == np.arange(width * height)).sum(axis=1)
    return cost(traffic, layouts[held.max(axis=1) <= tile_cores], width).min()


def layered(rng, cores):
    """Three groups of cores that talk from one to the next, as the layers of a network do."""
    group = np.sort(rng.integers(0, 3, cores))
    return np.where(group[:, None] + 1 == group, rng.random((cores, cores)), 0.0)


KINDS = {
    "random": lambda rng, cores: rng.random((cores, cores)),
    "whole": lambda rng, cores: rng.integers(0, 3, (cores, cores)).astype(float),
    "layered": layered,
    "equal": lambda _, cores: np.ones((cores, cores)),
    "star": lambda _, cores: np.outer(np.arange(cores) == 0, np.ones(cores)),
}


@settings(max_examples=15)
@given(
    st.integers(1, 5),
    st.sampled_from([(3, 2, 1), (3, 3, 2), (2, 2, 2), (5, 1, 1), (1, 5, 2)]),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["random", "whole", "layered"]),
)
def test_the_optimum_of_small_cases(cores, mesh, seed, kind):
    width, height, tile_cores = mesh
    cores = min(cores, width * height * tile_cores)
    traffic = KINDS[kind](np.random.default_rng(seed), cores)
    target = nets.small_target(mesh_width=width, mesh_height=height, mesh_tile_cores=tile_cores)
    placement = place(traffic, target)
    assert placement.spike_hops == pytest.approx(
        brute_force(traffic, width, height, tile_cores), rel=1e-9, abs=1e-12
    )
    assert placement.spike_hops == pytest.approx(cost(traffic, placement.tiles, width), abs=1e-12)
    assert max(placement.tiles.count(tile) for tile in placement.tiles) <= tile_cores
    assert set(placement.tiles) <= set(range(width * height))


@pytest.mark.parametrize(("kind", "cores"), [("random", 12), ("star", 12), ("layered", 64)])
def test_many_cores_are_placed_well(cores, kind):
    rng = np.random.default_rng(1)
    traffic = KINDS[kind](rng, cores)
    placement = place(traffic, nets.LOIHI)
    assert cores > 12 or place(traffic.copy(), nets.LOIHI) == placement
    assert max(placement.tiles.count(tile) for tile in placement.tiles) <= 4
    assert placement.spike_hops == pytest.approx(cost(traffic, placement.tiles, 8))
    shuffled = [cost(traffic, rng.permutation(128)[:cores] // 4, 8) for _ in range(50)]
    assert placement.spike_hops <= min(shuffled)
    assert placement.spike_hops <= cost(traffic, np.arange(cores) // 4, 8) * (1 + 1e-9)


@given(nets.integer_networks(), st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_traffic_is_a_packet_per_listening_axon(network, compartments, seed):
    rng = np.random.default_rng(seed)
    rates = tuple(rng.random(population.size) for population in network.populations)
    target = nets.small_target(core_compartments=compartments)
    parts = partition(network, target, rates)
    netlist = nets.seated(network, parts, target)
    expected = np.zeros((netlist.n_cores,) * 2)
    core_of_axon, core_of_compartment = netlist.core_of_axon(), netlist.core_of_compartment()
    for axon, source in enumerate(netlist.axon_source.tolist()):
        if source >= netlist.n_inputs:
            compartment = source - netlist.n_inputs
            rate = rates[netlist.layer[compartment]][netlist.neuron[compartment]]
            expected[core_of_compartment[compartment], core_of_axon[axon]] += rate
    assert_allclose(core_traffic(network, parts, rates), expected, rtol=1e-12)
