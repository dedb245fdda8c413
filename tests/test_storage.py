"""How weights are stored: planes, steps, thresholds, groups of scales, rounding with errors that cancel, exactness."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from random_networks import BITS, LOIHI, chain, float_networks, moved, recordings_for

from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.rounding import DAMPING, round_in_turn, shares
from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.loihi1.bounds import one_sided, prove_ranges
from spikeloom.compiler.targets.loihi1.integers import verify
from spikeloom.compiler.targets.loihi1.registers import (
    ONE_STEP_SUM_MAX,
    plane_distance,
    reach,
    split_planes,
    weight_step,
)
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage
from spikeloom.compiler.targets.loihi1.storage.compensate import compensated
from spikeloom.compiler.targets.loihi1.storage.scales import (
    SCALE_STEPS,
    finest_thresholds,
    fit,
    group_by_fineness,
    layer_of,
    rounded,
    with_spike_errors,
)
from spikeloom.compiler.targets.loihi1.storage.spike_exact import _decay_flips, make_exact
from spikeloom.compiler.targets.loihi1.storage.weight_storage import round_population, scales


@st.composite
def storages(draw):
    """A width and one to three exponents that leave no gap."""
    bits = draw(st.sampled_from(BITS))
    exponents = [draw(st.integers(-1, 3))]
    for _ in range(draw(st.integers(0, 2))):
        exponents.append(exponents[-1] + draw(st.integers(1, plane_distance(bits))))
    return bits, tuple(exponents)


def one_layer(weight, *, seed=0, samples=8, steps=40, rate=0.2, **options):
    """A layer and recordings."""
    network = chain(weight, **options)
    return network, calibrate(
        network, np.random.default_rng(seed).random((samples, steps, len(weight[0]))) < rate
    )


def uneven_layer(seed=0):
    """Neurons whose weights differ by a factor of a hundred, with recordings."""
    rng = np.random.default_rng(seed)
    weight = rng.normal(0, 0.1, (24, 40)) * np.geomspace(0.3, 30, 24)[:, None]
    return one_layer(weight, seed=seed, biases=[rng.normal(0, 0.05, 24)])


@given(storages())
def test_planes_hold_every_step_and_the_coarser_only_what_the_finer_do_not_reach(storage):
    bits, exponents = storage
    limit = reach(bits, exponents)
    steps = (
        np.arange(-limit, limit + 1)
        if limit < 5000
        else np.unique(np.linspace(-limit, limit, 9999).astype(int))
    )
    planes = split_planes(steps, bits, exponents)
    total = sum(plane * 2 ** (e - exponents[0]) for plane, e in zip(planes, exponents, strict=True))
    assert_array_equal(total, steps * weight_step(bits))
    for k, plane in enumerate(planes):
        assert not np.any(plane % weight_step(bits))
        assert np.abs(plane).max() <= 256 - weight_step(bits)
        assert k == 0 or not plane[np.abs(steps) <= reach(bits, exponents[:k])].any()


@pytest.mark.parametrize("bits", BITS)
def test_the_distance_of_planes_is_the_largest_without_a_gap(bits):
    for distance, gap in ((plane_distance(bits), False), (plane_distance(bits) + 1, True)):
        steps = np.arange(reach(bits, (0,)) + 2**distance)
        planes = split_planes(steps, bits, (0, distance))
        assert (np.abs(planes[0]).max() > 256 - weight_step(bits)) == gap


@given(float_networks(), storages(), st.data())
def test_a_rounded_population_is_the_nearest_of_its_grid(network, storage, data):
    bits, exponents = storage
    for post, population in enumerate(network.populations):
        incoming = tuple(p for p in network.projections if p.post == post)
        threshold = np.array(
            data.draw(st.lists(st.integers(1, 9), min_size=population.size, max_size=population.size))
        )
        form = Form(bits=bits, exponents=exponents, threshold=threshold)
        integer, planes = round_population(population, incoming, form)
        assert_allclose(integer.realised_theta, population.theta, rtol=1e-15)
        step, limit = weight_step(bits) * 2.0 ** exponents[0], reach(bits, exponents)
        for projection in incoming:
            stored = sum(p.effective().toarray() for p in planes if p.pre == projection.pre)
            wanted = projection.weight.toarray() * scales(population, form)[:, None] / step
            error = stored / step - np.clip(wanted, -limit, limit)
            assert np.abs(error).max(initial=0) <= 0.5 * (1 + 1e-9)
        by_hand = np.zeros((2, population.size))
        for plane in planes:
            dense = plane.effective().toarray()
            by_hand += [np.maximum(dense, 0).sum(axis=1), np.maximum(-dense, 0).sum(axis=1)]
        assert_array_equal(one_sided(planes, population.size), by_hand)


def test_planes_are_stored_where_they_are_used():
    """300 steps need the second plane, 5 do not: the plane holds one synapse of four, the finest all of them."""
    network = chain([[300.0, 5.0], [0.0, -127.0]], theta=1.0)
    form = Form(bits=8, exponents=(-1, 6), threshold=np.array([1, 1]))
    _, (low, high) = round_population(network.populations[0], network.projections, form)
    assert (low.exponent, high.exponent) == (-1, 6)
    assert (low.weight.toarray().tolist(), low.weight.nnz) == ([[88, 10], [0, -254]], 4)
    assert (high.weight.toarray().tolist(), high.weight.nnz) == ([[4, 0], [0, 0]], 1)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=7), st.integers(1, 4))
def test_grouping_by_fineness_is_optimal(finest, groups):
    shared = group_by_fineness(np.array(finest), groups)
    assert np.all(shared <= finest)
    assert len(set(shared.tolist())) <= groups
    best = min(
        sum(1 / max(t for t in chosen if t <= f) for f in finest)
        for k in range(1, groups + 1)
        for chosen in itertools.combinations(sorted(set(finest)), min(k, len(set(finest))))
        if min(chosen) == min(finest)
    )
    assert np.sum(1 / shared) == pytest.approx(best)


@pytest.mark.parametrize(("bits", "exponents"), [(8, (-1, 6)), (8, (3,)), (4, (0, 3))])
def test_the_finest_scales_are_legal_and_hardly_more_is(bits, exponents):
    """Sums of hundreds of weights fill the accumulator long before a weight fills its planes."""
    layer = layer_of(chain(np.abs(np.random.default_rng(0).normal(0, 0.1, (4, 900)))), 0)

    def reached(threshold):
        form = Form(bits=bits, exponents=exponents, threshold=threshold)
        _, integer = round_population(layer.population, layer.projections, form)
        return np.maximum(*one_sided(integer, 4))

    finest = finest_thresholds(layer, bits, exponents)
    assert np.all(reached(finest) <= ONE_STEP_SUM_MAX)
    assert np.all(reached(finest + np.maximum(1, finest // SCALE_STEPS)) > ONE_STEP_SUM_MAX)
    found = fit(layer, bits, exponents, np.inf)
    units = found.form.threshold
    assert found.reached == reached(units).max() <= ONE_STEP_SUM_MAX
    assert reached(units + np.maximum(1, units // SCALE_STEPS)).max() > ONE_STEP_SUM_MAX
    assert abs(units[0] - finest.min()) <= max(1, units[0] // SCALE_STEPS)


@settings(max_examples=10)
@given(
    float_networks(), st.sampled_from(BITS), st.integers(1, 3), st.integers(1, 8), st.booleans(), st.data()
)
def test_every_recipe_gives_a_proven_legal_network(network, bits, planes, groups, calibrated, data):
    calibration = calibrate(network, data.draw(recordings_for(network.input.size))) if calibrated else None
    packing = Packing(bits=bits, planes=planes, groups=groups)
    integer, choices = choose_storage(network, LOIHI, packings=(packing,), calibration=calibration)
    verify(integer)
    assert all(proof.accumulator <= 2**21 - 1 for proof in prove_ranges(integer))
    assert [choice.layer for choice in choices] == [population.name for population in network.populations]
    for population, model, choice in zip(integer.populations, network.populations, choices, strict=True):
        assert len(np.unique(population.threshold)) == choice.groups <= groups
        assert 1 <= choice.planes <= planes
        assert choice.scale <= choice.finest_scale
        assert_allclose(population.realised_theta, model.theta, rtol=1e-15)
        # a bias is off by half a unit of its register at most, but where it makes up for what no membrane forgets
        unit = 2.0**population.bias_exponent / (64 * population.scale)
        error = population.bias / (64 * population.scale) - model.bias
        moved = choice.compensated or (model.beta == 0 and model.alpha == 0)
        assert moved or np.all(np.abs(error) <= unit / 2 * (1 + 1e-9))
    for projection in integer.projections:
        assert projection.bits == bits
        assert projection.exponent in LOIHI.choices["synapse.exponent"]
        assert not np.any(projection.weight.data % weight_step(bits))
        assert np.all(np.abs(projection.weight.data) <= 256 - weight_step(bits))
    for original in network.projections:  # the finest plane, which comes first, has every synapse
        finest = next(p for p in integer.projections if (p.pre, p.post) == (original.pre, original.post))
        assert np.array_equal(original.weight.indices, finest.weight.indices)
        assert np.array_equal(original.weight.indptr, finest.weight.indptr)


@pytest.mark.parametrize("seed", [2, 24, 30, 59, *range(1000, 1006)])
def test_groups_of_scales_are_proven_after_the_last_rounding(seed):
    """Sums of several planes do not always shrink with the threshold; the first four overflowed by up to a percent."""
    rng = np.random.default_rng(seed)
    network = chain(rng.normal(0, 1, (40, 50)) * rng.choice([1, 4], (40, 1)))
    packing = Packing(bits=int(rng.choice([3, 4, 5])), planes=3, groups=8)
    integer, (choice,) = choose_storage(network, LOIHI, packings=(packing,))
    assert all(proof.holds for proof in prove_ranges(integer))
    assert choice.groups > 1


@pytest.mark.parametrize("most", [1, 5, np.inf])
def test_each_error_is_made_up_for_as_well_as_the_inputs_to_come_can(most):
    """Input after input, with the least squares of those to come solved anew each time; more than a block of them."""
    rng = np.random.default_rng(3)
    events = np.repeat(rng.random((400, 24)) < 0.3, 3, axis=1) & (rng.random((400, 72)) < 0.8)
    together = (events.T.astype(float) @ events) / len(events)
    weight = rng.normal(0, 3, (5, 72))
    order = np.argsort(-np.diag(together), kind="stable")
    damped = together + np.eye(72) * (DAMPING * np.trace(together) / 72)
    left, expected = weight.copy(), np.zeros_like(weight)
    for position, j in enumerate(order):
        rest = order[position + 1 :]
        expected[:, j] = np.clip(np.rint(left[:, j]), -most, most)
        error = left[:, j] - expected[:, j]
        left[:, rest] += np.outer(error, np.linalg.solve(damped[np.ix_(rest, rest)], damped[rest, j]))
    found = round_in_turn(weight[:, order], shares(together[np.ix_(order, order)]), most)
    assert_array_equal(found, expected[:, order])
    assert np.any(expected != np.rint(weight))


def test_errors_cancel_on_the_recordings():
    """Correlated inputs: the summed error of the membrane is smaller than with each weight at its nearest."""
    rng = np.random.default_rng(0)
    network = chain(rng.normal(0, 0.1, (16, 48)))
    cause = rng.random((6, 60, 12)) < 0.25
    calibration = calibrate(network, np.repeat(cause, 4, axis=2) & (rng.random((6, 60, 48)) < 0.9))
    layer, form = layer_of(network, 0), Form(bits=4, exponents=(0,), threshold=np.full(16, 200))

    def error(stored):
        weight = (
            sum(p.effective().toarray() for p in stored.projections) - network.projections[0].weight * 400
        )
        bias = stored.population.bias / 64 - network.populations[0].bias * 400
        return float(np.square(calibration.events.reshape(-1, 48) @ weight.T + bias).mean())

    plain = with_spike_errors(rounded(layer, form), 0, calibration)
    assert error(compensated(layer, plain, calibration)) < 0.6 * error(plain)


def test_compensation_is_kept_only_where_it_keeps_spikes():
    network, calibration = uneven_layer(3)
    integer, (choice,) = choose_storage(network, LOIHI, packings=(Packing(bits=3),), calibration=calibration)
    assert choice.flips == moved(integer, calibration)
    form = Form(bits=3, exponents=(choice.exponent,), threshold=integer.populations[0].threshold)
    nearest = with_spike_errors(rounded(layer_of(network, 0), form), 0, calibration).flips
    assert choice.flips < nearest if choice.compensated else choice.flips == nearest


def test_a_neuron_that_would_overflow_is_rounded_to_nearest():
    """At the very end of the accumulator errors must not add up: the sums stay inside."""
    network, calibration = one_layer(
        np.abs(np.random.default_rng(0).normal(0, 0.1, (4, 300))), samples=4, rate=0.3
    )
    layer = layer_of(network, 0)
    finest = finest_thresholds(layer, 8, (-1, 6))
    plain = rounded(layer, Form(bits=8, exponents=(-1, 6), threshold=finest))
    stored = compensated(layer, with_spike_errors(plain, 0, calibration), calibration)
    assert ONE_STEP_SUM_MAX * 0.99 < stored.reached <= ONE_STEP_SUM_MAX


def two_layers(seed, *, samples=40, outlier=0.0):
    rng = np.random.default_rng(seed)
    weight = rng.normal(0, 0.1, (20, 30))
    weight[0, 0] = outlier
    network = chain(weight, rng.normal(0, 0.4, (5, 20)))
    return network, calibrate(network, rng.random((samples, 30, 30)) < 0.2)


def test_a_network_without_outliers_becomes_exact():
    network, calibration = two_layers(0, samples=33)
    plain, _ = choose_storage(network, LOIHI, packings=(Packing(bits=4),), calibration=calibration)
    assert moved(plain, calibration) > 0
    integer, choices, found = make_exact(network, LOIHI, calibration)
    verify(integer)
    assert moved(integer, calibration) == 0
    for choice, each in zip(choices, found, strict=True):
        assert (choice.flips, each.flips, each.limits, each.decay) == (0, 0, (), 0)
        assert each.tried[0][:2] == (1, 1)
        assert choice.spikes == each.spikes


def test_what_is_in_the_way_is_named():
    """Hundreds of inputs, large and of both signs: one step fills the accumulator long before weights are fine."""
    rng = np.random.default_rng(1)
    network, calibration = one_layer(rng.normal(0, 3.0, (12, 600)), seed=1, samples=40, rate=0.05)
    integer, (choice,), (found,) = make_exact(network, LOIHI, calibration)
    assert found.flips == choice.flips == moved(integer, calibration) > 0
    assert sum(count for _, count in found.limits) == found.flips
    assert "21-bit accumulator" in dict(found.limits)
    assert found.tried[-1][0] >= 2
    assert [count for _, count in found.limits] == sorted((count for _, count in found.limits), reverse=True)


def test_an_outlier_takes_another_plane():
    """A weight three thousand times the threshold beside small ones: one plane cannot hold both."""
    network, calibration = two_layers(2, outlier=200.0)
    integer, choices, found = make_exact(network, LOIHI, calibration)
    assert choices[0].planes >= 2
    assert moved(integer, calibration) < moved(
        choose_storage(network, LOIHI, calibration=calibration)[0], calibration
    )
    assert found[0].tried[0][2] > found[0].flips


def test_spikes_that_the_decay_alone_moves_are_counted():
    """A leak of 1/10000 is less than half a unit of its register: the membrane keeps all."""
    rng = np.random.default_rng(0)
    network, calibration = one_layer(rng.normal(0, 0.2, (6, 12)), samples=3, steps=200, beta=0.9999)
    weight = network.projections[0].weight.toarray()
    differ = 0
    for events, spikes in zip(calibration.events, calibration.spikes[0][:], strict=True):
        u, s = np.zeros((2, 6))
        for t, current in enumerate(events @ weight.T):
            u = u * (1 - s) + current
            s = u > 0.5
            differ += int((s != spikes[t]).sum())
    assert _decay_flips(layer_of(network, 0), calibration) == differ > 0
