"""Bounds of sums and registers for any input, from the weights alone; the proof that they stay in range."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikeloom.compiler.ir import INPUT, row_parts
from spikeloom.compiler.passes.prune import settled
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerProjection
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    in_units,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeProof:
    """Worst cases of one population over all inputs, register units."""

    json_properties: ClassVar = ("holds",)

    layer: str  # Population
    # Largest magnitudes that any input can bring to any neuron; infinite where nothing bounds them
    accumulator: float
    current: float
    membrane: float

    @property
    def holds(self) -> bool:
        """Whether no register can leave its range, whatever the input."""
        return not self.stops and self.membrane <= MEMBRANE_MAX

    @property
    def stops(self) -> bool:
        """Whether some input may overflow a sum or a current, where the simulator stops; a membrane saturates."""
        return self.accumulator > ACCUMULATOR_MAX or self.current > CURRENT_MAX


def open_ranges(unproven: Sequence[str], saturating: Sequence[str]) -> Iterator[str]:
    """Lines about layers that some input brings out of their range; where they are `saturating`, only a membrane."""
    if stopping := [layer for layer in unproven if layer not in saturating]:
        yield f"no proof of range for {', '.join(stopping)}: the simulator stops at the first overflow"
    if saturating:
        yield f"no register of {', '.join(saturating)} overflows for any input, but some may saturate a membrane"


def one_sided(
    projections: Iterable[IntegerProjection], neurons: int, silent: Mapping[int, BoolArray] | None = None
) -> tuple[IntArray, IntArray]:
    """Largest positive and negative synaptic sum that any input can bring to each neuron, as magnitudes, weight units.

    Planes count one by one, which covers every order of their arrival. Sources that are known to be `silent`, by
    population, bring nothing.
    """
    positive = np.zeros(neurons, np.int64)
    negative = np.zeros(neurons, np.int64)
    for projection in projections:
        for rows in row_parts(projection.weight):
            ends = projection.weight.indptr[rows.start : rows.stop + 1]
            stored = slice(ends[0], ends[-1])
            units = in_units(projection.weight.data[stored], projection.exponent)
            if silent is not None:
                units[silent[projection.pre][projection.weight.indices[stored]]] = 0
            filled = np.flatnonzero(np.diff(ends))
            if len(filled):
                begins = ends[filled] - ends[0]
                up = np.add.reduceat(np.maximum(units, 0), begins, dtype=np.int64)
                positive[rows.start + filled] += up
                negative[rows.start + filled] += up - np.add.reduceat(units, begins, dtype=np.int64)
    return positive, negative


def prove_ranges(network: IntegerNetwork) -> tuple[RangeProof, ...]:
    """Bound every register of every population.

    The accumulator is bounded by the positive and the negative weights of a neuron taken separately, which covers
    every order of arrival. A membrane is bounded above by its threshold (it is reset when it passes it) plus one
    step, and below by what the leak lets negative input add up to; its own synapse counts once, since it is reset
    before. Without a leak that is all that arrives in a recording, where the network says how long one is.
    """
    proofs = []
    length = network.input.clocks.length or np.inf
    unit = 1 << MEMBRANE_SHIFT
    spikes: dict[int, FloatArray] = {INPUT: np.full(network.input.size, length)}  # in a recording, at most
    for post, population in enumerate(network.populations):
        into = [projection for projection in network.projections if projection.post == post]
        positive, negative = one_sided(into, population.size)
        kept_u = population.realised_alpha
        kept_v = population.realised_beta
        up = settled(positive * unit, kept_u)
        down = settled(negative * unit, kept_u)
        itself = np.zeros(population.size)
        others = np.zeros(population.size)
        for p in into:
            inhibition = -p.effective().minimum(0)
            inhibition.eliminate_zeros()  # a zero of what has no end is none
            if p.pre == post and inhibition.nnz == np.count_nonzero(diagonal := inhibition.diagonal()):
                itself += diagonal
            else:
                others += inhibition @ spikes.get(p.pre, np.full(inhibition.shape[1], length))
        rise = kept_v * population.threshold * unit + up + np.maximum(population.bias, 0)
        sinking = np.maximum(-population.bias, 0)
        if kept_v < 1:
            fall = settled(down + sinking, kept_v)
        else:
            sinking = np.multiply(sinking, length, out=np.zeros(population.size), where=sinking > 0)
            fall = settled((itself + others) * unit, kept_u) + sinking
        pause = np.floor((itself + population.threshold) * unit / np.maximum(up + np.maximum(population.bias, 0), 1))
        rests = kept_v == 1 and kept_u == 0
        spikes[post] = 1 + np.floor((length - 1) / (pause + 1)) if rests else np.full(population.size, length)
        proofs.append(
            RangeProof(
                layer=population.name,
                accumulator=float(np.maximum(positive, negative).max(initial=0) * unit),
                current=float(np.maximum(up, down).max(initial=0)),
                membrane=float(np.maximum(rise, fall).max(initial=0)),
            )
        )
    return tuple(proofs)
