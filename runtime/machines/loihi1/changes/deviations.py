"""What Loihi 1 does otherwise than a float network, one deviation taken away at a time.

A netlist is entitled to round weights, biases, decays and membranes, and to the limits of its registers;
whether what it stores is the rounding of its checkpoint at all is for :mod:`loihi1.rounding` to say.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.registers import (
    DECAY_BITS,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    reach,
    step_units,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.deviations import (
    BETA,
    BIAS,
    SATURATION,
    TRUNCATION,
    UNKNOWN,
    WEIGHTS,
    Deviations,
    Memories,
    Replays,
    Sources,
)
from spikeloom.runtime.machines.loihi1.rounding import SLACK, summed

STORED, UNROUNDED, UNCLIPPED = range(3)
"""Weights of a replay: as stored, as the checkpoint has them, as stored but for those that the range cuts off."""

BOUND = ", as far as the accumulator lets it"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """A replay: the stored neurons without the deviation `cause`.

    Weights are STORED, UNROUNDED or UNCLIPPED; bias (neurons,) and the membrane's limit are in membrane
    units; `keep_u` and `keep_v` are what a step keeps of current and membrane, rounded toward zero if
    `rounds`.
    """

    cause: str
    weights: int
    bias: FloatArray
    keep_u: float
    keep_v: float
    limit: float = float(MEMBRANE_MAX)
    rounds: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class LoihiDeviations(Deviations):
    """Of an integer network from the float network that it was rounded from.

    Layers that were `compensated` store weights that need not be the nearest.
    """

    network: Network
    integer: IntegerNetwork
    compensated: Collection[str] = ()

    @property
    def sources(self) -> Sources:
        """By synapses whose weight is not zero on either side."""
        connections: list[dict[int, BoolArray]] = [{} for _ in self.network.populations]
        for stage in (self.network, self.integer):
            for projection in stage.projections:
                if projection.pre != INPUT:
                    connected = (projection.weight != 0).toarray().T
                    known = connections[projection.post].get(projection.pre)
                    either = connected if known is None else connected | known
                    connections[projection.post][projection.pre] = either
        return tuple(tuple(sorted(pres.items(), key=lambda item: item[0])) for pres in connections)

    def sources_into(self, post: int) -> tuple[int, ...]:
        """Presynaptic populations of either side."""
        stages = (self.network, self.integer)
        return tuple(sorted({p.pre for stage in stages for p in stage.projections if p.post == post}))

    def forgets(self, post: int) -> bool:
        """Where a current does not outlast its step."""
        return self.integer.populations[post].decay_u == (1 << DECAY_BITS) - 1

    def replays(self, post: int, memories: Memories) -> Replays:
        """Without the rounding of weights or their range, of biases, of decays and of membranes, and without limits."""
        chip = self.integer.populations[post]
        rows = memories.neurons
        unit = chip.scale[rows] * (1 << MEMBRANE_SHIFT)
        threshold = chip.threshold[rows].astype(np.float64) * (1 << MEMBRANE_SHIFT)
        weights = self._weights(post, rows)
        variants = self._variants(post, rows)
        inflows = np.stack([memories.arrived @ weight.T for weight in weights])
        margins, early = run_variants(variants, threshold, inflows, memories)
        return Replays(
            causes=[variant.cause for variant in variants],
            unclipped=[variant.weights == UNCLIPPED for variant in variants],
            margins=margins,
            early=early,
            threshold=threshold,
            unit=unit,
            reach=np.abs(weights[UNROUNDED] / unit[:, None]).sum(axis=1),
        )

    def _weights(self, post: int, rows: IntArray) -> FloatArray:
        """Weights in membrane units into neurons of a population, (3, neurons, sources), by ``Variant.weights``."""
        pres = self.sources_into(post)
        scale = self.integer.populations[post].scale[rows]
        real, stored = (
            np.concatenate([summed(stage, pre, post)[rows].toarray() for pre in pres], axis=1)
            for stage in (self.network, self.integer)
        )
        real *= scale[:, None]
        form = self.integer.forms[post]
        largest = reach(form.bits, form.exponents) * step_units(form.bits, form.exponents)
        clipped = np.abs(real) > largest * SLACK
        return np.stack([stored, real, np.where(clipped, real, stored)]) * (1 << MEMBRANE_SHIFT)

    def _variants(self, post: int, rows: IntArray) -> list[Variant]:
        """What to run for neurons of a population: the netlist as it is, then without each deviation."""
        wanted = self.network.populations[post]
        chip = self.integer.populations[post]
        one = 1 << DECAY_BITS
        exact = wanted.bias[rows] * chip.scale[rows] * (1 << MEMBRANE_SHIFT)
        netlist = Variant(
            cause=UNKNOWN,
            weights=STORED,
            bias=chip.bias[rows].astype(np.float64),
            keep_u=(one - chip.decay_u - 1) / one,
            keep_v=(one - chip.decay_v) / one,
        )
        # where a rounding compensates, biases make up for weights: both go together
        compensated = wanted.name in self.compensated
        return [
            netlist,
            replace(netlist, cause=WEIGHTS, weights=UNCLIPPED),
            replace(netlist, cause=WEIGHTS, weights=UNROUNDED, bias=exact if compensated else netlist.bias),
            replace(netlist, cause=BIAS, bias=netlist.bias if compensated else exact),
            replace(netlist, cause=BETA, keep_u=wanted.alpha, keep_v=wanted.beta),
            replace(netlist, cause=SATURATION, limit=np.inf),
            replace(netlist, cause=TRUNCATION, rounds=False),  # last, see run_variants
        ]

    def remedy(self, cause: str, post: int, *, clipped: bool, held: bool) -> str | None:
        """Finer storage, where that helps."""
        layer = self.integer.populations[post].name
        if cause == WEIGHTS:
            return self._finer_weights(post, clipped=clipped, held=held)
        finer = f"compile {layer} with --scale-groups 8, for finer units"
        remedies = {
            BIAS: f"a bias counts in 64ths of a weight unit: {finer}",
            BETA: "none on this chip, whose decay has 12 bits; a model trained with the realised decay would agree",
            TRUNCATION: f"what the chip drops is part of one unit: {finer}",
            SATURATION: f"the membrane leaves its 23 bits: compile {layer} with a coarser scale",
        }
        return remedies.get(cause)

    def _finer_weights(self, post: int, *, clipped: bool, held: bool) -> str:
        """More bits, then more planes, then more scales."""
        layer = self.integer.populations[post].name
        form = self.integer.forms[post]
        planes = len(form.exponents)
        why = "the range cuts off its largest weights" if clipped else "its weights are too coarse"
        if not held:
            why = "no input can make it fire with its rounded weights"
        wider = "--weight-bits 8 or " if form.bits < 8 else ""
        if planes < 3:
            return f"{why}: compile {layer} with {wider}--planes {planes + 1}{BOUND if planes > 1 else ''}"
        return f"{why}: compile {layer} with {wider}--scale-groups 8{BOUND}"


def run_variants(
    variants: list[Variant], threshold: FloatArray, inflows: FloatArray, memories: Memories
) -> tuple[FloatArray, BoolArray]:
    """Run neurons from rest over what they remember.

    Of the variants the last one, and only it, does not round. `inflows` (3, steps, neurons) are shifted
    synaptic sums by ``Variant.weights``. Gives (variants, neurons): membrane minus threshold in the last
    step, and whether the neuron fired before it, where it should not.
    """

    def column(values: list[float]) -> FloatArray:
        return np.array(values, np.float64)[:, None]

    bias = np.stack([v.bias for v in variants])
    keep_u = column([v.keep_u for v in variants])
    keep_v = column([v.keep_v for v in variants])
    limit = column([v.limit for v in variants])
    which = [v.weights for v in variants]
    begin = memories.begin
    length = memories.step - begin + 1
    place = np.arange(len(length))
    u = np.zeros(bias.shape)
    v = np.zeros(bias.shape)
    margins = np.zeros(bias.shape)
    early = np.zeros(bias.shape, np.bool_)
    running = len(length)
    for k in range(int(length[0])):
        u = keep_u * u[:, :running]
        v = keep_v * v[:, :running]
        for state in (u, v):
            np.trunc(state[:-1], out=state[:-1])
        u += inflows[:, begin[:running] + k, place[:running]][which]
        v += u
        v += bias[:, :running]
        np.clip(v, -limit, limit, out=v)
        left = int(np.count_nonzero(length > k + 1))
        margins[:, left:running] = v[:, left:] - threshold[left:running]
        both = memories.fired[begin[:left] + k, place[:left]]
        early[:, :left] |= (v[:, :left] > threshold[:left]) & ~both
        v[:, :left] *= ~both
        running = left
    return margins, early
