import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import LOIHI, dense_weights, float_networks, integer_chain, integer_networks, recordings_for

from spikeloom.compiler import Packing
from spikeloom.compiler.interpret import run_integer
from spikeloom.compiler.range_proof import prove_ranges
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage


def with_registers(network, **changes):
    return dataclasses.replace(
        network, populations=tuple(dataclasses.replace(p, **changes) for p in network.populations)
    )


def test_one_neuron_by_hand():
    network = integer_chain([[254, -100, 6]], thresholds=[90])
    (proof,) = prove_ranges(network)
    assert proof.layer == "fc1"
    assert proof.accumulator == proof.current == 64 * 260
    assert proof.membrane == pytest.approx(819 / 4096 * 90 * 64 + 64 * 260)
    assert proof.holds


def test_negative_input_adds_up_as_far_as_the_leak_lets_it():
    network = with_registers(integer_chain([[-200]]), bias_mantissa=np.array([-64]), decay_v=2048)
    (proof,) = prove_ranges(network)
    assert proof.membrane == 2 * (64 * 200 + 64)


def test_a_current_with_memory_adds_up():
    network = with_registers(integer_chain([[100]]), decay_u=2047)
    (proof,) = prove_ranges(network)
    assert proof.accumulator == 6400
    assert proof.current == 2 * 6400


def test_without_a_leak_only_the_positive_side_is_bounded():
    rising = with_registers(integer_chain([[100]]), decay_v=0)
    assert prove_ranges(rising)[0].membrane == 100 * 64 + 6400
    falling = with_registers(integer_chain([[-2]]), decay_v=0)
    (proof,) = prove_ranges(falling)
    assert proof.membrane == np.inf
    assert not proof.holds


@pytest.mark.parametrize(
    ("weights", "holds"), [([254] * 129, True), ([254] * 129 + [2], False), ([-254] * 129 + [254] * 129, True)]
)
def test_the_accumulator_holds_129_full_weights(weights, holds):
    (proof,) = prove_ranges(integer_chain([weights]))
    assert proof.holds is holds


def check(network, events, proofs):
    """Compare running registers with their bounds, neuron by neuron, in Python integers."""
    activity = run_integer(network, events, membranes=True)
    for post, proof in enumerate(proofs):
        sources = {-1: events} | dict(enumerate(activity.spikes))
        sums = up = down = 0
        for pre, weight in dense_weights(network, post).items():
            active = sources[pre].astype(np.int64)
            sums = sums + active @ weight.T
            up = up + active @ np.maximum(weight, 0).T
            down = down + active @ np.maximum(-weight, 0).T
        assert 64 * max(up.max(), down.max()) <= proof.accumulator
        factor = 4095 - network.populations[post].decay_u
        current = np.zeros_like(sums[:, 0])
        for t in range(sums.shape[1]):
            current = np.sign(current) * (np.abs(current) * factor // 4096) + 64 * sums[:, t]
            assert np.abs(current).max() <= proof.current
        assert np.abs(activity.membranes[post]).max() <= proof.membrane


@settings(deadline=None, max_examples=20)
@given(st.data())
def test_bounds_hold_on_random_registers(data):
    network = data.draw(integer_networks())
    check(network, data.draw(recordings_for(network.input.size, most=30)), prove_ranges(network))


@settings(deadline=None, max_examples=20)
@given(st.data())
def test_bounds_hold_on_quantised_networks(data):
    packing = Packing(bits=data.draw(st.sampled_from([2, 8])))
    network, _ = choose_storage(data.draw(float_networks()), LOIHI, packings=(packing,))
    check(network, data.draw(recordings_for(network.input.size, most=30)), prove_ranges(network))


@settings(deadline=None, max_examples=20)
@given(st.data())
def test_a_proof_means_that_saturation_changes_nothing(data):
    network = data.draw(integer_networks())
    events = data.draw(recordings_for(network.input.size, most=30))
    free = run_integer(network, events, membranes=True, saturates=False)
    for proof, membranes in zip(prove_ranges(network), free.membranes, strict=True):
        if proof.membrane > 2**23 - 1:
            break  # later layers may hear other spikes
        assert np.abs(membranes).max() <= 2**23 - 1
