"""Rounding to registers: published values, exact fractions, nearest of the grid."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spikeloom.compiler.fixedpoint import (
    ACCUMULATOR_MAX,
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    CURRENT_MAX,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    ONE_STEP_SUM_MAX,
    THRESHOLD_MANTISSA_MAX,
    encode_bias,
    round_half_even,
    round_steps,
    weight_step,
)
from spikeloom.runtime.machines.loihi1.spec import decayed

# Published for decay_v = 3277, factor 819/4096.
PUBLISHED = {1: 0, 5: 0, 6: 1, 64: 12, 3840: 767, 1920: 383, 8128: 1625, 8191: 1637, 8388607: 1677311}
LARGEST = {2: 128, 3: 192, 4: 224, 5: 240, 6: 248, 8: 254}
"""Mantissa of each storage width."""


def mantissas(weight, scale, bits):
    """Weights rounded to one plane of a width."""
    return round_steps(weight, scale, bits, (0,)) * weight_step(bits)


def test_registers_have_their_published_widths():
    assert (ACCUMULATOR_MAX, CURRENT_MAX, MEMBRANE_MAX) == (2097151, 8388607, 8388607)
    assert (BIAS_MANTISSA_MAX, BIAS_EXPONENT_MAX, THRESHOLD_MANTISSA_MAX) == (4095, 7, 131071)
    assert MEMBRANE_SHIFT == 6
    assert 64 * ONE_STEP_SUM_MAX <= ACCUMULATOR_MAX < 64 * (ONE_STEP_SUM_MAX + 1)


def test_decay_of_beta_one_fifth_is_the_published_one():
    for before, after in PUBLISHED.items():
        assert (decayed(before, 3277), decayed(-before, 3277)) == (after, -after)


@given(st.integers(-(2**24), 2**24), st.integers(0, 4096))
def test_decay_rounds_the_exact_product_toward_zero(x, lost):
    assert decayed(x, lost) == int(Fraction(x * (4096 - lost), 4096))  # int of a fraction truncates


def test_round_half_even_goes_to_the_even_neighbour():
    assert round_half_even(np.array([-1.5, -0.5, 0.5, 1.5, 2.5, 2.499, -2.501])).tolist() == [-2, 0, 0, 2, 2, 2, -3]


@pytest.mark.parametrize(("bits", "largest"), LARGEST.items())
def test_weights_at_the_ends_of_each_width_and_half_a_step_off(bits, largest):
    step = weight_step(bits)
    assert step == 2 ** (9 - bits)
    ends = np.array([largest, largest + step / 2, largest + step, 1e6])
    assert mantissas(ends, 1.0, bits).tolist() == [largest] * 4
    values = np.array([step / 2, -step / 2, step / 2 + 1e-6, -step / 2 - 1e-6])
    assert mantissas(values, 1.0, bits).tolist() == [0, 0, step, -step]


@given(st.sampled_from([*LARGEST]), st.lists(st.floats(-3, 3), min_size=1, max_size=5), st.floats(0.1, 300))
def test_weights_are_the_nearest_of_their_grid_and_symmetric(bits, weights, scale):
    step, weight = weight_step(bits), np.array(weights)
    mantissa = mantissas(weight, scale, bits)
    grid = np.arange(-(256 - step), 256, step)
    assert set(mantissa.tolist()) <= set(grid.tolist())
    assert np.array_equal(mantissas(-weight, scale, bits), -mantissa)
    nearest = np.abs(grid[:, None] - weight * scale).min(axis=0)
    np.testing.assert_allclose(np.abs(mantissa - weight * scale), nearest, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("bias", "mantissa", "exponent"),
    [
        (0.0, 0, 0),
        (0.5, 0, 0),
        (-1.5, -2, 0),
        (4095.5, 2048, 1),
        (4096.0, 2048, 1),
        (8191.0, 2048, 2),
        (4095.0 * 128, 4095, 7),
        (4095.49 * 128, 4095, 7),
    ],
)
def test_bias_takes_the_smallest_exponent(bias, mantissa, exponent):
    found = encode_bias(np.array([bias]))
    assert [part.tolist() for part in found] == [[mantissa], [exponent]]
    assert all(part.dtype == np.int64 for part in found)


@pytest.mark.parametrize("bias", [4095.5 * 128, -4095.5 * 128, 1e9])
def test_a_bias_beyond_the_register_is_refused(bias):
    message = f"bias of magnitude {abs(bias):.6g} exceeds 4095 * 2**7 membrane units"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        encode_bias(np.array([0.0, bias]))


@given(st.lists(st.floats(-4095 * 128, 4095 * 128), min_size=1, max_size=4))
def test_a_bias_is_off_by_half_a_unit_of_its_exponent_at_most(bias):
    mantissa, exponent = encode_bias(np.array(bias))
    assert np.all(np.abs(mantissa) <= 4095)
    assert np.all((exponent >= 0) & (exponent <= 7))
    assert np.all(np.abs(mantissa * 2.0**exponent - bias) <= 2.0**exponent / 2)
    smaller = np.abs(np.rint(np.array(bias) / 2.0 ** (exponent - 1))) <= 4095
    assert not np.any(smaller & (exponent > 0))
