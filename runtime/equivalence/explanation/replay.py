"""Run single neurons again, with one deviation taken away at a time.

The neurons start from rest and get the synaptic sums of given steps. They fire where float model and chip both did,
which resets a membrane but no current; at any other step but their last they do not fire, or the replay says that they
would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_MAX
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence.explanation.deviations import (
    BETA,
    BIAS,
    SATURATION,
    THRESHOLD,
    TRUNCATION,
    UNKNOWN,
    WEIGHTS,
    LayerValues,
)

STORED, UNROUNDED, UNCLIPPED = range(3)
"""Synaptic sums of a replay: of the weights as stored, as the checkpoint has them, as stored but for clipped ones."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """A replay: the stored neurons without one deviation.

    Weights are STORED, UNROUNDED or UNCLIPPED; bias and threshold (neurons,) and the membrane's limit are in membrane
    units; `keep_u` and `keep_v` are what a step keeps of current and membrane, rounded toward zero if `rounds`.
    """

    cause: str
    weights: int
    bias: FloatArray
    threshold: FloatArray
    keep_u: float
    keep_v: float
    limit: float = float(MEMBRANE_MAX)
    rounds: bool = True


def variants_of(values: LayerValues, rows: IntArray) -> list[Variant]:
    """What to run for the neurons `rows`: the netlist as it is, then without each deviation."""
    stored, ideal = values.stored, values.ideal
    netlist = Variant(
        cause=UNKNOWN,
        weights=STORED,
        bias=stored.bias[rows],
        threshold=stored.threshold[rows],
        keep_u=stored.keep_u,
        keep_v=stored.keep_v,
    )
    exact = ideal.bias[rows]
    # where a rounding compensates, biases make up for weights: both go together
    with_weights, alone = (exact, netlist.bias) if values.compensated else (netlist.bias, exact)
    return [
        netlist,
        replace(netlist, cause=WEIGHTS, weights=UNCLIPPED),
        replace(netlist, cause=WEIGHTS, weights=UNROUNDED, bias=with_weights),
        replace(netlist, cause=BIAS, bias=alone),
        replace(netlist, cause=THRESHOLD, threshold=ideal.threshold[rows]),
        replace(netlist, cause=BETA, keep_u=ideal.keep_u, keep_v=ideal.keep_v),
        replace(netlist, cause=SATURATION, limit=np.inf),
        replace(netlist, cause=TRUNCATION, rounds=False),  # last, see run_variants
    ]


def run_variants(
    variants: list[Variant], inflows: FloatArray, begins: IntArray, steps: IntArray, fired: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Run neurons from rest over what they remember.

    Parameters
    ----------
    variants : list of Variant
        The last one, and only it, does not round.
    inflows : (3, steps, neurons) float64
        Shifted synaptic sums, by ``Variant.weights``.
    begins, steps : (neurons,) int64
        First and last step of each; the longest come first.
    fired : (steps, neurons) bool
        Where float model and chip both fired.

    Returns
    -------
    margins : (variants, neurons) float64
        Membrane minus threshold in the last step.
    early : (variants, neurons) bool
        Whether the neuron fired before it, where it should not.
    """

    def column(values: list[float]) -> FloatArray:
        return np.array(values, np.float64)[:, None]

    bias, threshold = (np.stack(rows) for rows in zip(*((v.bias, v.threshold) for v in variants), strict=True))
    keep_u, keep_v = column([v.keep_u for v in variants]), column([v.keep_v for v in variants])
    limit, which = column([v.limit for v in variants]), [v.weights for v in variants]
    length = steps - begins + 1
    place = np.arange(len(length))
    u, v = np.zeros(bias.shape), np.zeros(bias.shape)
    margins, early = np.zeros(bias.shape), np.zeros(bias.shape, np.bool_)
    running = len(length)
    for k in range(int(length[0])):
        u, v = u[:, :running], v[:, :running]
        if keep_u.any():
            u = keep_u * u
            np.trunc(u[:-1], out=u[:-1])
        else:
            u = np.zeros_like(u)
        u += inflows[:, begins[:running] + k, place[:running]][which]
        v = keep_v * v
        np.trunc(v[:-1], out=v[:-1])
        v += u
        v += bias[:, :running]
        np.clip(v, -limit, limit, out=v)
        left = int(np.count_nonzero(length > k + 1))
        margins[:, left:running] = v[:, left:] - threshold[:, left:running]
        both = fired[begins[:left] + k, place[:left]]
        early[:, :left] |= (v[:, :left] > threshold[:, :left]) & ~both
        v[:, :left] *= ~both
        running = left
    return margins, early
