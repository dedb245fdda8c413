"""Planes and scales until the spikes are equal, or the limit that is in the way."""

import numpy as np
import pytest
from random_networks import LOIHI, chain, moved

from spikeloom.compiler import Recipe
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.targets.loihi1.storage.quantize import quantize
from spikeloom.compiler.targets.loihi1.storage.spike_exact import make_exact


def layer(seed, *, inputs=30, outputs=20, samples=40, outlier=0.0):
    rng = np.random.default_rng(seed)
    weight = rng.normal(0, 0.1, (outputs, inputs))
    weight[0, 0] = outlier
    network = chain(weight, rng.normal(0, 0.4, (5, outputs)))
    return network, calibrate(network, rng.random((samples, 30, inputs)) < 0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_network_without_outliers_becomes_exact(seed):
    network, calibration = layer(seed, samples=33)
    plain, _ = quantize(network, LOIHI, recipes=(Recipe(bits=4),), calibration=calibration)
    assert moved(plain, calibration) > 0
    told = []
    integer, choices, found = make_exact(network, LOIHI, calibration, tell=told.append)
    verify(integer)
    assert told == ["fc1", "fc2"]
    assert [e.flips for e in found] == [choice.flips for choice in choices] == [0, 0]
    assert moved(integer, calibration) == 0
    assert all(e.limits == () and e.decay == 0 for e in found)
    assert all(e.tried[0][:2] == (1, 1) for e in found)
    assert all(choice.spikes == e.spikes for choice, e in zip(choices, found, strict=True))


def test_what_is_in_the_way_is_named():
    """Hundreds of inputs, large and of both signs: one step fills the accumulator long before weights are fine."""
    rng = np.random.default_rng(1)
    network = chain(rng.normal(0, 3.0, (12, 600)))
    calibration = calibrate(network, rng.random((40, 40, 600)) < 0.05)
    integer, (choice,), (found,) = make_exact(network, LOIHI, calibration)
    assert found.flips == choice.flips == moved(integer, calibration) > 0
    assert sum(count for _, count in found.limits) == found.flips
    assert "21-bit accumulator" in dict(found.limits)
    assert found.tried[-1][0] >= 2
    assert [count for _, count in found.limits] == sorted((count for _, count in found.limits), reverse=True)


def test_an_outlier_takes_another_plane():
    """A weight three thousand times the threshold beside small ones: one plane cannot hold both."""
    network, calibration = layer(2, outlier=200.0)
    integer, choices, found = make_exact(network, LOIHI, calibration)
    assert choices[0].planes >= 2
    one, _ = quantize(network, LOIHI, calibration=calibration)
    assert moved(integer, calibration) < moved(one, calibration)
    assert found[0].tried[0][2] > found[0].flips
