"""``benchmarks/first_spike.py``: what it proves of networks that spike once is so, by all changes of small ones."""

import importlib
from itertools import product
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
STEPS, PIXELS, HIDDEN, CLASSES, MOST = 6, 6, 5, 3, 3


@pytest.fixture(scope="module")
def script():
    """The script, as one that is run finds its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module("first_spike")


def least_that_alters(script, network, pixels, decision):
    """Fewest steps in all that alter a decision, of all that are at most MOST; one more if none do."""
    images = np.array(list(product(range(STEPS), repeat=PIXELS)))
    by = np.abs(images - pixels).sum(axis=1)
    for steps in range(MOST + 1):
        outputs = [network.outputs(each) for each in images[by == steps]]
        if not script.first_alone(np.array(outputs), decision).all():
            return steps
    return MOST + 1


def test_verdicts_and_bounds_are_those_of_all_changes(script):
    draw = np.random.default_rng(5)
    found = []
    by_bounds = set()
    for _ in range(120):
        weights = [draw.normal(25, 30, (HIDDEN, PIXELS)), draw.normal(60, 150, (CLASSES, HIDDEN))]
        network = script.Network(weights, STEPS)
        pixels = draw.integers(0, STEPS, PIXELS)
        decision = int(network.outputs(pixels).argmin())
        least = least_that_alters(script, network, pixels, decision)
        for delta in range(1, MOST + 1):
            assert script.holds(network, pixels, decision, delta) == (delta < least)
            told = script.verdict(network, pixels, decision, delta)
            assert told == (delta < least) or (told is None and delta > script.EXACT)
            if least and script.proven(network, pixels, decision, delta):
                assert delta < least
                by_bounds.add(delta)
        found.append(least)
    assert set(found) == set(range(MOST + 2))
    assert by_bounds
