"""Rounding to registers, scales, and the proof that no sum leaves its range."""

import dataclasses
import re
from fractions import Fraction

import numpy as np
import pytest
import random_networks as nets
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from spikeloom.compiler.interpret import run_float
from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.calibrate import calibrate, evenly_spaced
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.loihi1 import registers
from spikeloom.compiler.targets.loihi1.bounds import one_sided, prove_ranges
from spikeloom.compiler.targets.loihi1.integers import run_integer
from spikeloom.compiler.targets.loihi1.storage import choose_storage as choice_module
from spikeloom.compiler.targets.loihi1.storage.choose_storage import (
    adjust_biases,
    assemble,
    best_scale,
    choose_storage,
)
from spikeloom.compiler.targets.loihi1.storage.scales import (
    candidate,
    layer_of,
    rounded,
    with_spike_errors,
)
from spikeloom.compiler.targets.loihi1.storage.weight_storage import round_population
from spikeloom.runtime.machines.loihi1.spec import decayed


def recordings(network, seed, *, samples=4, steps=30, rate=0.3):
    return np.random.default_rng(seed).random((samples, steps, network.input.size)) < rate


def noisy_layer(seed=0, *, inputs=40, outputs=30, outlier=0.0):
    """One layer of normal weights, the first of them an outlier."""
    rng = np.random.default_rng(seed)
    weight = rng.normal(0, 0.1, (outputs, inputs))
    weight[0, 0] = outlier
    return nets.chain(weight, biases=[rng.normal(0, 0.05, outputs)])


def test_decays_are_the_nearest_registers():
    found = [registers.decay_registers(beta)[1] for beta in (0.0, 1.0, 0.5, 0.9, 819 / 4096)]
    assert found == [4095, 0, 2048, 410, 3277]
    population = choose_storage(noisy_layer(), nets.LOIHI)[0].populations[0]
    assert (population.beta, population.realised_beta) == (0.2, 819 / 4096)
    assert (population.decay_u, population.decay_v) == (4095, 3277)


@settings(max_examples=10)
@given(st.data())
def test_the_stated_worst_case_is_reached(data):
    network = data.draw(nets.float_networks())
    integer, choices = choose_storage(
        network, nets.LOIHI, packings=(Packing(bits=data.draw(st.sampled_from(nets.BITS))),)
    )
    proofs = prove_ranges(integer)
    for post, (proof, choice) in enumerate(zip(proofs, choices, strict=True)):
        weights = np.concatenate(list(nets.dense_weights(integer, post).values()), axis=1)
        assert proof.accumulator <= 2**21 - 1
        # The worst case is reached by the input that hits just the positive or just the negative synapses.
        worst = max(
            np.abs((sign * weights[i] > 0) @ weights[i]) for i in range(len(weights)) for sign in (1, -1)
        )
        assert proof.accumulator == 64 * worst
        assert choice.headroom == pytest.approx(1 - worst / registers.ONE_STEP_SUM_MAX, abs=1e-12)


def test_a_large_layer_gives_up_scale_for_the_proof():
    """2000 equal weights: only their sum, not the largest of them, limits the scale."""
    integer, (choice,) = choose_storage(nets.chain(np.full((1, 2000), 0.5)), nets.LOIHI)
    assert choice.headroom >= 0
    assert int(integer.projections[0].effective().sum()) <= registers.ONE_STEP_SUM_MAX
    # One unit of threshold more would not fit.
    network = nets.chain(np.full((1, 2000), 0.5))
    form = Form(bits=8, exponents=(choice.exponent,), threshold=integer.populations[0].threshold + 1)
    _, finer = round_population(network.populations[0], network.projections, form)
    assert np.maximum(*one_sided(finer, 1))[0] > registers.ONE_STEP_SUM_MAX


def test_a_small_layer_uses_the_full_range():
    integer, (choice,) = choose_storage(nets.chain([[0.5, -0.251, 0.126]]), nets.LOIHI)
    assert integer.projections[0].weight.toarray().tolist() == [[254, -128, 64]]
    # the largest exponent that the positive sum of 318 allows: threshold and bias are finest there
    assert (choice.exponent, choice.scale, choice.clipped) == (6, 508 * 64, 0)
    assert (choice.candidates, choice.flips, choice.spikes) == (1, None, None)


def test_an_outlier_is_clipped_if_that_saves_spikes():
    network = noisy_layer(outlier=20.0)
    calibration = calibrate(network, recordings(network, 1))
    packings = (Packing(bits=4),)
    unclipped, (plain,) = choose_storage(network, nets.LOIHI, packings=packings)
    chosen, (choice,) = choose_storage(network, nets.LOIHI, packings=packings, calibration=calibration)
    assert plain.clipped == 0
    assert choice.clipped == 1
    assert choice.scale > plain.scale
    assert chosen.projections[0].weight.toarray()[0, 0] == 224
    assert spike_cost(chosen, calibration, 0)[0].sum() < spike_cost(unclipped, calibration, 0)[0].sum()


@pytest.mark.parametrize(("bits", "theta"), [(8, 0.5), (2, 49.0)])
def test_a_layer_of_zeros_is_silent(bits, theta):
    integer, (choice,) = choose_storage(
        nets.chain(np.zeros((2, 3)), theta=theta), nets.LOIHI, packings=(Packing(bits=bits),)
    )
    assert not integer.projections[0].weight.data.any()
    assert choice.headroom == 1
    assert integer.populations[0].threshold.tolist() in [[127, 127], [128, 128]]
    assert not run_integer(integer, np.ones((1, 5, 3), bool)).spikes[0].any()


def test_a_layer_of_zeros_with_biases_spikes_by_them():
    network = nets.chain(np.zeros((3, 2)), biases=[[0.6, 0.45, 0.3]])
    events = np.ones((1, 20, 2), bool)
    integer, _ = choose_storage(network, nets.LOIHI)
    assert_array_equal(run_integer(integer, events).spikes[0], run_float(network, events).spikes[0])


@pytest.mark.parametrize("weight", [100.0, 300.0, 4000.0])
@pytest.mark.parametrize("bits", [2, 8])
def test_weights_far_above_the_threshold_take_a_larger_exponent(weight, bits):
    integer, (choice,) = choose_storage(
        nets.chain([[weight, -weight / 2]]), nets.LOIHI, packings=(Packing(bits=bits),)
    )
    assert choice.exponent > 0
    assert integer.populations[0].threshold[0] >= 1
    largest = integer.projections[0].weight.data[0] * 2**choice.exponent / choice.scale
    # half a unit of threshold, or half a step of the weight
    assert largest == pytest.approx(weight, rel=0.3)


def test_tiny_weights_take_the_largest_threshold():
    integer, (choice,) = choose_storage(nets.chain([[1e-9, -1e-12]]), nets.LOIHI)
    assert integer.populations[0].threshold.tolist() == [131071]
    assert choice.exponent == -1


def test_a_large_bias_takes_the_finest_scale_that_its_register_holds():
    integer, (choice,) = choose_storage(nets.chain([[0.5, -0.5]], biases=[[100.0]]), nets.LOIHI)
    (threshold,) = integer.populations[0].threshold.tolist()
    assert threshold / 0.5 * 64 * 100 <= 4095 * 2**7 < (threshold + 1) / 0.5 * 64 * 100
    assert choice.scale == 2 * threshold


@pytest.mark.parametrize(("bits", "seed"), [(2, 0), (4, 1), (8, 2)])
def test_the_scale_that_keeps_most_spikes_is_chosen_of_those_that_did_best_on_a_sample(
    bits, seed, monkeypatch
):
    monkeypatch.setattr(choice_module, "compensated", lambda *_: None)
    network = noisy_layer(seed, outlier=1.0)
    calibration, packing = calibrate(network, recordings(network, seed, samples=24)), Packing(bits=bits)
    layer, exponents = layer_of(network, 0, calibration), nets.LOIHI.choices["synapse.exponent"]
    made = (candidate(layer, packing, factor, exponents)[0] for factor in choice_module.CLIPPING)
    found = {(c.form.exponents, c.form.threshold[0]): c for c in made}.values()
    runs = [assemble(network, [c]) for c in found]
    on_all, sampled = (
        [sum(np.abs(each).sum() for each in spike_cost(run, calibration, 0, rows)) for run in runs]
        for rows in (slice(None), slice(None, None, 3))  # the second is the first of three parts
    )
    finalists = np.argsort(sampled, kind="stable")[: choice_module.FINALISTS]
    best = best_scale(layer, packing, exponents)
    assert best.cost == min(on_all[i] for i in finalists)
    assert len(finalists) < best.tried <= len(found)


def spike_cost(integer, calibration, post, rows=slice(None)):
    """Of each neuron the spikes that differ, and how many more there are."""
    spikes, wanted = (
        run_integer(integer, calibration.events).spikes[post][rows],
        calibration.spikes[post][rows],
    )
    more = spikes.sum(axis=(0, 1)) - wanted.sum(axis=(0, 1)).astype(int)
    return np.count_nonzero(spikes != wanted, axis=(0, 1)), more


@pytest.mark.parametrize("neurons", [1, 7, 8, 9, 21])
def test_spikes_are_compared_whatever_the_number_of_neurons(neurons):
    network = nets.chain(np.random.default_rng(neurons).normal(0, 1, (neurons, 6)))
    calibration = calibrate(network, recordings(network, 3, samples=9))
    layer = layer_of(network, 0, calibration)
    coarse = rounded(layer, Form(bits=2, exponents=(5,), threshold=np.full(neurons, 60)))
    found = with_spike_errors(coarse, 0, calibration).moved
    assert_array_equal(found, spike_cost(assemble(network, [coarse]), calibration, 0))
    assert found[0].any()


def test_a_layer_is_judged_on_the_rounded_spikes_of_the_one_before_and_nudged_only_where_that_helps():
    rng, packing = np.random.default_rng(3), Packing(bits=3)
    network = nets.chain(rng.normal(0, 0.2, (20, 12)), rng.normal(0, 0.3, (9, 20)))
    calibration = calibrate(network, recordings(network, 4, samples=12))
    integer, choices = choose_storage(network, nets.LOIHI, packings=(packing,), calibration=calibration)
    for post, choice in enumerate(choices):  # the whole network runs as each layer was judged
        assert choice.flips == spike_cost(integer, calibration, post)[0].sum() > 0
    layer = layer_of(network, 0, calibration)
    before = best_scale(layer, packing, nets.LOIHI.choices["synapse.exponent"])
    after = adjust_biases(layer, before, calibration)
    scores = [np.abs(stored.moved).sum(axis=0) for stored in (before, after)]
    changed = before.population.bias != after.population.bias
    assert np.array_equal(scores[1] < scores[0], changed)
    assert np.all(scores[1] <= scores[0])
    assert 0 < changed.sum() < 20
    assert np.array_equal(after.moved, spike_cost(integer, calibration, 0))


def test_a_relay_keeps_no_bias():
    weight = np.random.default_rng(5).normal(0, 0.2, (20, 12))
    weight[-1] = np.eye(12)[-1]
    network = nets.chain(weight)
    network = dataclasses.replace(
        network, populations=(dataclasses.replace(network.populations[0], relays=1),)
    )
    calibration = calibrate(network, recordings(network, 6, samples=12))
    integer, _ = choose_storage(network, nets.LOIHI, packings=(Packing(bits=3),), calibration=calibration)
    assert integer.populations[0].bias[:-1].any()
    assert integer.populations[0].bias[-1] == 0
    assert not spike_cost(integer, calibration, 0)[0][-1]


@pytest.mark.parametrize("planes", [(2, 1), (1, 2)])
def test_layers_of_several_planes_and_no_others_are_rounded_on_more_recordings(planes, monkeypatch):
    rng, more = np.random.default_rng(3), []
    network = nets.chain(rng.normal(0, 0.2, (8, 12)), rng.normal(0, 0.3, (4, 8)))
    monkeypatch.setattr(
        choice_module, "round_with_more", lambda layer, chosen, _: more.append(layer.post) or chosen
    )
    packings = [Packing(planes=each) for each in planes]
    choose_storage(
        network, nets.LOIHI, packings=packings, calibration=calibrate(network, recordings(network, 4))
    )
    assert more == [planes.index(2)]


@pytest.mark.parametrize(
    ("samples", "picked"), [(1, [0]), (4, [0, 1, 2, 3]), (5, [0, 1, 3, 4]), (100, [0, 33, 66, 99])]
)
def test_recordings_are_evenly_spaced(samples, picked):
    events = np.arange(samples)[:, None, None]
    assert evenly_spaced(events, 4)[:, 0, 0].tolist() == picked
    assert len(evenly_spaced(np.zeros((576, 1, 1), bool))) == 32


def with_registers(network, **changes):
    return dataclasses.replace(
        network, populations=tuple(dataclasses.replace(p, **changes) for p in network.populations)
    )


def test_one_neuron_by_hand():
    network = nets.integer_chain([[254, -100, 6]], thresholds=[90])
    (proof,) = prove_ranges(network)
    assert proof.layer == "fc1"
    assert proof.accumulator == proof.current == 64 * 260
    assert proof.membrane == pytest.approx(819 / 4096 * 90 * 64 + 64 * 260)
    assert proof.holds


def test_negative_input_adds_up_as_far_as_the_leak_lets_it():
    network = with_registers(nets.integer_chain([[-200]]), bias_mantissa=np.array([-64]), decay_v=2048)
    (proof,) = prove_ranges(network)
    assert proof.membrane == 2 * (64 * 200 + 64)


def test_a_current_with_memory_adds_up():
    network = with_registers(nets.integer_chain([[100]]), decay_u=2047)
    (proof,) = prove_ranges(network)
    assert proof.accumulator == 6400
    assert proof.current == 2 * 6400


def test_without_a_leak_only_the_positive_side_is_bounded():
    rising = with_registers(nets.integer_chain([[100]]), decay_v=0)
    assert prove_ranges(rising)[0].membrane == 100 * 64 + 6400
    falling = with_registers(nets.integer_chain([[-2]]), decay_v=0)
    (proof,) = prove_ranges(falling)
    assert proof.membrane == np.inf
    assert not proof.holds


@pytest.mark.parametrize(
    ("weights", "holds"),
    [([254] * 129, True), ([254] * 129 + [2], False), ([-254] * 129 + [254] * 129, True)],
)
def test_the_accumulator_holds_129_full_weights(weights, holds):
    (proof,) = prove_ranges(nets.integer_chain([weights]))
    assert proof.holds is holds


def check(network, events, proofs):
    """Compare running registers with their bounds, neuron by neuron, in Python integers."""
    activity = run_integer(network, events, membranes=True)
    for post, proof in enumerate(proofs):
        sources = {-1: events} | dict(enumerate(activity.spikes))
        sums = up = down = 0
        for pre, weight in nets.dense_weights(network, post).items():
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


@given(st.data())
def test_bounds_hold_on_random_registers(data):
    network = data.draw(nets.integer_networks())
    check(network, data.draw(nets.recordings_for(network.input.size, most=30)), prove_ranges(network))


@given(st.data())
def test_a_proof_means_that_saturation_changes_nothing(data):
    network = data.draw(nets.integer_networks())
    events = data.draw(nets.recordings_for(network.input.size, most=30))
    free = run_integer(network, events, membranes=True, saturates=False)
    for proof, membranes in zip(prove_ranges(network), free.membranes, strict=True):
        if proof.membrane > 2**23 - 1:
            break  # later layers may hear other spikes
        assert np.abs(membranes).max() <= 2**23 - 1


def test_registers_have_their_published_widths():
    assert (registers.ACCUMULATOR_MAX, registers.CURRENT_MAX, registers.MEMBRANE_MAX) == (
        2097151,
        8388607,
        8388607,
    )
    assert (registers.BIAS_MANTISSA_MAX, registers.BIAS_EXPONENT_MAX, registers.THRESHOLD_MANTISSA_MAX) == (
        4095,
        7,
        131071,
    )
    assert registers.MEMBRANE_SHIFT == 6
    assert (
        64 * registers.ONE_STEP_SUM_MAX <= registers.ACCUMULATOR_MAX < 64 * (registers.ONE_STEP_SUM_MAX + 1)
    )


@given(st.integers(-(2**24), 2**24), st.integers(0, 4096))
def test_decay_rounds_the_exact_product_toward_zero(x, lost):
    assert decayed(x, lost) == int(Fraction(x * (4096 - lost), 4096))  # int of a fraction truncates


@pytest.mark.parametrize("bias", [4095.5 * 128, -4095.5 * 128, 1e9])
def test_a_bias_beyond_the_register_is_refused(bias):
    message = f"bias of magnitude {abs(bias):.6g} exceeds 4095 * 2**7 membrane units"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        registers.encode_bias(np.array([0.0, bias]))


@given(st.lists(st.floats(-4095 * 128, 4095 * 128), min_size=1, max_size=4))
def test_a_bias_is_off_by_half_a_unit_of_its_exponent_at_most(bias):
    mantissa, exponent = registers.encode_bias(np.array(bias))
    assert np.all(np.abs(mantissa) <= 4095)
    assert np.all((exponent >= 0) & (exponent <= 7))
    assert np.all(np.abs(mantissa * 2.0**exponent - bias) <= 2.0**exponent / 2)
    smaller = np.abs(np.rint(np.array(bias) / 2.0 ** (exponent - 1))) <= 4095
    assert not np.any(smaller & (exponent > 0))


def test_what_a_convolution_repeats_is_rounded_alike_if_lists_are_to_be_shared():
    kernel = np.random.default_rng(5).normal(size=7)
    network = nets.chain(
        sum(np.eye(60, 66, k) * weight for k, weight in enumerate(kernel)),
        np.random.default_rng(6).normal(size=(3, 60)),
    )
    calibration, packings = calibrate(network, recordings(network, 5)), (Packing(bits=4),)
    for share in (False, True):
        integer, (_, last) = choose_storage(
            network, nets.LOIHI, packings=packings, calibration=calibration, share_lists=share
        )
        weights = integer.projections[0].weight.toarray()
        assert all(len(set(np.diag(weights, k))) == 1 for k in range(7)) is share
        # the dense layer after it repeats nothing: its errors cancel as ever
        assert last.compensated
