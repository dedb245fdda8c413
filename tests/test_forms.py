"""How weights are stored: planes, steps and thresholds, against plain arithmetic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_networks import BITS, chain, float_networks

from spikeloom.compiler.fixedpoint import plane_distance, reach, split_planes, weight_step
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.ir import Form, IntegerNetwork, one_sided
from spikeloom.compiler.targets.loihi1.storage.weight_storage import round_population, scales


@st.composite
def storages(draw):
    """A width and one to three exponents that leave no gap."""
    bits = draw(st.sampled_from(BITS))
    exponents = [draw(st.integers(-1, 3))]
    for _ in range(draw(st.integers(0, 2))):
        exponents.append(exponents[-1] + draw(st.integers(1, plane_distance(bits))))
    return bits, tuple(exponents)


@given(storages())
def test_planes_hold_every_step_up_to_their_reach(storage):
    bits, exponents = storage
    limit = reach(bits, exponents)
    steps = np.arange(-limit, limit + 1) if limit < 5000 else np.unique(np.linspace(-limit, limit, 9999).astype(int))
    planes = split_planes(steps, bits, exponents)
    total = sum(plane * 2 ** (e - exponents[0]) for plane, e in zip(planes, exponents, strict=True))
    np.testing.assert_array_equal(total, steps * weight_step(bits))
    for plane in planes:
        assert not np.any(plane % weight_step(bits))
        assert np.abs(plane).max() <= 256 - weight_step(bits)


@given(storages())
def test_a_coarser_plane_is_used_only_where_the_finer_ones_do_not_reach(storage):
    bits, exponents = storage
    limit = reach(bits, exponents)
    steps = np.unique(np.linspace(-limit, limit, 2001).astype(int))
    for k, plane in enumerate(split_planes(steps, bits, exponents)[1:], start=1):
        held = np.abs(steps) <= reach(bits, exponents[:k])
        assert not plane[held].any()


@pytest.mark.parametrize("bits", BITS)
def test_the_distance_of_planes_is_the_largest_without_a_gap(bits):
    for distance, gap in ((plane_distance(bits), False), (plane_distance(bits) + 1, True)):
        steps = np.arange(reach(bits, (0,)) + 2**distance)
        planes = split_planes(steps, bits, (0, distance))
        assert (np.abs(planes[0]).max() > 256 - weight_step(bits)) == gap


@settings(deadline=None, max_examples=50)
@given(float_networks(), storages(), st.data())
def test_a_rounded_population_is_the_nearest_of_its_grid(network, storage, data):
    bits, exponents = storage
    for post, population in enumerate(network.populations):
        incoming = tuple(p for p in network.projections if p.post == post)
        threshold = np.array(data.draw(st.lists(st.integers(1, 9), min_size=population.size, max_size=population.size)))
        form = Form(bits=bits, exponents=exponents, threshold=threshold)
        integer, planes = round_population(population, incoming, form)
        np.testing.assert_allclose(integer.realised_theta, population.theta, rtol=1e-15)
        step, limit = weight_step(bits) * 2.0 ** exponents[0], reach(bits, exponents)
        for projection in incoming:
            stored = sum(p.effective().toarray() for p in planes if p.pre == projection.pre)
            wanted = projection.weight.toarray() * scales(population, form)[:, None] / step
            error = stored / step - np.clip(wanted, -limit, limit)
            assert np.abs(error).max(initial=0) <= 0.5 * (1 + 1e-9)
        sums = np.maximum(*one_sided(planes, population.size))
        by_hand = np.zeros((2, population.size))
        for plane in planes:
            dense = plane.effective().toarray()
            by_hand += [np.maximum(dense, 0).sum(axis=1), np.maximum(-dense, 0).sum(axis=1)]
        np.testing.assert_array_equal(sums, by_hand.max(axis=0))


def test_planes_are_stored_where_they_are_used():
    """300 steps need the second plane, 5 do not: the plane holds one synapse of four, the finest all of them."""
    network = chain([[300.0, 5.0], [0.0, -127.0]], theta=1.0)
    form = Form(bits=8, exponents=(-1, 6), threshold=np.array([1, 1]))
    population, (low, high) = round_population(network.populations[0], network.projections, form)
    assert (low.exponent, high.exponent) == (-1, 6)
    assert low.weight.toarray().tolist() == [[88, 10], [0, -254]]
    assert low.weight.nnz == 4
    assert (high.weight.toarray().tolist(), high.weight.nnz) == ([[4, 0], [0, 0]], 1)
    verify(
        IntegerNetwork(
            input=network.input,
            populations=(population,),
            projections=(low, high),
            readout=network.readout,
            classes=network.classes,
        )
    )
