"""One neuron and one deviation at a time: what is named as the cause, and why."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_networks import chain, integer_networks, recordings_for

from spikeloom.compiler.interpret import run_integer, step_late
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.passes.expand import expand_graph_convolution
from spikeloom.compiler.targets.loihi1.storage.quantize import round_to_forms
from spikeloom.compiler.targets.loihi1.storage.weight_storage import Form
from spikeloom.runtime.equivalence.causes import Explanation, Observed, explain
from spikeloom.runtime.equivalence.suspects import (
    BETA,
    BIAS,
    GRAPH,
    LEFT_OUT,
    SATURATION,
    THRESHOLD,
    TIE,
    TRANSPOSED,
    TRUNCATION,
    UNKNOWN,
    WEIGHTS,
    Suspect,
    suspect_machine,
)


def stored_as(network, thresholds, exponents=(0,), bits=8):
    """Integer network with given thresholds, one for each population."""
    forms = [
        Form(bits=bits, exponents=exponents, threshold=np.full(population.size, threshold))
        for population, threshold in zip(network.populations, thresholds, strict=True)
    ]
    return round_to_forms(network, forms)[0]


def watched(integer, events) -> Observed:
    """What an intact machine does with one recording."""
    activity = run_integer(integer, events[None], membranes=True)
    return Observed(
        spikes=tuple(spikes[0] for spikes in activity.spikes),
        membranes=tuple(membranes[0] for membranes in activity.membranes),
    )


def with_population(integer, post, **fields):
    populations = list(integer.populations)
    populations[post] = dataclasses.replace(populations[post], **fields)
    return dataclasses.replace(integer, populations=tuple(populations))


def steps(*words):
    """Events (steps, channels) from one word a step."""
    return np.array([[letter == "x" for letter in word] for word in words])


def explained(network, integer, events, **options) -> Explanation:
    return explain(network, integer, events, watched(integer, events), **options)


def only_root(explanation):
    assert explanation.suspects == ()
    (root,) = explanation.roots
    assert root.suspect is None
    assert explanation.diagnosis == root.cause
    return root


# -- what an intact chip is entitled to --------------------------------------------------------------------------------


def test_equal_spikes_have_no_diagnosis():
    network = chain([[1.0]])
    found = explained(network, stored_as(network, [2]), steps("x", "."))
    assert (found.float_spikes, found.chip_spikes, found.different) == ((1,), (1,), (0,))
    assert (found.roots, found.suspects, found.diagnosis) == ((), (), None)


def test_weight_rounding():
    # four units a membrane unit, weights in steps of two: 0.55 becomes 0.5, which is the threshold
    network = chain([[0.55]])
    root = only_root(explained(network, stored_as(network, [2]), steps("x")))
    assert (root.cause, root.clipped, root.float_fires) == (WEIGHTS, False, True)
    assert (root.float_membrane, root.chip_membrane, root.chip_theta) == (0.55, 0.5, 0.5)
    assert (root.chip_register, root.chip_threshold) == (128, 128)
    assert root.sufficient == (WEIGHTS,)
    assert root.gap == ((WEIGHTS, pytest.approx(0.05)),)


def test_weights_that_the_range_cuts_off():
    network = chain([[100.0, -70.0]])
    root = only_root(explained(network, stored_as(network, [2]), steps("xx")))
    assert (root.cause, root.clipped, root.chip_register) == (WEIGHTS, True, 0)
    assert root.gap[0] == (WEIGHTS, pytest.approx(30))


def test_bias_rounding():
    # 0.5005 is 128.128 of a register whose threshold is 128
    network = chain([[0.0]], biases=[[0.5005]])
    root = only_root(explained(network, stored_as(network, [2]), steps(".")))
    assert (root.cause, root.chip_register, root.sufficient) == (BIAS, 128, (BIAS,))


def test_realised_beta():
    # 0.3 is realised as 1229/4096, a little more
    network = chain([[0.49, 0.352]], beta=0.3, biases=[[97 / 128000]])
    root = only_root(explained(network, stored_as(network, [1000], (0, 7)), steps("x.", ".x")))
    assert (root.cause, root.float_fires, root.root.step) == (BETA, False, 1)
    assert (root.chip_register, root.chip_threshold, root.sufficient) == (64001, 64000, (BETA,))


def test_rounding_toward_zero():
    # 128, 32, 8, 2, and then nothing instead of a half
    network = chain([[0.5]], beta=0.25)
    root = only_root(explained(network, stored_as(network, [2]), steps("x", ".", ".", ".", "x")))
    assert (root.cause, root.root.step, root.root.begin, root.chip_register) == (TRUNCATION, 4, 0, 128)
    assert root.gap == ((TRUNCATION, 0.5 / 256),)


def test_saturation():
    # the register ends at -65.5 membrane units, the float model goes down to -80
    network = chain([[-16.0, 16.0]], beta=1.0)
    root = only_root(explained(network, stored_as(network, [1000], (7,)), steps(*["x."] * 5, *[".x"] * 5)))
    assert (root.cause, root.root.step, root.float_fires, root.float_membrane) == (SATURATION, 9, False, 0.0)
    assert root.sufficient == (SATURATION,)


def test_tie():
    # 0.1 + 0.2 > 0.3 in float64; on the chip 10 + 20 are not more than 30
    network = chain([[0.1, 0.2]], theta=0.3)
    root = only_root(explained(network, stored_as(network, [30]), steps("xx")))
    assert (root.cause, root.float_fires) == (TIE, True)


def test_the_largest_of_several_deviations_is_the_cause():
    # either alone would do, the weight's share is larger
    network = chain([[0.55]], biases=[[0.0005]])
    root = only_root(explained(network, stored_as(network, [2]), steps("x")))
    assert (root.cause, root.sufficient) == (WEIGHTS, (WEIGHTS, BIAS))


def test_what_moved_most_is_named_where_no_single_change_is_enough():
    # at four units a membrane unit 0.55 is stored as 0.5, and the threshold is wrong too: 0.75
    network = chain([[0.55]])
    integer = with_population(stored_as(network, [2]), 0, threshold=np.array([3]))
    (root,) = explained(network, integer, steps("x")).roots
    assert (root.cause, root.sufficient) == (THRESHOLD, ())
    assert root.gap == ((THRESHOLD, 0.25), (WEIGHTS, pytest.approx(0.05)))


def test_roots_after_a_common_reset_start_from_rest():
    network = chain([[0.55, 2.0]])
    found = explained(network, stored_as(network, [2]), steps("x.", ".x", "x."))
    assert [(root.root.step, root.root.begin, root.cause) for root in found.roots] == [(0, 0, WEIGHTS), (2, 2, WEIGHTS)]


def test_what_follows_is_no_root():
    network = chain([[0.55]], [[1.0]])
    found = explained(network, stored_as(network, [2, 2]), steps("x"))
    assert found.different == (1, 1)
    (root,) = found.roots
    assert (root.root.layer, root.root.dragged, root.root.alone) == (0, 1, 1)


def test_rounding_with_compensation_is_no_fault():
    network = chain([[0.55, 1.0, 1.0, 1.0]])
    integer = stored_as(network, [2])
    (projection,) = integer.projections
    weight = projection.weight.copy()
    weight.data = weight.data + np.array([2, 0, 0, 0])  # 1.0 instead of 0.5
    integer = dataclasses.replace(integer, projections=(dataclasses.replace(projection, weight=weight),))
    events = steps("x...", "....", "....", "x...")
    strict = explained(network, integer, events)
    assert [(fault.cause, fault.part) for fault in strict.suspects] == [(WEIGHTS, "weight")]
    assert explained(network, integer, events, may_compensate=True).suspects == ()


def test_a_neuron_that_was_left_out():
    network = chain([[1.0], [1.0]], [[0.3, 0.3]])
    integer = stored_as(network, [2, 4])
    zero = [p.weight.copy() for p in integer.projections]
    zero[0].data[1] = zero[1].data[1] = 0
    integer = dataclasses.replace(
        integer,
        projections=tuple(dataclasses.replace(p, weight=w) for p, w in zip(integer.projections, zero, strict=True)),
    )
    absent = np.array([False, True]), np.array([False])
    silenced = explained(network, integer, steps("x"), absent=absent).roots[0]
    assert (silenced.cause, silenced.held) == (WEIGHTS, False)
    found = explained(network, integer, steps("x"), absent=absent, pruned=True)
    (root,) = found.roots
    assert (root.cause, root.root.layer, root.root.neuron, root.root.dragged) == (LEFT_OUT, 0, 1, 1)
    assert found.suspects == ()
    unheard = explained(network, integer, steps("x"), absent=absent, unheard=absent)
    assert unheard.different[0] == 0


# -- a netlist that is not its checkpoint's ----------------------------------------------------------------------------


def with_weights(integer, post, other):
    """The projections into one population, taken from another network."""
    kept = tuple(p for p in integer.projections if p.post != post)
    return dataclasses.replace(integer, projections=(*kept, *(p for p in other.projections if p.post == post)))


def test_a_threshold_that_is_not_theta_times_scale():
    network = chain([[0.5]], [[1.0]])
    integer = with_population(stored_as(network, [20, 20]), 0, threshold=np.array([19]))
    found = explained(network, integer, steps("x"))
    assert found.diagnosis == THRESHOLD
    assert found.suspects == (
        Suspect(
            cause=THRESHOLD,
            layer=0,
            part="threshold",
            found="1 of 1 thresholds of fc1 are not theta times scale: neuron 0 has 19, wanted is 20",
            change="choose the scale as threshold / theta, so that a threshold is exact: compile it again",
        ),
    )


def test_decay_registers_of_another_beta():
    network = chain([[0.4]])
    integer = with_population(stored_as(network, [100]), 0, decay_v=2000)
    found = explained(network, integer, steps("x", "x"))
    assert [root.cause for root in found.roots] == [BETA]
    assert [fault.found for fault in found.suspects] == [
        "decay registers of fc1 are 4095 and 2000, beta 0.2 asks for 4095 and 3277"
    ]


def test_a_current_that_is_not_forgotten():
    network = chain([[0.4]])
    integer = with_population(stored_as(network, [100]), 0, decay_u=3000)
    found = explained(network, integer, steps("x", "x"))
    assert [root.cause for root in found.roots] == [BETA]


def test_a_bias_in_whole_weight_units():
    network = chain([[0.0]], biases=[[0.51]])
    integer = with_population(stored_as(network, [20]), 0, bias_mantissa=np.array([64 * 20]))
    found = explained(network, integer, steps("."))
    assert [root.cause for root in found.roots] == [BIAS]
    assert [fault.found for fault in found.suspects] == [
        "1 of 1 biases of fc1 are not the nearest to the checkpoint's: off by up to 0.4 weight units"
    ]


def test_weights_of_another_checkpoint():
    network, other = chain([[0.6, 0.7]]), chain([[0.4, 0.7]])
    integer = with_weights(stored_as(network, [100]), 0, stored_as(other, [100]))
    found = explained(network, integer, steps("x."))
    assert [root.cause for root in found.roots] == [WEIGHTS]
    assert [fault.found for fault in found.suspects] == [
        "the weights of fc1 are not the nearest to the checkpoint's: 1 of 2 are off, by up to 20 steps of the grid"
    ]


def test_a_transposed_matrix():
    weight = np.array([[0.1, 0.9, 0.2], [0.3, 0.4, 0.8], [0.7, 0.6, 0.05]])
    network, other = chain(weight), chain(weight.T)
    integer = with_weights(stored_as(network, [100]), 0, stored_as(other, [100]))
    found = explained(network, integer, steps("x..", "...", ".x.", "...", "..x"))
    assert found.diagnosis == TRANSPOSED
    assert {root.cause for root in found.roots} == {TRANSPOSED}
    assert [fault.found for fault in found.suspects] == ["the weights of fc1 are the checkpoint's transposed"]


def ring(taxels, *more):
    """Propagation matrix of a ring with more edges, repeats adding up."""
    adjacency = np.zeros((taxels, taxels))
    for a, b in [*((i, (i + 1) % taxels) for i in range(taxels)), *more]:
        adjacency[a, b] += 1
        adjacency[b, a] += 1
    degree = adjacency.sum(axis=1) ** -0.5
    return degree[:, None] * adjacency * degree


@pytest.mark.parametrize(
    ("more", "how"),
    [
        ([(0, 3)], "it connects 2 pairs of taxels that the graph does not, and leaves 0 out"),
        ([(0, 1)], "it connects the same taxels otherwise, as if edges were listed twice or repeats collapsed"),
    ],
)
def test_another_graph(more, how):
    hops = np.random.default_rng(1).normal(0, 1, (2, 4, 2))
    right, wrong = ring(6), ring(6, *more)
    network, other = (chain(expand_graph_convolution(graph, hops).toarray(), polarities=2) for graph in (right, wrong))
    integer = with_weights(stored_as(network, [200], (0, 7)), 0, stored_as(other, [200], (0, 7)))
    events = np.random.default_rng(2).random((40, 12)) < 0.3
    found = explained(network, integer, events, convolution=(right, hops))
    assert found.diagnosis == GRAPH
    assert [fault.found for fault in found.suspects] == [
        f"the weights of fc1 are the checkpoint's filters on another graph: {how}"
    ]


def test_a_fault_comes_before_rounding_in_the_diagnosis():
    network = chain([[0.55, 0.55, 0.45]])
    integer = with_population(stored_as(network, [2]), 0, decay_v=1000)
    found = explained(network, integer, steps("x..", ".x.", "..x"))
    assert found.diagnosis == BETA


# -- a machine that does not follow its netlist ------------------------------------------------------------------------


@given(st.data())
def test_an_intact_machine_breaks_no_rule(data):
    integer = data.draw(integer_networks())
    (events,) = data.draw(recordings_for(integer.input.size, samples=1))
    seen = watched(integer, events)
    for post, population in enumerate(integer.populations):
        sent = {INPUT: events, **dict(enumerate(seen.spikes)), post: step_late(seen.spikes[post][None])[0]}
        sums = sum(sent[p.pre].astype(float) @ p.effective().toarray().T for p in integer.projections if p.post == post)
        broken, fault = suspect_machine(
            population, sums, seen.spikes[post], seen.membranes[post].astype(np.int64), layer=post, depth=0
        )
        assert fault is None
        assert not broken.any()


def test_a_machine_that_fires_at_the_threshold():
    network = chain([[0.5]])
    integer = stored_as(network, [2])
    seen = watched(integer, steps("x", ".", "."))
    assert not seen.spikes[0].any()
    at_least = Observed(spikes=(np.array([[True], [False], [False]]),), membranes=(np.array([[128], [0], [0]]),))
    found = explain(network, integer, steps("x", ".", "."), at_least)
    (root,) = found.roots
    assert (root.cause, root.suspect.part) == (TIE, "machine")
    assert root.suspect.found == "fires at the threshold (>=): this explains 1 of 1 steps that break the chip's rule"


def test_a_machine_that_follows_no_known_rule():
    network = chain([[0.5]])
    integer = stored_as(network, [2])
    rng = np.random.default_rng(0)
    events = steps(*["x"] * 30)
    membranes = rng.integers(-1000, 1000, (30, 1))
    found = explain(network, integer, events, Observed(spikes=(membranes > 128,), membranes=(membranes,)))
    (fault,) = found.suspects
    assert (fault.cause, found.diagnosis) == (UNKNOWN, UNKNOWN)
    assert fault.found == "follows no rule that is known here; 30 steps break the chip's"
    assert fault.change == "compare the simulator with the specification (verify, level E0)"
