"""What makes a chip differ from its float model, and both sides of one layer in the same units.

A netlist is entitled to round weights, biases, decays and membranes, and to the limits of its registers; whether what
it stores is the rounding of its checkpoint at all is for :mod:`equivalence.rounding` to say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import DECAY_BITS, MEMBRANE_SHIFT, reach, step_units
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerProjection, Network, Projection
from spikeloom.compiler.types import BoolArray, FloatArray
from spikeloom.runtime.equivalence.rounding import SLACK

WEIGHTS, BIAS, THRESHOLD = "weight rounding", "bias rounding", "threshold rounding"
BETA, TRUNCATION, SATURATION = "realised beta", "round toward zero", "saturation or overflow"
TIE, LEFT_OUT, UNKNOWN = "tie (> or >=)", "neuron left out", "not known"

CAUSES = (WEIGHTS, BIAS, THRESHOLD, BETA, TRUNCATION, SATURATION, TIE)
"""What can make a chip that holds every neuron differ from the float model."""


@dataclass(frozen=True, slots=True, eq=False)
class Registers:
    """Parameters of one layer in membrane units (1/64 of a weight unit), as real numbers.

    Weights are (neurons, sources), those of :func:`sources_into` side by side; a step keeps the shares `keep_u` of the
    current and `keep_v` of the membrane.
    """

    weight: FloatArray
    bias: FloatArray
    threshold: FloatArray
    keep_u: float
    keep_v: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LayerValues:
    """One layer as it is stored, and as the checkpoint has it at the same scale.

    The range cuts `clipped` weights off; in a `compensated` layer weights, and biases with them, were rounded so that
    their errors cancel.
    """

    stored: Registers
    ideal: Registers
    clipped: BoolArray
    compensated: bool


def sources_into(network: Network, integer: IntegerNetwork, post: int) -> tuple[int, ...]:
    """Presynaptic populations of a population on either side, the input first."""
    return tuple(sorted({p.pre for stage in (network, integer) for p in stage.projections if p.post == post}))


def layer_values(network: Network, integer: IntegerNetwork, post: int, *, compensated: bool) -> LayerValues:
    """Both sides of population `post`."""
    pres = sources_into(network, integer, post)
    wanted, chip = network.populations[post], integer.populations[post]
    unit, one = float(1 << MEMBRANE_SHIFT), 1 << DECAY_BITS
    real, units = _dense(network, post, pres) * chip.scale[:, None], _dense(integer, post, pres)
    planes = {(p.bits, p.exponent) for p in integer.projections if p.post == post}
    bits, exponents = min(b for b, _ in planes), tuple(sorted({e for _, e in planes}))
    return LayerValues(
        stored=Registers(
            units * unit,
            chip.bias.astype(np.float64),
            chip.threshold.astype(np.float64) * unit,
            (one - chip.decay_u - 1) / one,
            (one - chip.decay_v) / one,
        ),
        ideal=Registers(
            real * unit,
            wanted.bias * chip.scale * unit,
            np.asarray(wanted.theta * chip.scale * unit),
            wanted.alpha,
            wanted.beta,
        ),
        clipped=np.abs(real) > reach(bits, exponents) * step_units(bits, exponents) * SLACK,
        compensated=compensated,
    )


def _dense(stage: Network | IntegerNetwork, post: int, pres: tuple[int, ...]) -> FloatArray:
    """Weights into a population; mantissas of planes added up."""
    blocks: list[FloatArray] = []
    for pre in pres:
        columns = stage.input.size if pre == INPUT else stage.populations[pre].size
        block = np.zeros((stage.populations[post].size, columns))
        projections: tuple[Projection | IntegerProjection, ...] = stage.projections
        for projection in projections:
            if (projection.pre, projection.post) == (pre, post):
                weight = projection.effective() if isinstance(projection, IntegerProjection) else projection.weight
                block += weight.toarray()
        blocks.append(block)
    return np.concatenate(blocks, axis=1)
