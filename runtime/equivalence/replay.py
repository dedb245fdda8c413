"""Run single neurons again, with one deviation taken away at a time.

The neurons start from rest and get the synaptic sums of given steps. They fire where float model and chip both did,
which resets a membrane but no current; at any other step but their last they do not fire, or the replay says that they
would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_MAX, FloatArray, IntArray
from spikeloom.compiler.interpret import BoolArray
from spikeloom.runtime.equivalence.netlist_faults import LayerCheck
from spikeloom.runtime.equivalence.suspects import BETA, BIAS, SATURATION, THRESHOLD, TRUNCATION, UNKNOWN, WEIGHTS

STORED, ROUNDED, UNROUNDED, UNCLIPPED = range(4)
"""Synaptic sums of a replay: of the weights as stored, as rounded from the checkpoint, as stored without what rounding
costs, as stored without what clipping costs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """A replay: the stored neurons with one thing changed.

    Parameters
    ----------
    cause : str
        What deviation is gone.
    part : str
        What fault is gone, as in :class:`suspects.Suspect`; ``clipped`` where it is the clipping of weights.
    inflow : int
        Which weights: STORED, ROUNDED, UNROUNDED or UNCLIPPED.
    bias, threshold : (neurons,) float64
        Membrane units.
    keep_u, keep_v : float
        Shares of current and membrane that a step keeps.
    limit : float
        Of the membrane register.
    rounds : bool
        Whether decayed registers are rounded toward zero.
    """

    cause: str
    part: str
    inflow: int
    bias: FloatArray
    threshold: FloatArray
    keep_u: float
    keep_v: float
    limit: float = float(MEMBRANE_MAX)
    rounds: bool = True


def variants_of(check: LayerCheck, rows: IntArray) -> list[Variant]:
    """What to run: the netlist as it is; with faults mended; with what rounding costs taken away.

    Parameters
    ----------
    check : LayerCheck
        A population.
    rows : (neurons,) int64
        Which of its neurons to run.
    """
    stored, rounded, ideal = check.stored, check.rounded, check.ideal
    asked = Variant(
        cause=UNKNOWN,
        part="machine",
        inflow=STORED,
        bias=stored.bias[rows],
        threshold=stored.threshold[rows],
        keep_u=stored.keep_u,
        keep_v=stored.keep_v,
    )
    mended = (
        replace(asked, part="weight", inflow=ROUNDED),
        replace(asked, part="bias", bias=rounded.bias[rows]),
        replace(asked, part="threshold", threshold=rounded.threshold[rows]),
        replace(asked, part="decay", keep_u=rounded.keep_u, keep_v=rounded.keep_v),
    )
    wrong = {suspect.part for suspect in check.suspects}
    exact = asked.bias + (ideal.bias - rounded.bias)[rows]
    # where a rounding compensates, biases make up for weights: both go together
    with_weights, alone = (exact, asked.bias) if check.compensated else (asked.bias, exact)
    threshold = asked.threshold + (ideal.threshold - rounded.threshold)[rows]
    return [
        asked,
        *(variant for variant in mended if variant.part in wrong),
        replace(asked, part="clipped", cause=WEIGHTS, inflow=UNCLIPPED),
        replace(asked, part="", cause=WEIGHTS, inflow=UNROUNDED, bias=with_weights),
        replace(asked, part="", cause=BIAS, bias=alone),
        replace(asked, part="", cause=THRESHOLD, threshold=threshold),
        replace(
            asked,
            part="",
            cause=BETA,
            keep_u=asked.keep_u + ideal.keep_u - rounded.keep_u,
            keep_v=asked.keep_v + ideal.keep_v - rounded.keep_v,
        ),
        replace(asked, part="", cause=SATURATION, limit=np.inf),
        replace(asked, part="", cause=TRUNCATION, rounds=False),  # last, see run_variants
    ]


def run_variants(
    variants: list[Variant], inflows: FloatArray, begins: IntArray, steps: IntArray, fired: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Run neurons from rest over what they remember.

    Parameters
    ----------
    variants : list of Variant
        The last one, and only it, does not round.
    inflows : (4, steps, neurons) float64
        Shifted synaptic sums, by ``Variant.inflow``.
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
    limit, which = column([v.limit for v in variants]), [v.inflow for v in variants]
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
