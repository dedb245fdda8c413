import dataclasses

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_networks import (
    LOIHI,
    chain,
    float_networks,
    integer_chain,
    integer_networks,
    stored,
)
from scipy import sparse

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import INPUT, Network, Projection, Readout, depths, fan_in, recurrent, to_networkx
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.netlist_text import netlist_text
from spikeloom.compiler.text import text

replace = dataclasses.replace


def small() -> Network:
    """Two layers, 3 -> 2 -> 2."""
    return chain([[1, 2, 3], [4, 5, 6]], [[1, 0], [0, 1]])


def with_population(network, index, **changes):
    populations = list(network.populations)
    populations[index] = replace(populations[index], **changes)
    return replace(network, populations=tuple(populations))


def with_projection(network, index, **changes):
    projections = list(network.projections)
    projections[index] = replace(projections[index], **changes)
    return replace(network, projections=tuple(projections))


def refused(network) -> str:
    with pytest.raises(VerifyError) as caught:
        verify(network)
    return str(caught.value)


# --- rules of both stages


@pytest.mark.parametrize("make", [chain, integer_chain])
def test_a_sound_network_passes(make):
    verify(make([[2, 4, 6], [8, 10, 12]], [[2, 0], [0, 2]]))


def test_two_populations_of_one_name():
    network = with_population(small(), 1, name="fc1")
    assert refused(network) == ("two populations are called 'fc1'")


def test_a_projection_of_the_wrong_shape():
    network = with_projection(small(), 0, weight=stored(np.ones((2, 4))))
    assert refused(network) == "projection 0 has shape (2, 4), its populations ask for (2, 3)"


@pytest.mark.parametrize(("pre", "expected"), [(7, "(2, None)"), (-2, "(2, None)")])
def test_a_projection_from_a_population_that_does_not_exist(pre, expected):
    message = refused(with_projection(small(), 1, pre=pre))
    assert message.startswith(f"projection 1 has shape (2, 2), its populations ask for {expected}")


def test_a_projection_to_a_population_that_does_not_exist():
    message = refused(with_projection(small(), 1, post=2))
    assert message == "projection 1 has shape (2, 2), its populations ask for (None, 2)"


def test_a_projection_into_the_input():
    message = refused(with_projection(small(), 1, post=INPUT, weight=stored(np.ones((3, 2)))))
    assert message == (
        "projection 1 has shape (3, 2), its populations ask for (3, 2); "
        "projection 1 runs from population 0 to -1, not forward"
    )


def test_repeated_synapses():
    twice = sparse.csr_array((np.ones(2), np.array([1, 1]), np.array([0, 2, 2])), shape=(2, 3))
    message = refused(with_projection(small(), 0, weight=twice))
    assert message == "projection 0 has unsorted or repeated synapses"


def test_a_projection_that_runs_in_a_circle():
    network = small()
    back = Projection(pre=1, post=0, weight=stored(np.ones((2, 2))))
    message = refused(replace(network, projections=(*network.projections, back)))
    assert message == (
        "projection 2 runs from population 1 to 0, not forward; "
        "projection 0 skips a layer: a spike takes one step on the chip, so it would arrive 1 early"
    )


def test_a_population_may_hear_itself_and_is_no_deeper_for_it():
    network = small()
    own = Projection(pre=1, post=1, weight=stored(np.ones((2, 2))))
    network = replace(network, projections=(*network.projections, own))
    verify(network)
    assert depths(network) == (0, 1)
    assert recurrent(network) == ("fc2",)
    alone = replace(network, projections=(network.projections[0], own))
    assert refused(alone) == "population 'fc2' is not reached from the input"


def test_a_projection_that_skips_a_layer():
    network = chain(np.ones((2, 3)), np.ones((2, 2)), np.ones((1, 2)))
    shortcut = Projection(pre=INPUT, post=2, weight=stored(np.ones((1, 3))))
    message = refused(replace(network, projections=(*network.projections, shortcut)))
    assert message == "projection 3 skips a layer: a spike takes one step on the chip, so it would arrive 2 early"


def test_a_population_that_nothing_reaches():
    network = small()
    assert refused(replace(network, projections=network.projections[1:])) == (
        "population 'fc1' is not reached from the input; population 'fc2' is not reached from the input"
    )


@pytest.mark.parametrize(
    ("readout", "message"),
    [
        (Readout(population=2, label=np.arange(2)), "the read-out names population 2"),
        (Readout(population=-1, label=np.arange(2)), "the read-out names population -1"),
        (Readout(population=1, label=np.arange(3)), "the read-out has 3 labels for another number of neurons"),
        (Readout(population=1, label=np.array([0, 2])), "the read-out has labels outside 0 … 1"),
        (Readout(population=1, label=np.array([-1, 0])), "the read-out has labels outside 0 … 1"),
    ],
)
def test_a_readout_that_does_not_fit(readout, message):
    assert refused(replace(small(), readout=readout)) == message


def test_all_broken_rules_are_listed():
    network = with_population(small(), 1, name="fc1", theta=0.0)
    assert refused(network) == (
        "two populations are called 'fc1'; population 'fc1' has beta 0.2 or theta 0.0 out of range"
    )


# --- rules of the float stage


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_biases_that_are_not_finite(value):
    network = with_population(small(), 0, bias=np.array([0.0, value]))
    assert refused(network) == "population 'fc1' has biases that are not finite"


@pytest.mark.parametrize(
    ("beta", "theta"), [(-0.1, 0.5), (1.1, 0.5), (np.nan, 0.5), (0.2, 0.0), (0.2, -1.0), (0.2, np.nan)]
)
def test_a_decay_or_threshold_out_of_range(beta, theta):
    network = with_population(small(), 0, beta=beta, theta=theta)
    assert refused(network) == f"population 'fc1' has beta {beta} or theta {theta} out of range"


@pytest.mark.parametrize("weight", [np.full((2, 3), np.nan), np.ones((2, 3), np.float32), np.ones((2, 3), np.int64)])
def test_weights_that_are_not_finite_float64(weight):
    network = with_projection(small(), 0, weight=stored(weight))
    assert refused(network) == "projection 0 has weights that are not finite float64"


# --- rules of the integer stage


@pytest.mark.parametrize(
    ("field", "good", "bad", "message"),
    [
        ("decay_u", (0, 4095), (-1, 4096), "population 'fc1' has a decay outside 0 … 4095"),
        ("decay_v", (0, 4095), (-1, 4096), "population 'fc1' has a decay outside 0 … 4095"),
        ("threshold", (0, 131071), (-1, 131072), "population 'fc1' has a threshold outside 0 … 131071"),
        ("bias_mantissa", (-4095, 4095), (-4096, 4096), "population 'fc1' has a bias mantissa beyond 4095"),
        ("bias_exponent", (0, 7), (-1, 8), "population 'fc1' has a bias exponent outside 0 … 7"),
    ],
)
def test_registers_at_their_ends_and_one_past_them(field, good, bad, message):
    network = integer_chain([[2, 4]])

    def changed(value):
        return with_population(network, 0, **{field: value if field.startswith("decay") else np.array([value])})

    for value in good:
        verify(changed(value))
    for value in bad:
        assert refused(changed(value)) == message


@pytest.mark.parametrize(
    ("bits", "good", "bad"),
    [(8, (-256, 254), (-258, 256, 3)), (4, (-256, 224), (256, 16)), (2, (128, -256), (256, 64))],
)
def test_mantissas_of_each_width(bits, good, bad):
    for value in good:
        verify(integer_chain([[value]], bits=bits))
    for value in bad:
        assert (
            refused(integer_chain([[value]], bits=bits)) == f"projection 0 has mantissas that {bits} bits cannot hold"
        )


def test_mantissas_of_another_type():
    network = with_projection(integer_chain([[2]]), 0, weight=stored(np.array([[2.0]])))
    assert refused(network) == "projection 0 has mantissas that 8 bits cannot hold"


def test_an_exponent_that_would_lose_bits():
    verify(integer_chain([[2]], exponent=-1))
    message = "projection 0 has exponent -2: below -1 its weights are no whole units"
    assert refused(integer_chain([[2]], exponent=-2)) == message


@given(st.one_of(float_networks(), integer_networks()))
def test_random_networks_pass(network):
    verify(network)


# --- structure


def test_depths_count_from_the_first_layer():
    assert depths(chain(np.ones((2, 3)), np.ones((2, 2)), np.ones((1, 2)))) == (0, 1, 2)


def test_fan_in_counts_stored_zeros():
    weight = stored([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0]], np.array([[1, 1, 1], [0, 1, 0]]))
    network = with_projection(small(), 0, weight=weight)
    assert fan_in(network, 0).tolist() == [3, 1]
    assert fan_in(network, 1).tolist() == [2, 2]


def test_fan_in_counts_a_synapse_once_whatever_its_planes():
    network = small()
    more = Projection(pre=INPUT, post=0, weight=stored(np.ones((2, 3)), np.array([[1, 0, 0], [1, 1, 0]])))
    twice = replace(network, projections=(*network.projections, more))
    assert fan_in(twice, 0).tolist() == fan_in(network, 0).tolist() == [3, 3]


@pytest.mark.parametrize("make", [chain, integer_chain])
def test_the_networkx_graph_holds_populations_and_projections(make):
    graph = to_networkx(make(np.full((2, 3), 2), np.full((4, 2), 2)))
    assert dict(graph.nodes(data="neurons")) == {"input": 3, "fc1": 2, "fc2": 4}
    assert list(graph.edges(data="synapses")) == [("input", "fc1", 6), ("fc1", "fc2", 8)]
    assert nx.dag_longest_path_length(nx.DiGraph(graph)) == 2


@given(integer_networks())
def test_the_networkx_graph_counts_every_synapse(network):
    graph = to_networkx(network)
    assert sum(n for *_, n in graph.edges(data="synapses")) == sum(p.weight.nnz for p in network.projections)
    graph.remove_edges_from(list(nx.selfloop_edges(graph, keys=True)))
    longest = nx.dag_longest_path_length(nx.DiGraph(graph), weight=None)
    assert max(depths(network)) == longest - 1


# --- printed form


def placed(network):
    parts = partition(network, LOIHI)
    return emit(network, parts, tuple(range(len(parts.cores))), LOIHI, {})


def test_float_text(golden):
    network = chain([[0.5, -0.25, 0.0]], [[1.0], [-1.0]], biases=[[0.125], [0.0, 0.5]])
    golden("float.txt", text(network))


def test_integer_text(golden):
    golden("integer.txt", text(integer_chain([[2, -4, 0], [6, 8, 254]], [[2, 4]], thresholds=[[3, 5], 7], exponent=1)))


def test_netlist_text(golden):
    golden(
        "netlist.txt", netlist_text(placed(integer_chain([[2, -4, 0], [6, 8, 254]], [[2, 4]], thresholds=[[3, 5], 7])))
    )


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize(
    ("field", "change"), [("bias", 1e-12), ("beta", 1e-9), ("theta", 1e-9), ("weight", 1e-12), ("label", 1)]
)
def test_every_value_of_a_float_network_shows_in_its_text(field, change, index):
    network = small()
    if field == "weight":
        weight = network.projections[index].weight.copy()
        weight.data[-1] += change
        other = with_projection(network, index, weight=weight)
    elif field == "label":
        other = replace(network, readout=replace(network.readout, label=np.array([[0, 0], [1, 0]][index])))
    else:
        other = with_population(network, index, **{field: getattr(network.populations[index], field) + change})
    assert text(other) != text(network)


@pytest.mark.parametrize("field", ["threshold", "bias_mantissa", "bias_exponent", "decay_u", "decay_v", "scale"])
def test_every_register_shows_in_the_text(field):
    network = integer_chain([[2, 4], [6, 8], [6, 8]], thresholds=[[1, 5, 9]])
    value = getattr(network.populations[0], field)
    changed = value + np.array([0, 1e-9 if field == "scale" else 1, 0]) if isinstance(value, np.ndarray) else 7
    assert text(with_population(network, 0, **{field: changed})) != text(network)


@pytest.mark.parametrize(
    "field",
    [
        "core_tile",
        "neuron",
        "decay_u",
        "threshold",
        "bias_mantissa",
        "bias_exponent",
        "readout_class",
        "axon_source",
        "axon_synapses",
        "synapse_target",
        "synapse_weight",
        "format_exponent",
        "format_index_bits",
    ],
)
def test_every_array_of_a_netlist_shows_in_its_text(field):
    netlist = placed(integer_chain([[2, -4, 0], [6, 8, 254]], [[2, 4]]))
    changed = getattr(netlist, field).copy()
    changed[len(changed) // 2] += 1
    assert netlist_text(replace(netlist, **{field: changed})) != netlist_text(netlist)
