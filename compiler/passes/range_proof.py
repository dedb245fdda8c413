"""Prove that registers stay in range for any input, from the weights alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.ir import IntegerNetwork, one_sided
from spikeloom.compiler.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeProof:
    """Worst cases of one population over all inputs, register units."""

    json_properties: ClassVar = ("holds",)

    layer: str  # Population
    # accumulator, current, membrane: Largest magnitude that any input can bring to any neuron; infinite where nothing
    # bounds it
    accumulator: float
    current: float
    membrane: float

    @property
    def holds(self) -> bool:
        """Whether no register can leave its range, whatever the input."""
        return self.accumulator <= ACCUMULATOR_MAX and self.current <= CURRENT_MAX and self.membrane <= MEMBRANE_MAX


def settled(inflow: FloatArray | IntArray, kept: float) -> FloatArray:
    """Limit of ``x <- kept * x + inflow``: what a leaking register can add up to."""
    limit: FloatArray = inflow / (1 - kept) if kept < 1 else np.where(inflow > 0, np.inf, 0.0)
    return limit


def prove_ranges(network: IntegerNetwork) -> tuple[RangeProof, ...]:
    """Bound every register of every population.

    The accumulator is bounded by the positive and the negative weights of a neuron taken separately, which covers
    every order of arrival. A membrane is bounded above by its threshold (it is reset when it passes it) plus one
    step, and below by what the leak lets negative input add up to.
    """
    proofs = []
    for post, population in enumerate(network.populations):
        into = (projection for projection in network.projections if projection.post == post)
        positive, negative = one_sided(into, population.size)
        unit = 1 << MEMBRANE_SHIFT
        kept_u = population.realised_alpha
        up, down = settled(positive * unit, kept_u), settled(negative * unit, kept_u)
        rise = population.realised_beta * population.threshold * unit + up + np.maximum(population.bias, 0)
        fall = settled(down + np.maximum(-population.bias, 0), population.realised_beta)
        proofs.append(
            RangeProof(
                layer=population.name,
                accumulator=float(np.maximum(positive, negative).max(initial=0) * unit),
                current=float(np.maximum(up, down).max(initial=0)),
                membrane=float(np.maximum(rise, fall).max(initial=0)),
            )
        )
    return tuple(proofs)
