"""Run single neurons again, with one deviation of the chip taken away at a time.

A netlist is entitled to round weights, biases, decays and membranes, and to the limits of its registers; whether what
it stores is the rounding of its checkpoint at all is for :mod:`equivalence.rounding` to say.

The neurons start from rest and get the synaptic sums of given steps. They fire where float model and chip both did,
which resets a membrane but no current; at any other step but their last they do not fire, or the replay says that they
would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.fixedpoint import DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT, reach, step_units
from spikeloom.compiler.ir import IntegerNetwork, Network
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence.rounding import SLACK, summed

WEIGHTS, BIAS, BETA = "weight rounding", "bias rounding", "realised beta"
TRUNCATION, SATURATION, TIE = "round toward zero", "saturation or overflow", "tie (> or >=)"
LEFT_OUT, UNKNOWN = "neuron left out", "not known"

STORED, UNROUNDED, UNCLIPPED = range(3)
"""Weights of a replay: as stored, as the checkpoint has them, as stored but for those that the range cuts off."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """A replay: the stored neurons without the deviation `cause`.

    Weights are STORED, UNROUNDED or UNCLIPPED; bias (neurons,) and the membrane's limit are in membrane units; `keep_u`
    and `keep_v` are what a step keeps of current and membrane, rounded toward zero if `rounds`.
    """

    cause: str
    weights: int
    bias: FloatArray
    keep_u: float
    keep_v: float
    limit: float = float(MEMBRANE_MAX)
    rounds: bool = True


def sources_into(network: Network, integer: IntegerNetwork, post: int) -> tuple[int, ...]:
    """Presynaptic populations of a population on either side, the input first."""
    return tuple(sorted({p.pre for stage in (network, integer) for p in stage.projections if p.post == post}))


def weights_into(network: Network, integer: IntegerNetwork, post: int, rows: IntArray) -> FloatArray:
    """Weights in membrane units into neurons of a population, (3, neurons, sources), by ``Variant.weights``."""
    pres, scale = sources_into(network, integer, post), integer.populations[post].scale[rows]
    real, stored = (
        np.concatenate([summed(stage, pre, post)[rows].toarray() for pre in pres], axis=1)
        for stage in (network, integer)
    )
    real *= scale[:, None]
    planes = {(p.bits, p.exponent) for p in integer.projections if p.post == post}
    bits, exponents = min(b for b, _ in planes), tuple(sorted({e for _, e in planes}))
    clipped = np.abs(real) > reach(bits, exponents) * step_units(bits, exponents) * SLACK
    return np.stack([stored, real, np.where(clipped, real, stored)]) * (1 << MEMBRANE_SHIFT)


def variants_of(
    network: Network, integer: IntegerNetwork, post: int, rows: IntArray, *, compensated: bool
) -> list[Variant]:
    """What to run for neurons of a population: the netlist as it is, then without each deviation."""
    wanted, chip, one = network.populations[post], integer.populations[post], 1 << DECAY_BITS
    exact = wanted.bias[rows] * chip.scale[rows] * (1 << MEMBRANE_SHIFT)
    netlist = Variant(
        cause=UNKNOWN,
        weights=STORED,
        bias=chip.bias[rows].astype(np.float64),
        keep_u=(one - chip.decay_u - 1) / one,
        keep_v=(one - chip.decay_v) / one,
    )
    # where a rounding compensates, biases make up for weights: both go together
    with_weights, alone = (exact, netlist.bias) if compensated else (netlist.bias, exact)
    return [
        netlist,
        replace(netlist, cause=WEIGHTS, weights=UNCLIPPED),
        replace(netlist, cause=WEIGHTS, weights=UNROUNDED, bias=with_weights),
        replace(netlist, cause=BIAS, bias=alone),
        replace(netlist, cause=BETA, keep_u=wanted.alpha, keep_v=wanted.beta),
        replace(netlist, cause=SATURATION, limit=np.inf),
        replace(netlist, cause=TRUNCATION, rounds=False),  # last, see run_variants
    ]


def run_variants(
    variants: list[Variant],
    threshold: FloatArray,
    inflows: FloatArray,
    begins: IntArray,
    steps: IntArray,
    fired: BoolArray,
) -> tuple[FloatArray, BoolArray]:
    """Run neurons from rest over what they remember, from step `begins` to `steps`; the longest come first.

    Of the variants the last one, and only it, does not round. `inflows` (3, steps, neurons) are shifted synaptic sums
    by ``Variant.weights``; float model and chip both `fired` (steps, neurons). Gives (variants, neurons): membrane
    minus threshold in the last step, and whether the neuron fired before it, where it should not.
    """

    def column(values: list[float]) -> FloatArray:
        return np.array(values, np.float64)[:, None]

    bias = np.stack([v.bias for v in variants])
    keep_u, keep_v = column([v.keep_u for v in variants]), column([v.keep_v for v in variants])
    limit, which = column([v.limit for v in variants]), [v.weights for v in variants]
    length = steps - begins + 1
    place = np.arange(len(length))
    u, v = np.zeros(bias.shape), np.zeros(bias.shape)
    margins, early = np.zeros(bias.shape), np.zeros(bias.shape, np.bool_)
    running = len(length)
    for k in range(int(length[0])):
        u, v = keep_u * u[:, :running], keep_v * v[:, :running]
        for state in (u, v):
            np.trunc(state[:-1], out=state[:-1])
        u += inflows[:, begins[:running] + k, place[:running]][which]
        v += u
        v += bias[:, :running]
        np.clip(v, -limit, limit, out=v)
        left = int(np.count_nonzero(length > k + 1))
        margins[:, left:running] = v[:, left:] - threshold[left:running]
        both = fired[begins[:left] + k, place[:left]]
        early[:, :left] |= (v[:, :left] > threshold[:left]) & ~both
        v[:, :left] *= ~both
        running = left
    return margins, early
