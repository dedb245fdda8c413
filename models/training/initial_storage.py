"""The storage that a fine-tuning begins with: a width, an exponent and scales for each layer.

Of all scales those are taken whose rounded weights, weighted by how often their inputs spike, are nearest to the
trained ones [1]_.

References
----------
.. [1] F. Li, B. Zhang, B. Liu, "Ternary weight networks", 2016, arXiv:1605.04711: scales nearest to the weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import (
    BIAS_EXPONENT_MAX,
    BIAS_MANTISSA_MAX,
    MEMBRANE_SHIFT,
    THRESHOLD_MANTISSA_MAX,
    reach,
    step_units,
)
from spikeloom.compiler.ir import Form, Network
from spikeloom.compiler.passes.calibrate import Calibration

QUIET = 1e-4
"""Spike rate that an input without spikes is given, so that its weights still count."""

COARSEST = 12
"""Least threshold, in weight units: a coarser one would be off by more than the weights."""

SHARES = 40
"""Scales that are tried for each neuron."""


def initial_forms(
    network: Network, calibration: Calibration, bits: Sequence[int], groups: int, exponents: tuple[int, ...]
) -> tuple[Form, ...]:
    """Storage whose rounded weights are nearest to the trained ones, neurons grouped by scale.

    `calibration` gives the rate of each input; every layer has its width in `bits` and so many scales at most.

    ModelError if no exponent gives a threshold and biases that the registers hold.
    """
    forms = []
    for post, (population, width) in enumerate(zip(network.populations, bits, strict=True)):
        incoming = [p for p in network.projections if p.post == post]
        weight = np.concatenate([p.weight.toarray() for p in incoming], axis=1)
        rate = np.concatenate([calibration.source(p.pre, p.post).mean(axis=(0, 1)) for p in incoming]) + QUIET
        step = _grouped(_nearest_steps(weight, rate, reach(width, (0,))), groups)  # model units in one step
        for exponent in sorted(exponents):
            threshold = np.rint(population.theta * step_units(width, (exponent,)) / step).astype(np.int64)
            if threshold.min() >= COARSEST:
                break
        largest = np.abs(threshold * population.bias).max(initial=0) / population.theta * (1 << MEMBRANE_SHIFT)
        if threshold.max() > THRESHOLD_MANTISSA_MAX or largest > BIAS_MANTISSA_MAX << BIAS_EXPONENT_MAX:
            raise ModelError(
                f"{population.name}: its weights are too small for its threshold or biases at {width} bits: the "
                "registers overflow; give it more bits"
            )
        forms.append(Form(bits=width, exponents=(exponent,), threshold=np.maximum(threshold, 1)))
    return tuple(forms)


def _nearest_steps(weight: NDArray[np.float64], rate: NDArray[np.float64], codes: int) -> NDArray[np.float64]:
    """Step of each neuron at which its rounded weights are nearest, in squares weighted by `rate`; shape (neurons,)."""
    peak = np.maximum(np.abs(weight).max(axis=1), 1e-9)
    best = np.full(len(weight), np.inf)
    chosen: NDArray[np.float64] = peak / codes
    for share in np.geomspace(1, 1 / 30, SHARES):
        step = peak * share / codes
        rounded = np.clip(np.rint(weight / step[:, None]), -codes, codes) * step[:, None]
        error = (rate * (weight - rounded) ** 2).sum(axis=1)
        better = error < best
        best[better], chosen[better] = error[better], step[better]
    unused = ~weight.any(axis=1)  # where a window sees no taxel any step will do
    if not unused.all():
        chosen[unused] = np.exp(np.log(chosen[~unused]).mean())
    return chosen


def _grouped(values: NDArray[np.float64], groups: int) -> NDArray[np.float64]:
    """Replace each value by the geometric mean of its group; groups by Lloyd's rule from quantiles."""
    logs = np.log(values)
    centres = np.quantile(logs, (np.arange(groups) + 0.5) / groups)
    nearest = np.zeros(len(logs), np.int64)
    for _ in range(50):
        nearest = np.abs(logs[:, None] - centres).argmin(axis=1)
        centres = np.array([logs[nearest == g].mean() if np.any(nearest == g) else centres[g] for g in range(groups)])
    shared: NDArray[np.float64] = np.exp(centres[nearest])
    return shared
