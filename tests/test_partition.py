import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from random_networks import (
    LOIHI,
    dense_weights,
    float_networks,
    integer_chain,
    integer_networks,
    integer_population,
    recordings_for,
    small_target,
    stored,
)

from compiler.errors import CapacityError
from compiler.interpret import run_integer
from compiler.ir import INPUT, Input, IntegerNetwork, IntegerProjection, Readout
from compiler.passes.emit import emit
from compiler.passes.legalize import LimitUse, list_words, measure, require_legal
from compiler.passes.partition import Chunk, Partition, index_bits, partition
from compiler.passes.quantize import quantize
from runtime import spec
from runtime.trace import aligned

MIXED = [8, 6, 4, 2]


def compiled(network, target=LOIHI):
    """Netlist with core k on tile k."""
    parts = partition(network, target)
    return emit(network, parts, tuple(range(len(parts.cores))), target, {})


def sizes(parts):
    return [[(chunk.population, chunk.first, chunk.last) for chunk in core] for core in parts.cores]


def words_of_list(entries, weight_bits, index):
    """Blocks of up to 64 entries, ten header bits each, in whole words of 64 bits."""
    total = 0
    while entries > 0:
        block = min(entries, 64)
        total += math.ceil((block * (weight_bits + index) + 10) / 64)
        entries -= block
    return total


def counted(netlist):
    """Use of each limit by each core, counted one compartment and one axon at a time."""
    cores = []
    for core in range(netlist.n_cores):
        compartments = range(*netlist.core_compartments[core : core + 2])
        axons = range(*netlist.core_axons[core : core + 2])
        words, formats, base = 0, set(), 0
        for axon in axons:
            first, last = (int(bound) for bound in netlist.axon_synapses[axon : axon + 2])
            form = int(netlist.axon_format[axon])
            index = int(netlist.format_index_bits[form])
            words += words_of_list(last - first, int(netlist.format_weight_bits[form]), index)
            formats.add(form)
            if index == 0:
                base = max(base, int(netlist.synapse_target[first]))
        cores.append(
            {
                "core.compartments": len(compartments),
                "core.axons_in": len(axons),
                "core.axons_out": sum(int(s) - netlist.n_inputs in compartments for s in netlist.axon_source),
                "core.synapse_words": words,
                "core.threshold_slots": len({int(netlist.threshold[c]) for c in compartments}),
                "core.synapse_formats": len(formats),
                "core.compartment_configs": len(
                    {(int(netlist.decay_u[c]), int(netlist.decay_v[c])) for c in compartments}
                ),
                "core.dense_base": base,
            }
        )
    return cores


@st.composite
def tight_targets(draw):
    """Chips so small that ten neurons need several cores."""
    return small_target(
        core_compartments=draw(st.integers(1, 8)),
        core_axons_in=draw(st.integers(4, 30)),
        core_axons_out=draw(st.integers(2, 30)),
        core_synapse_words=draw(st.integers(6, 40)),
        core_threshold_slots=draw(st.integers(1, 4)),
        core_synapse_formats=draw(st.integers(2, 5)),
        core_compartment_configs=draw(st.integers(1, 3)),
        core_dense_base=draw(st.sampled_from([0, 3, 256])),
    )


@st.composite
def roomy_targets(draw):
    """Chips on which a core holds several small layers, whatever their order: dense lists may start anywhere."""
    return small_target(
        core_compartments=draw(st.integers(4, 10)),
        core_axons_in=draw(st.integers(10, 40)),
        core_axons_out=draw(st.integers(6, 40)),
        core_synapse_words=draw(st.integers(10, 50)),
        core_threshold_slots=draw(st.integers(4, 8)),
        core_compartment_configs=draw(st.integers(1, 3)),
    )


def legal_partition(network, target):
    try:
        return partition(network, target)
    except CapacityError:
        assume(False)


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


@settings(deadline=None)
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


@settings(deadline=None)
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


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.filter_too_much])
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
        "chip: 129 used, 128 allowed (loihi1.chip.cores); fewer neurons, fewer weight bits or a sparser graph"
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
        "chip: 1 used, 0 allowed (loihi1.chip.cores); fewer neurons, fewer weight bits or a sparser graph",
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


# --- the netlist is the network


@settings(deadline=None)
@given(integer_networks(), tight_targets())
def test_the_netlist_holds_exactly_the_network(network, target):
    parts = legal_partition(network, target)
    netlist = emit(network, parts, tuple(range(len(parts.cores))), target, {})
    core_of_axon, core_of_compartment = [], []
    for core in range(netlist.n_cores):
        core_of_axon += [core] * int(np.diff(netlist.core_axons)[core])
        core_of_compartment += [core] * int(np.diff(netlist.core_compartments)[core])
    dense = {
        (p.pre, p.post): np.zeros(
            (
                network.populations[p.post].size,
                network.input.size if p.pre == INPUT else network.populations[p.pre].size,
            ),
            np.int64,
        )
        for p in network.projections
    }
    nonzero = 0
    for axon in range(netlist.n_axons):
        source, form = int(netlist.axon_source[axon]), int(netlist.axon_format[axon])
        pre, column = INPUT, source
        if source >= netlist.n_inputs:
            compartment = source - netlist.n_inputs
            pre, column = int(netlist.layer[compartment]), int(netlist.neuron[compartment])
        exponent = int(netlist.format_exponent[form])
        entries = range(*netlist.axon_synapses[axon : axon + 2])
        targets = [int(netlist.synapse_target[s]) for s in entries]
        weights = [int(netlist.synapse_weight[s]) for s in entries]
        if netlist.format_index_bits[form] == 0:
            # A dense list has no indices: its targets are consecutive, and it begins and ends with a synapse.
            assert targets == list(range(targets[0], targets[0] + len(targets)))
            assert weights[0] != 0
            assert weights[-1] != 0
        else:
            assert targets == sorted(set(targets))
            assert 0 not in weights
            assert targets[-1] < 2 ** int(netlist.format_index_bits[form])
        for where, weight in zip(targets, weights, strict=True):
            assert weight % 2 ** (9 - int(netlist.format_weight_bits[form])) == 0
            target_id = int(netlist.core_compartments[core_of_axon[axon]]) + where
            assert core_of_compartment[target_id] == core_of_axon[axon]
            if weight:
                nonzero += 1
                row, post = int(netlist.neuron[target_id]), int(netlist.layer[target_id])
                dense[pre, post][row, column] += weight * 2**exponent if exponent >= 0 else weight // 2
    assert nonzero == sum(np.count_nonzero(p.weight.data) for p in network.projections)
    for post in range(len(network.populations)):
        for pre, weight in dense_weights(network, post).items():
            np.testing.assert_array_equal(dense[pre, post], weight)


@settings(deadline=None)
@given(integer_networks(), tight_targets())
def test_compartments_hold_the_registers_of_their_neurons(network, target):
    parts = legal_partition(network, target)
    netlist = emit(network, parts, tuple(range(len(parts.cores))), target, {"seed": 1})
    for index, population in enumerate(network.populations):
        ids = netlist.compartments_of(index)
        assert netlist.neuron[ids].tolist() == list(range(population.size))
        for field in ("threshold", "bias_mantissa", "bias_exponent"):
            np.testing.assert_array_equal(getattr(netlist, field)[ids], getattr(population, field))
        assert set(netlist.decay_u[ids].tolist()) == {population.decay_u}
        assert set(netlist.decay_v[ids].tolist()) == {population.decay_v}
        voting = index == network.readout.population
        expected = network.readout.label.tolist() if voting else [-1] * population.size
        assert netlist.readout_class[ids].tolist() == expected
        layer = netlist.layers[index]
        into = [p for p in network.projections if p.post == index]
        assert (layer.name, layer.neurons, layer.scale) == (population.name, population.size, population.scale)
        assert layer.synapses == sum(p.weight.nnz for p in into)
        assert layer.max_fan_in == max(sum(np.diff(p.weight.indptr) for p in into))
        assert layer.weight_bits == max(p.bits for p in into)
    assert (netlist.taxels, netlist.polarities) == (network.input.taxels, network.input.polarities)
    assert (netlist.classes, netlist.provenance, netlist.target) == (network.classes, {"seed": 1}, "loihi1")
    assert all(not getattr(netlist, name).flags.writeable for name in ("neuron", "axon_source", "synapse_weight"))


@settings(deadline=None, max_examples=50)
@given(st.data())
def test_the_chip_spikes_like_the_network(data):
    """Partition and emission change no spike: the specified chip step against the integer network."""
    network, _ = quantize(data.draw(float_networks()), LOIHI, bits=data.draw(st.sampled_from(MIXED)))
    target = data.draw(tight_targets())
    parts = legal_partition(network, target)
    netlist = emit(network, parts, tuple(range(len(parts.cores))), target, {})
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
