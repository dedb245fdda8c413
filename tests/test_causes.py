"""One neuron and one deviation at a time: what is named as the cause, and why."""

import dataclasses

import numpy as np
import pytest
from random_networks import chain

from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.ir import Form
from spikeloom.compiler.targets.loihi1.storage.quantize import round_to_forms
from spikeloom.runtime.equivalence.explanation.causes import Explanation, Observed, explain
from spikeloom.runtime.equivalence.explanation.deviations import (
    BETA,
    BIAS,
    LEFT_OUT,
    SATURATION,
    THRESHOLD,
    TIE,
    TRUNCATION,
    WEIGHTS,
)
from spikeloom.runtime.equivalence.rounding import LayerRounding, Rounding


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
    (root,) = explanation.roots
    assert explanation.diagnosis == root.cause
    return root


# -- what an intact chip is entitled to --------------------------------------------------------------------------------


def test_equal_spikes_have_no_diagnosis():
    network = chain([[1.0]])
    found = explained(network, stored_as(network, [2]), steps("x", "."))
    assert (found.float_spikes, found.chip_spikes, found.different) == ((1,), (1,), (0,))
    assert (found.roots, found.diagnosis) == ((), None)


def test_weight_rounding():
    # four units a membrane unit, weights in steps of two: 0.55 becomes 0.5, which is the threshold
    network = chain([[0.55]])
    root = only_root(explained(network, stored_as(network, [2]), steps("x")))
    assert (root.cause, root.clipped, root.float_fires) == (WEIGHTS, False, True)
    assert (root.float_membrane, root.chip_membrane, root.chip_theta) == (0.55, 0.5, 0.5)
    assert (root.chip_register, root.chip_threshold) == (128, 128)
    assert root.sufficient == (WEIGHTS,)
    assert root.moved == ((WEIGHTS, pytest.approx(0.05)),)


def test_weights_that_the_range_cuts_off():
    network = chain([[100.0, -70.0]])
    root = only_root(explained(network, stored_as(network, [2]), steps("xx")))
    assert (root.cause, root.clipped, root.chip_register) == (WEIGHTS, True, 0)
    assert root.moved[0] == (WEIGHTS, pytest.approx(30))


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
    assert root.moved == ((TRUNCATION, 0.5 / 256),)


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
    assert root.moved == ((THRESHOLD, 0.25), (WEIGHTS, pytest.approx(0.05)))


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


def test_in_a_compensated_layer_the_bias_goes_with_the_weights():
    network = chain([[0.55]])
    integer = with_population(stored_as(network, [2]), 0, bias_mantissa=np.array([-3]))
    layer = LayerRounding(weights=1, nearest=0, farthest_steps=0.6, compensated=True, faults=())
    apart = explained(network, integer, steps("x")).roots[0]
    together = explained(network, integer, steps("x"), rounding=Rounding(layers={"fc1": layer})).roots[0]
    assert [name for name, _ in apart.moved] == [WEIGHTS, BIAS]
    assert [name for name, _ in together.moved] == [WEIGHTS]
    assert together.moved[0][1] == pytest.approx(apart.moved[0][1] + 3 / 256)


@pytest.mark.parametrize(("fields", "cause"), [({"decay_v": 2000}, BETA), ({"decay_u": 3000}, BETA)])
def test_a_decay_of_another_network_is_a_decay(fields, cause):
    network = chain([[0.4]])
    integer = with_population(stored_as(network, [100]), 0, **fields)
    assert [root.cause for root in explained(network, integer, steps("x", "x")).roots] == [cause]


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
    unused = explained(network, integer, steps("x"), absent=absent, unused=absent)
    assert unused.different[0] == 0
