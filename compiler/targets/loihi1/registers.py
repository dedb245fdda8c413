"""Loihi's registers, and how numbers are rounded to them: decays, planes of weights, biases. Exact; int64 out.

What registers do with them from step to step stands in :mod:`machines.loihi1.spec`.

References
----------
.. [1] M. Davies et al., IEEE Micro 38(1), 82-99, 2018, doi:10.1109/MM.2018.112130359.
.. [2] nengo, ``builder/discretize.py`` and ``emulator/interface.py`` of its back-end; lava, ``proc/lif/models.py``.
"""

from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray

DECAY_BITS = 12
"""Decay registers count in 1/4096."""

DECAY_ONE = 1 << DECAY_BITS
"""All of a current or membrane."""

MEMBRANE_SHIFT = 6
"""A weight of one adds 2**6 to the membrane; a threshold mantissa is worth 2**6 too, a bias is not shifted."""

ACCUMULATOR_MAX = 2**21 - 1
"""Largest magnitude of the shifted synaptic sum of one step (21 bits and sign)."""

CURRENT_MAX = 2**23 - 1
"""Largest magnitude of the current register (24 bits, two's complement)."""

MEMBRANE_MAX = 2**23 - 1
"""The membrane register saturates at plus and minus this value (24 bits)."""

BIAS_MANTISSA_MAX = 2**12 - 1
"""Largest magnitude of a bias mantissa (13 bits, signed, used symmetrically)."""

BIAS_EXPONENT_MAX = 7
"""Largest bias exponent."""

THRESHOLD_MANTISSA_MAX = 2**17 - 1
"""Largest threshold mantissa (17 bits)."""

ONE_STEP_SUM_MAX = ACCUMULATOR_MAX >> MEMBRANE_SHIFT
"""Largest sum of effective weights (mantissa times 2**exponent) that one step may bring: 32767."""


def weight_step(bits: int) -> int:
    """Distance between neighbouring mixed-sign weight mantissas of a storage width.

    A mixed-sign format spends one bit on the sign and drops the least significant bits of a 9-bit span, so
    even 8 bits only hold even mantissas.

    >>> [weight_step(bits) for bits in (8, 6, 4, 2)]
    [2, 8, 32, 128]
    """
    return 1 << (9 - bits)


def decay_registers(beta: float, alpha: float = 0.0) -> tuple[int, int]:
    """Registers ``decay_u`` and ``decay_v`` nearest to a current decay and a membrane decay.

    The chip's current loses one part in 4096 more than its register says. So it can forget all, which a
    membrane cannot, and cannot keep all.
    """
    return min(4095, max(0, round(4096 * (1 - alpha)) - 1)), min(4095, max(0, round(4096 * (1 - beta))))


def kept_shares(decay_u: IntArray | int, decay_v: IntArray | int) -> tuple[Any, Any]:
    """Shares of current and membrane that a step keeps, from their registers: what :func:`decay_registers` rounds to.

    >>> kept_shares(4095, 3277) == (0.0, 819 / 4096)
    True
    """
    return (DECAY_ONE - 1 - decay_u) / DECAY_ONE, (DECAY_ONE - decay_v) / DECAY_ONE


def in_units(mantissa: IntArray, exponent: IntArray | int) -> IntArray:
    """``mantissa * 2**exponent``, int64; at exponent -1 mantissas are even."""
    wide = mantissa.astype(np.int64)
    if np.ndim(exponent) == 0:
        return wide >> 1 if exponent < 0 else wide << exponent
    return np.where(np.less(exponent, 0), wide >> 1, wide << np.maximum(exponent, 0))


def plane_distance(bits: int) -> int:
    """Largest difference of exponents at which two planes leave no gap between their values."""
    return bits - 1


def reach(bits: int, exponents: tuple[int, ...]) -> int:
    """Largest magnitude that planes hold together, in steps of the finest one.

    >>> reach(8, (0,)), reach(8, (-1, 6)), reach(2, (0, 1))
    (127, 16383, 3)
    """
    return ((1 << bits - 1) - 1) * sum(1 << (exponent - exponents[0]) for exponent in exponents)


def step_units(bits: int, exponents: tuple[int, ...]) -> float:
    """Weight units of one step of the finest plane."""
    return float(weight_step(bits) * 2.0 ** exponents[0])


def round_steps(
    weight: FloatArray, scale: FloatArray | float, bits: int, exponents: tuple[int, ...]
) -> IntArray:
    """Round weights to whole steps of the finest plane and clip them to what the planes hold.

    `scale`, which broadcasts against `weight`, is in weight units per real unit.

    >>> round_steps(np.array([1.0, -0.3, 100.0]), 254.0, 8, (0,)).tolist()
    [127, -38, 127]
    """
    limit = reach(bits, exponents)
    return np.clip(np.rint(weight * (scale / step_units(bits, exponents))), -limit, limit).astype(np.int64)


def split_planes(steps: IntArray, bits: int, exponents: tuple[int, ...]) -> list[IntArray]:
    """Mantissas of each plane, finest first, which add up to given steps of the finest one.

    A coarser plane is zero wherever the finer ones hold the value.

    >>> [plane.tolist() for plane in split_planes(np.array([5, 127, 128, -300]), 8, (-1, 6))]
    [[10, 254, 0, -88], [0, 0, 2, -4]]
    """
    codes = reach(bits, (0,))
    rest = steps
    mantissas = []
    for k in range(len(exponents) - 1, 0, -1):
        ratio = 1 << (exponents[k] - exponents[0])
        code = np.clip(np.rint(rest / ratio), -codes, codes).astype(np.int64)
        code = np.where(np.abs(rest) <= reach(bits, exponents[:k]), 0, code)
        rest = rest - code * ratio
        mantissas.append(code * weight_step(bits))
    return [rest * weight_step(bits), *reversed(mantissas)]


def encode_bias(bias: FloatArray) -> tuple[IntArray, IntArray]:
    """Round biases in membrane units (1/64 of a weight unit) to mantissa and exponent, the smallest that holds each.

    ``mantissa * 2**exponent`` is the nearest value that the chip can hold; ValueError beyond ``4095 *
    2**7``.

    >>> [part.tolist() for part in encode_bias(np.array([-4095.0, 4096.0, 4095.4, 0.4]))]
    [[-4095, 2048, 4095, 0], [0, 1, 0, 0]]
    """
    exponent = np.zeros(np.shape(bias), np.int64)
    for candidate in range(1, BIAS_EXPONENT_MAX + 1):
        too_small = np.abs(np.rint(np.ldexp(bias, -exponent))) > BIAS_MANTISSA_MAX
        if not too_small.any():
            break
        exponent = np.where(too_small, candidate, exponent)
    mantissa = np.rint(np.ldexp(bias, -exponent)).astype(np.int64)
    if np.any(np.abs(mantissa) > BIAS_MANTISSA_MAX):
        raise ValueError(f"bias of magnitude {np.abs(bias).max():.6g} exceeds 4095 * 2**7 membrane units")
    return mantissa, exponent
