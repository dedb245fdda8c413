"""Scales for groups of neurons, and rounding with errors that cancel."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import BITS, LOIHI, chain, float_networks, moved, recordings_for

from spikeloom.compiler import Recipe
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import Form, one_sided
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.range_proof import prove_ranges
from spikeloom.compiler.targets.loihi1.storage.compensate import compensated
from spikeloom.compiler.targets.loihi1.storage.quantize import quantize
from spikeloom.compiler.targets.loihi1.storage.scales import (
    choose_levels,
    finest_thresholds,
    flips,
    group_by_fineness,
    layer_of,
    planes_from,
    rounded,
)
from spikeloom.compiler.targets.loihi1.storage.weight_storage import round_population

LOIHI_EXPONENTS = LOIHI.choices["synapse.exponent"]


def uneven_layer(seed=0, *, inputs=40, outputs=24):
    """Neurons whose weights differ by a factor of a hundred, with recordings."""
    rng = np.random.default_rng(seed)
    weight = rng.normal(0, 0.1, (outputs, inputs)) * np.geomspace(0.3, 30, outputs)[:, None]
    network = chain(weight, biases=[rng.normal(0, 0.05, outputs)])
    return network, calibrate(network, rng.random((8, 40, inputs)) < 0.2)


# --- grouping


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


@given(st.integers(0, 2**31), st.integers(1, 4))
def test_levels_are_no_worse_than_one_and_get_better_with_more(seed, groups):
    rng = np.random.default_rng(seed)
    cost = rng.integers(0, 50, (12, 6)).astype(float)
    cost[:, 1:][rng.random((12, 5)) < 0.3] = np.inf
    picked = choose_levels(cost, groups)
    assert len(picked) <= groups
    total = cost[:, picked].min(axis=1).sum()
    assert np.isfinite(total)
    assert total <= min(cost[:, [level]].min(axis=1).sum() for level in range(6))
    # no single exchange makes it better
    for i, level in itertools.product(range(len(picked)), range(6)):
        assert cost[:, [*np.delete(picked, i), level]].min(axis=1).sum() >= total


@settings(deadline=None, max_examples=25)
@given(float_networks(), st.sampled_from(BITS), st.integers(1, 3))
def test_the_finest_thresholds_are_legal_and_hardly_more_is(network, bits, planes):
    exponents = planes_from(0, bits, planes, LOIHI_EXPONENTS)
    for post, population in enumerate(network.populations):
        projections = tuple(p for p in network.projections if p.post == post)
        finest = finest_thresholds(layer_of(network, post), bits, exponents)
        form = Form(bits=bits, exponents=exponents, threshold=np.maximum(finest, 1))
        _, integer = round_population(population, projections, form)
        assert np.all((np.maximum(*one_sided(integer, population.size)) <= ONE_STEP_SUM_MAX)[finest > 0])


@settings(deadline=None, max_examples=30)
@given(float_networks(), st.sampled_from(BITS), st.integers(1, 3), st.integers(1, 8), st.booleans(), st.data())
def test_every_recipe_gives_a_proven_legal_network(network, bits, planes, groups, calibrated, data):
    calibration = calibrate(network, data.draw(recordings_for(network.input.size))) if calibrated else None
    recipe = Recipe(bits=bits, planes=planes, groups=groups)
    integer, choices = quantize(network, LOIHI, recipes=(recipe,), calibration=calibration)
    verify(integer)
    assert all(proof.accumulator <= 2**21 - 1 for proof in prove_ranges(integer))
    for population, choice in zip(integer.populations, choices, strict=True):
        assert len(np.unique(population.threshold)) == choice.groups <= groups
        assert 1 <= choice.planes <= planes
        assert choice.scale <= choice.finest_scale
        np.testing.assert_allclose(population.realised_theta, population.theta, rtol=1e-15)


def test_planes_and_groups_keep_more_spikes():
    network, calibration = uneven_layer()
    steps = [Recipe(bits=4), Recipe(bits=4, groups=8), Recipe(bits=4, planes=2), Recipe(bits=4, planes=2, groups=8)]
    one, grouped, two, both = (
        moved(quantize(network, LOIHI, recipes=(recipe,), calibration=calibration)[0], calibration) for recipe in steps
    )
    assert both <= grouped < one
    assert both <= two < one


def test_layers_may_differ():
    network = chain(np.eye(3) * 0.6, np.eye(3) * 0.6)
    integer, choices = quantize(network, LOIHI, recipes=(Recipe(bits=8), Recipe(bits=2, planes=2)))
    assert [choice.bits for choice in choices] == [8, 2]
    assert {(p.post, p.bits) for p in integer.projections} == {(0, 8), (1, 2)}


# --- compensation


@pytest.mark.parametrize("seed", range(4))
def test_errors_cancel_on_the_recordings(seed):
    """Correlated inputs: the summed error of the membrane is smaller than with each weight at its nearest."""
    rng = np.random.default_rng(seed)
    network = chain(rng.normal(0, 0.1, (16, 48)))
    cause = rng.random((6, 60, 12)) < 0.25
    calibration = calibrate(network, np.repeat(cause, 4, axis=2) & (rng.random((6, 60, 48)) < 0.9))
    population, projections = network.populations[0], network.projections
    form = Form(bits=4, exponents=(0,), threshold=np.full(16, 200))
    layer = layer_of(network, 0)
    nearest, other = rounded(layer, form), compensated(layer, form, calibration)

    def error(layer):
        weight = sum(p.effective().toarray() for p in layer.projections) - projections[0].weight.toarray() * 400
        bias = layer.population.bias / 64 - population.bias * 400
        return float(np.square(calibration.events.reshape(-1, 48) @ weight.T + bias).mean())

    assert error(other) < 0.6 * error(nearest)
    verify(quantize(network, LOIHI, recipes=(Recipe(bits=4),), calibration=calibration)[0])


def test_compensation_is_kept_only_where_it_keeps_spikes():
    network, calibration = uneven_layer(3)
    integer, (choice,) = quantize(network, LOIHI, recipes=(Recipe(bits=3),), calibration=calibration)
    assert choice.flips == moved(integer, calibration)
    form = Form(bits=3, exponents=(choice.exponent,), threshold=integer.populations[0].threshold)
    nearest = int(flips(rounded(layer_of(network, 0), form), 0, calibration).sum())
    assert choice.flips < nearest if choice.compensated else choice.flips == nearest


def test_a_neuron_that_would_overflow_is_rounded_to_nearest():
    """At the very end of the accumulator errors must not add up: the sums stay inside."""
    rng = np.random.default_rng(0)
    network = chain(np.abs(rng.normal(0, 0.1, (4, 300))))
    calibration = calibrate(network, rng.random((4, 50, 300)) < 0.3)
    layer = layer_of(network, 0)
    finest = finest_thresholds(layer, 8, (-1, 6))
    stored = compensated(layer, Form(bits=8, exponents=(-1, 6), threshold=finest), calibration)
    assert ONE_STEP_SUM_MAX * 0.99 < stored.reached <= ONE_STEP_SUM_MAX
