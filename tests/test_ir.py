import dataclasses

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import refused
from random_networks import chain, compiled, float_networks, integer_chain, integer_networks, stored
from scipy import sparse

from spikeloom.compiler.errors import VerifyError
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import INPUT, Network, Projection, Readout, depths, fan_in, recurrent
from spikeloom.compiler.targets.loihi1.netlist import netlist_text
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


# --- rules of both stages
@pytest.mark.parametrize("make", [chain, integer_chain])
def test_a_sound_network_passes(make):
    verify(make([[2, 4, 6], [8, 10, 12]], [[2, 0], [0, 2]]))


def test_a_recurrent_population_is_no_deeper_for_it():
    network = more(1, 1, (2, 2))(small())
    verify(network)
    assert depths(network) == (0, 1)
    assert recurrent(network) == ("fc2",)


def projected(index, **changes):
    return lambda network: with_projection(network, index, **changes)


def more(*arguments):
    """Add a projection of ones: from, to, shape."""
    pre, post, shape = arguments
    added = Projection(pre=pre, post=post, weight=stored(np.ones(shape)))
    return lambda network: replace(network, projections=(*network.projections, added))


def voting(population, *label):
    return lambda network: replace(network, readout=Readout(population=population, label=np.array(label)))


def populated(index, **changes):
    return lambda network: with_population(network, index, **changes)


TWICE = sparse.csr_array((np.ones(2), np.array([1, 1]), np.array([0, 2, 2])), shape=(2, 3))
FLOATS = [
    (populated(1, name="fc1"), "two populations are called 'fc1'"),
    (projected(0, weight=stored(np.ones((2, 4)))), "projection 0 has shape (2, 4)|(2, 3)"),
    (projected(1, pre=7), "projection 1 has shape (2, 2)|(2, None)"),
    (projected(1, pre=-2), "projection 1 has shape (2, 2)|(2, None)"),
    (projected(1, post=2), "projection 1 has shape (2, 2)|(None, 2)"),
    (projected(1, post=INPUT, weight=stored(np.ones((3, 2)))), "projection 1 runs from population 0 to -1"),
    (projected(0, weight=TWICE), "projection 0 has unsorted or repeated synapses"),
    (more(1, 0, (2, 2)), "projection 2 runs from population 1 to 0, not forward; projection 0 skips a layer|1 early"),
    (more(INPUT, 1, (2, 3)), "projection 2 skips a layer|1 early"),
    (lambda n: replace(n, projections=n.projections[1:]), "'fc1' is not reached|'fc2' is not reached"),
    (lambda n: replace(more(1, 1, (2, 2))(n), projections=more(1, 1, (2, 2))(n).projections[::2]), "'fc2' is not"),
    (voting(2, 0, 1), "names population 2"),
    (voting(-1, 0, 1), "names population -1"),
    (voting(1, 0, 1, 2), "3 labels"),
    (voting(1, 0, 2), "outside 0 … 1"),
    (voting(1, -1, 0), "outside 0 … 1"),
    (lambda n: with_population(populated(1, name="fc1")(n), 1, theta=0.0), "two populations|theta 0.0"),
    *((populated(0, bias=np.array([0.0, value])), "'fc1' has biases") for value in (np.nan, np.inf)),
    *((populated(0, beta=beta), f"'fc1' has beta {beta}") for beta in (-0.1, 1.1, np.nan)),
    *((populated(0, theta=theta), f"theta {theta} out of range") for theta in (0.0, -1.0, np.nan)),
    *((populated(0, alpha=alpha), f"'fc1' has alpha {alpha}") for alpha in (-0.1, 1.0)),
    (projected(0, weight=stored(np.full((2, 3), np.nan))), "projection 0 has weights that are not finite float64"),
    (projected(0, weight=stored(np.ones((2, 3), np.float32))), "projection 0 has weights"),
    (projected(0, weight=stored(np.ones((2, 3), int))), "projection 0 has weights"),
]


@pytest.mark.parametrize(("change", "words"), FLOATS)
def test_a_float_network_that_breaks_a_rule(change, words):
    refused(VerifyError, words, verify, change(small()))


# --- rules of the integer stage
@pytest.mark.parametrize(
    ("field", "good", "bad", "words"),
    [
        ("decay_u", (0, 4095), (-1, 4096), "decay outside 0 … 4095"),
        ("decay_v", (0, 4095), (-1, 4096), "decay outside 0 … 4095"),
        ("threshold", (0, 131071), (-1, 131072), "threshold outside 0 … 131071"),
        ("bias_mantissa", (-4095, 4095), (-4096, 4096), "bias mantissa beyond 4095"),
        ("bias_exponent", (0, 7), (-1, 8), "bias exponent outside 0 … 7"),
    ],
)
def test_registers_at_their_ends_and_one_past_them(field, good, bad, words):
    network = integer_chain([[2, 4]])

    def changed(value):
        return with_population(network, 0, **{field: value if field.startswith("decay") else np.array([value])})

    for value in good:
        verify(changed(value))
    for value in bad:
        refused(VerifyError, f"'fc1'|{words}", verify, changed(value))


@pytest.mark.parametrize(
    ("bits", "good", "bad"),
    [(8, (-256, 254), (-258, 256, 3)), (4, (-256, 224), (256, 16)), (2, (128, -256), (256, 64))],
)
def test_mantissas_of_each_width(bits, good, bad):
    for value in good:
        verify(integer_chain([[value]], bits=bits, exponent=-1))
    for value in bad:
        refused(VerifyError, f"projection 0|{bits} bits", verify, integer_chain([[value]], bits=bits))
    floats = with_projection(integer_chain([[2]]), 0, weight=stored(np.array([[2.0]])))
    refused(VerifyError, "projection 0|8 bits", verify, floats)
    refused(VerifyError, "exponent -2|below -1", verify, integer_chain([[0]], exponent=-2))


@given(st.one_of(float_networks(), integer_networks()))
def test_random_networks_pass(network):
    verify(network)


# --- structure
def test_fan_in_counts_stored_zeros():
    weight = stored([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0]], np.array([[1, 1, 1], [0, 1, 0]]))
    network = with_projection(small(), 0, weight=weight)
    assert fan_in(network, 0).tolist() == [3, 1]
    assert fan_in(network, 1).tolist() == [2, 2]


def test_fan_in_counts_a_synapse_once_whatever_its_planes():
    network = small()
    again = Projection(pre=INPUT, post=0, weight=stored(np.ones((2, 3)), np.array([[1, 0, 0], [1, 1, 0]])))
    twice = replace(network, projections=(*network.projections, again))
    assert fan_in(twice, 0).tolist() == fan_in(network, 0).tolist() == [3, 3]


# --- printed form
def test_texts_are_as_recorded(golden):
    golden("float.txt", text(chain([[0.5, -0.25, 0.0]], [[1.0], [-1.0]], biases=[[0.125], [0.0, 0.5]])))
    layers = [[2, -4, 0], [6, 8, 254]], [[2, 4]]
    golden("integer.txt", text(integer_chain(*layers, thresholds=[[3, 5], 7], exponent=1)))
    golden("netlist.txt", netlist_text(compiled(integer_chain(*layers, thresholds=[[3, 5], 7]))))


@given(integer_networks())
def test_depths_are_the_longest_paths(network):
    graph = nx.DiGraph((p.pre, p.post) for p in network.projections if p.pre != p.post)
    assert max(depths(network)) == nx.dag_longest_path_length(graph) - 1
