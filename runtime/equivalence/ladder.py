"""The ladder from the float model to the chip: networks with one deviation more on each rung.

=================  ===================================================================
``float64``        sums in float64 instead of float32
``beta``           the decays that the registers realise
``weights``        rounded weights
``bias_threshold`` rounded biases and thresholds
``rounding``       integer registers, whose decay drops fractions, but without limits
``saturation``     the limits of the registers: the chip
=================  ===================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.interpret import run_float, run_integer
from spikeloom.compiler.ir import IntegerNetwork, Network, Projection, Sparse
from spikeloom.compiler.range_proof import prove_ranges
from spikeloom.compiler.types import BoolArray, FloatArray

LADDER = ("float64", "beta", "weights", "bias_threshold", "rounding", "saturation")
"""Deviations in the order in which they are added; the last one is the chip."""


def realised(network: Network, integer: IntegerNetwork) -> tuple[Network, Network, Network]:
    """Float networks that carry the chip's decays; these and its weights; all of these, its biases and thresholds.

    They are in the float model's units, to be run in float64.
    """
    beta = replace(
        network,
        populations=tuple(
            replace(population, beta=chip.realised_beta, alpha=chip.realised_alpha)
            for population, chip in zip(network.populations, integer.populations, strict=True)
        ),
    )
    weights = replace(
        beta,
        projections=tuple(
            Projection(
                pre=projection.pre,
                post=projection.post,
                weight=_rows_scaled(projection.effective(), 1 / integer.populations[projection.post].scale),
            )
            for projection in integer.projections
        ),
    )
    # A neuron with another threshold fires as one with the model's threshold whose weights and bias are scaled to it.
    stretch = [population.theta / np.maximum(population.realised_theta, 1e-300) for population in integer.populations]
    bias_threshold = replace(
        weights,
        populations=tuple(
            replace(population, bias=chip.bias / (chip.scale * (1 << MEMBRANE_SHIFT)) * factor)
            for population, chip, factor in zip(beta.populations, integer.populations, stretch, strict=True)
        ),
        projections=tuple(
            replace(projection, weight=_rows_scaled(projection.weight, stretch[projection.post]))
            for projection in weights.projections
        ),
    )
    return beta, weights, bias_threshold


def _rows_scaled(weight: Sparse, factor: FloatArray) -> Sparse:
    """Multiply each row of a csr_array by a factor of its own; float64."""
    scaled = weight.astype(np.float64)
    scaled.data *= np.repeat(factor, np.diff(weight.indptr))
    return scaled


def rungs(
    network: Network, integer: IntegerNetwork, inputs: BoolArray, begin: Callable[[str], None]
) -> Iterator[tuple[str, tuple[BoolArray, ...] | None]]:
    """Spikes of the rungs between float64 and the chip; None for one that is proven to be the chip itself."""
    for stage, rung in zip(LADDER[1:4], realised(network, integer), strict=True):
        begin(f"ladder: {stage}")
        yield stage, run_float(rung, inputs).spikes
    if all(proof.holds for proof in prove_ranges(integer)):
        begin("ladder: proven")  # no register leaves its range on any input: without limits the chip is the same
        yield "rounding", None
    else:
        begin("ladder: rounding")
        yield "rounding", run_integer(integer, inputs, saturates=False).spikes
