import dataclasses
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from random_networks import (
    LOIHI,
    compiled,
    counted,
    integer_chain,
    integer_networks,
    integer_population,
    legal_partition,
    roomy_targets,
    small_target,
    stored,
    tight_targets,
    words_of_list,
)

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.ir import INPUT, Input, IntegerNetwork, IntegerProjection, Readout
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, index_bits
from spikeloom.compiler.targets.loihi1.layout.partition import Partition, partition
from spikeloom.compiler.targets.loihi1.legalize import LimitUse, list_words, measure, require_legal

MIXED = [8, 6, 4, 2]


def sizes(parts):
    return [[(chunk.population, chunk.first, chunk.last) for chunk in core] for core in parts.cores]


# --- words


@pytest.mark.parametrize(
    ("entries", "weight_bits", "index", "words"),
    [
        (0, 8, 0, 0),
        (1, 8, 0, 1),
        (6, 8, 0, 1),  # 58 bits
        (7, 8, 0, 2),  # 66 bits
        (43, 8, 0, 6),
        (64, 8, 0, 9),  # 522 bits
        (65, 8, 0, 10),
        (128, 8, 0, 18),
        (1, 8, 10, 1),
        (3, 8, 10, 1),  # 64 bits
        (4, 8, 10, 2),
        (64, 2, 6, 9),
    ],
)
def test_words_of_a_list(entries, weight_bits, index, words):
    assert list_words(np.array([entries]), weight_bits, index, LOIHI).tolist() == [words]
    assert words_of_list(entries, weight_bits, index) == words


def test_the_published_size_of_fc1():
    assert 2496 * int(list_words(np.array(128), 8, 0, LOIHI)) == 44_928
    assert 2496 * int(list_words(np.array(43), 8, 0, LOIHI)) == 14_976


@given(st.integers(0, 1024), st.sampled_from([2, 3, 4, 5, 6, 8]), st.sampled_from([0, 6, 7, 8, 9, 10, 11, 12]))
def test_words_of_any_list(entries, weight_bits, index):
    words = int(list_words(np.array(entries), weight_bits, index, LOIHI))
    assert words == words_of_list(entries, weight_bits, index)
    # Growing a list never frees a word, which the search for the largest chunk relies on.
    assert words <= int(list_words(np.array(entries + 1), weight_bits, index, LOIHI))


@pytest.mark.parametrize(("highest", "bits"), [(0, 6), (63, 6), (64, 7), (127, 7), (128, 8), (511, 9), (1023, 10)])
def test_a_sparse_index_is_as_narrow_as_it_can_be(highest, bits):
    assert index_bits(highest, LOIHI) == bits


# --- splitting


def test_a_small_network_shares_one_core():
    network = integer_chain(np.full((4, 3), 2), np.full((2, 4), 2))
    assert sizes(partition(network, LOIHI)) == [[(0, 0, 4), (1, 0, 2)]]


@pytest.mark.parametrize(("neurons", "cores"), [(1024, 1), (1025, 2), (2048, 2), (2496, 3)])
def test_a_layer_is_split_at_1024_compartments(neurons, cores):
    parts = partition(integer_chain(np.full((neurons, 1), 2)), LOIHI)
    assert len(parts.cores) == parts.bound == cores


def test_a_layer_is_split_by_synaptic_memory():
    """128 neurons of fan-in 2496 need 44,928 words; chunks of 46 still fit in 16,384."""
    parts = partition(integer_chain(np.full((128, 2496), 2)), LOIHI)
    # up to 46 neurons cost 6 words a list (46 * 8 + 10 = 378 bits), 47 cost 7
    assert sizes(parts) == [[(0, 0, 46)], [(0, 46, 92)], [(0, 92, 128)]]
    assert parts.bound == 3


def test_a_layer_is_split_by_thresholds():
    """Nine thresholds are one too many for a core."""
    weights = np.full((20, 1), 2)
    eight, nine = ([list(range(1, n + 1)) + [1] * (20 - n)] for n in (8, 9))
    assert sizes(partition(integer_chain(weights, thresholds=eight), LOIHI)) == [[(0, 0, 20)]]
    assert sizes(partition(integer_chain(weights, thresholds=nine), LOIHI)) == [[(0, 0, 8)], [(0, 8, 20)]]


def test_a_layer_is_split_by_output_axons():
    """Each neuron feeds three cores, a core may have seven output axons."""
    network = integer_chain(np.full((4, 1), 2), np.full((9, 4), 2))
    target = small_target(core_axons_out=7, core_compartments=3)
    assert sizes(partition(network, target)) == [
        [(0, 0, 2)],
        [(0, 2, 4)],
        [(1, 0, 3)],
        [(1, 3, 6)],
        [(1, 6, 9)],
    ]


def test_different_decays_share_a_core_up_to_the_limit():
    network = integer_chain([[2]], [[2]], [[2]])
    decays = [3277, 3276, 3276]
    network = dataclasses.replace(
        network,
        populations=tuple(
            dataclasses.replace(p, decay_v=decay) for p, decay in zip(network.populations, decays, strict=True)
        ),
    )
    assert sizes(partition(network, small_target(core_compartment_configs=2))) == [[(0, 0, 1), (1, 0, 1), (2, 0, 1)]]
    assert sizes(partition(network, small_target(core_compartment_configs=1))) == [[(0, 0, 1)], [(1, 0, 1), (2, 0, 1)]]


def fan_in_of_formats(exponents):
    """One neuron that hears four inputs through projections of these exponents."""
    return IntegerNetwork(
        input=Input(taxels=4, polarities=1),
        populations=(integer_population("fc1", 1),),
        projections=tuple(
            IntegerProjection(pre=INPUT, post=0, weight=stored(np.array([[2, 2, 4, 6]])), exponent=exponent, bits=8)
            for exponent in exponents
        ),
        readout=Readout(population=0, label=np.array([0])),
        classes=1,
    )


def test_projections_of_one_format_share_its_slot():
    netlist = compiled(fan_in_of_formats([0] * 9))
    assert (netlist.n_cores, len(netlist.format_exponent)) == (1, 1)


def test_seven_formats_fit_a_core_and_eight_do_not():
    netlist = compiled(fan_in_of_formats(range(7)))
    assert (netlist.n_cores, len(netlist.format_exponent)) == (1, 7)
    with pytest.raises(CapacityError) as caught:
        partition(fan_in_of_formats(range(-1, 7)), LOIHI)
    assert str(caught.value) == (
        "fc1 neuron 0: 8 used, 7 allowed (loihi1.core.synapse_formats); fewer different weight formats on the core"
    )


def test_index_widths_count_as_formats():
    """Three sparse layers on one core may end at compartments that need wider and wider indices."""
    rng = np.random.default_rng(0)

    def sparse_layer(outputs, inputs):
        return np.where(rng.random((outputs, inputs)) < 0.1, 2, 0)

    network = integer_chain(sparse_layer(50, 20), sparse_layer(60, 50), sparse_layer(100, 60))
    for slots in range(1, 8):
        target = small_target(core_synapse_formats=slots)
        netlist = compiled(network, target)
        require_legal(netlist, target)
    assert netlist.n_cores == 1


# --- every limit


@settings(deadline=None, max_examples=60)
@given(integer_networks(), tight_targets())
def test_every_limit_is_kept(network, target):
    parts = legal_partition(network, target)
    netlist = emit(network, parts, tuple(range(len(parts.cores))), target, {})
    used = counted(netlist)
    for core, uses in enumerate(used):
        for rule, amount in uses.items():
            assert amount <= target.limit(rule), (core, rule)
    per_core = [
        LimitUse(name=rule, used=used[core][rule], allowed=target.limit(rule), core=core)
        for rule in used[0]
        for core in range(netlist.n_cores)
    ]
    cores = LimitUse(name="chip.cores", used=netlist.n_cores, allowed=128, core=None)
    assert measure(netlist, target) == (*per_core, cores)
    assert require_legal(netlist, target) == measure(netlist, target)


@settings(deadline=None, max_examples=60)
@given(integer_networks(), tight_targets())
def test_every_neuron_sits_on_one_core(network, target):
    parts = legal_partition(network, target)
    chunks = [chunk for core in parts.cores for chunk in core]
    seated = [(chunk.population, neuron) for chunk in chunks for neuron in range(chunk.first, chunk.last)]
    expected = [(i, n) for i, population in enumerate(network.populations) for n in range(population.size)]
    assert sorted(seated) == expected
    assert parts.bound <= len(parts.cores)
    assert partition(network, target).cores == parts.cores


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


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.filter_too_much])
@given(integer_networks(exponents=(0,), bits=(8,)), roomy_targets())
def test_no_grouping_of_the_chunks_needs_fewer_cores(network, target):
    parts = legal_partition(network, target)
    chunks = [chunk for core in parts.cores for chunk in core]
    assume(2 <= len(chunks) <= 6)
    known = {}

    def legal(group):
        """Whether these chunks keep every limit on one core; each other chunk sits alone."""
        if frozenset(group) not in known:
            cores = (tuple(group), *((chunk,) for chunk in chunks if chunk not in group))
            netlist = emit(network, Partition(cores=cores, bound=0), tuple(range(len(cores))), target, {})
            used = counted(netlist)[0]
            known[frozenset(group)] = all(amount <= target.limit(rule) for rule, amount in used.items())
        return known[frozenset(group)]

    fewest = min(len(groups) for groups in groupings(chunks) if all(legal(group) for group in groups))
    assert len(parts.cores) == fewest


def test_among_equal_packings_the_one_with_least_traffic_is_taken():
    """Three layers, two to a core: the pair with most spikes between them stays together."""
    network = integer_chain(np.full((3, 1), 2), np.full((3, 3), 2), np.full((3, 3), 2))
    target = small_target(core_compartments=6)

    def rates(first, second):
        return tuple(np.full(3, rate) for rate in (first, second, 0.1))

    assert sizes(partition(network, target, rates(0.9, 0.1))) == [[(0, 0, 3), (1, 0, 3)], [(2, 0, 3)]]
    assert sizes(partition(network, target, rates(0.1, 0.9))) == [[(0, 0, 3)], [(1, 0, 3), (2, 0, 3)]]


def test_packing_of_ten_chunks_takes_no_time():
    """Any two of ten layers fit a core, no three do: the worst case of the exhaustive search."""
    network = integer_chain(*[np.full((3, 3), 2)] * 10)
    start = time.perf_counter()
    parts = partition(network, small_target(core_compartments=6))
    assert len(parts.cores) == 5
    assert time.perf_counter() - start < 5


def test_many_chunks_are_packed_by_first_fit():
    network = integer_chain(*[np.full((3, 3), 2)] * 12)
    parts = partition(network, small_target(core_compartments=6))
    assert len(parts.cores) == parts.bound == 6


# --- networks that do not fit


def refused(network, target=LOIHI):
    with pytest.raises(CapacityError) as caught:
        partition(network, target)
    return str(caught.value)


def test_4096_inputs_fit_and_4097_do_not():
    assert len(partition(integer_chain(np.full((1, 4096), 2)), LOIHI).cores) == 1
    assert refused(integer_chain(np.full((1, 4097), 2))) == (
        "fc1 neuron 0: 4097 used, 4096 allowed (loihi1.core.axons_in); "
        "fewer inputs to the layer: fewer features, taxels or a grouped layer"
    )


def test_inputs_of_weight_zero_need_no_axon():
    weights = np.full((1, 5000), 2)
    weights[:, 4096:] = 0
    network = integer_chain(weights)
    kept = dataclasses.replace(network.projections[0], weight=stored(weights))
    assert len(partition(dataclasses.replace(network, projections=(kept,)), LOIHI).cores) == 1


def test_every_violation_of_a_neuron_is_listed():
    assert refused(integer_chain(np.full((1, 16385), 2))) == (
        "fc1 neuron 0: 16385 used, 4096 allowed (loihi1.core.axons_in); "
        "fewer inputs to the layer: fewer features, taxels or a grouped layer\n"
        "fc1 neuron 0: 16385 used, 16384 allowed (loihi1.core.synapse_words); "
        "fewer weight bits, fewer synapses or more cores"
    )


def test_the_neuron_that_breaks_a_rule_most_is_named():
    weights = np.full((4, 9), 2)
    weights[0, 5:] = weights[1, 2:] = weights[3, 7:] = 0
    assert refused(integer_chain(weights), small_target(core_axons_in=4)) == (
        "fc1 neuron 2: 9 used, 4 allowed (loihi1.core.axons_in); "
        "fewer inputs to the layer: fewer features, taxels or a grouped layer"
    )


def test_every_layer_that_does_not_fit_is_listed():
    network = integer_chain(np.full((3, 6), 2), np.full((5, 3), 2), np.full((1, 5), 2))
    assert refused(network, small_target(core_axons_in=4)) == (
        "fc1 neuron 0: 6 used, 4 allowed (loihi1.core.axons_in); "
        "fewer inputs to the layer: fewer features, taxels or a grouped layer\n"
        "fc3 neuron 0: 5 used, 4 allowed (loihi1.core.axons_in); "
        "fewer inputs to the layer: fewer features, taxels or a grouped layer"
    )


def test_a_neuron_that_feeds_too_many_cores():
    network = integer_chain([[2]], np.full((5, 1), 2))
    assert len(partition(network, small_target(core_axons_out=5, core_compartments=1)).cores) == 6
    assert refused(network, small_target(core_axons_out=4, core_compartments=1)) == (
        "fc1 neuron 0: 5 used, 4 allowed (loihi1.core.axons_out); "
        "split the layers that it feeds over fewer cores, or this one over more"
    )


def test_a_neuron_with_too_many_words():
    network = integer_chain(np.full((1, 5), 2))
    assert refused(network, small_target(core_synapse_words=4)) == (
        "fc1 neuron 0: 5 used, 4 allowed (loihi1.core.synapse_words); fewer weight bits, fewer synapses or more cores"
    )


@pytest.mark.parametrize(
    ("rule", "remedy"),
    [
        ("compartments", "split the layer over more cores"),
        ("threshold_slots", "fewer different thresholds on the core"),
        ("compartment_configs", "fewer different decays on the core"),
    ],
)
def test_a_core_that_holds_nothing(rule, remedy):
    message = f"fc1 neuron 0: 1 used, 0 allowed (loihi1.core.{rule}); {remedy}"
    assert refused(integer_chain([[2]]), small_target(**{f"core_{rule}": 0})) == message


def test_a_network_that_needs_too_many_cores():
    network = integer_chain(np.full((129 * 1024, 1), 2))
    assert refused(network) == (
        "chip: 129 used, 128 allowed (loihi1.chip.cores); fewer neurons or weight bits, a sparser graph or more --chips"
    )
    assert len(partition(integer_chain(np.full((128 * 1024, 1), 2)), LOIHI).cores) == 128


def test_an_illegal_netlist_is_refused_with_every_violation():
    network = integer_chain(np.full((4, 3), 2), np.full((2, 4), 2), thresholds=[[1, 2, 3, 4], 5])
    netlist = compiled(network)
    target = small_target(
        core_compartments=5,
        core_axons_in=6,
        core_axons_out=3,
        core_synapse_words=6,
        core_threshold_slots=4,
        core_synapse_formats=0,
        core_compartment_configs=0,
        chip_cores=0,
    )
    with pytest.raises(CapacityError) as caught:
        require_legal(netlist, target)
    assert str(caught.value).splitlines() == [
        "core 0 (fc1, fc2): 6 used, 5 allowed (loihi1.core.compartments); split the layer over more cores",
        "core 0 (fc1, fc2): 7 used, 6 allowed (loihi1.core.axons_in); fewer inputs to the layer: fewer features, "
        "taxels or a grouped layer",
        "core 0 (fc1, fc2): 4 used, 3 allowed (loihi1.core.axons_out); split the layers that it feeds over fewer "
        "cores, or this one over more",
        "core 0 (fc1, fc2): 7 used, 6 allowed (loihi1.core.synapse_words); fewer weight bits, fewer synapses or more "
        "cores",
        "core 0 (fc1, fc2): 5 used, 4 allowed (loihi1.core.threshold_slots); fewer different thresholds on the core",
        "core 0 (fc1, fc2): 1 used, 0 allowed (loihi1.core.synapse_formats); fewer different weight formats on the "
        "core",
        "core 0 (fc1, fc2): 1 used, 0 allowed (loihi1.core.compartment_configs); fewer different decays on the core",
        "chip: 1 used, 0 allowed (loihi1.chip.cores); fewer neurons or weight bits, a sparser graph or more --chips",
    ]
    assert [violation.rule for violation in caught.value.violations][:2] == [
        "loihi1.core.compartments",
        "loihi1.core.axons_in",
    ]


def test_a_dense_list_that_starts_too_high_is_refused():
    network = integer_chain(np.full((300, 1), 2), np.full((40, 300), 2))
    cores = ((Chunk(population=0, first=0, last=300), Chunk(population=1, first=0, last=40)),)
    netlist = emit(network, Partition(cores=cores, bound=1), (0,), small_target(core_dense_base=400), {})
    with pytest.raises(CapacityError) as caught:
        require_legal(netlist, LOIHI)
    assert str(caught.value) == (
        "core 0 (fc1, fc2): 300 used, 256 allowed (loihi1.core.dense_base); place the dense layer first on its core"
    )
