"""Bounds of sums and registers for any input, from the weights alone; the proof that they stay in range.

Sums are in weight units, registers in membrane units; all are magnitudes.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from spikeloom.compiler.ir import INPUT, row_parts
from spikeloom.compiler.passes.prune import settled
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, IntegerPopulation, IntegerProjection
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    DECAY_ONE,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
    in_units,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray


def one_sided_sums(units: IntArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Sums of the positive and of the negative entries of each range; `ends` (ranges + 1,) bound these in `units`.

    >>> [side.tolist() for side in one_sided_sums(np.array([3, -4, 5]), np.array([0, 2, 2, 3]))]
    [[3, 0, 5], [4, 0, 0]]
    """
    positive = np.zeros(len(ends) - 1, np.int64)
    negative = np.zeros(len(ends) - 1, np.int64)
    filled = np.flatnonzero(np.diff(ends))
    if len(filled):
        begins = ends[filled] - ends[0]
        positive[filled] = np.add.reduceat(np.maximum(units, 0), begins, dtype=np.int64)
        negative[filled] = positive[filled] - np.add.reduceat(units, begins, dtype=np.int64)
    return positive, negative


def one_sided(
    projections: Iterable[IntegerProjection], neurons: int, silent: Mapping[int, BoolArray] | None = None
) -> tuple[IntArray, IntArray]:
    """Largest positive and negative synaptic sum that any input can bring to each neuron in a step.

    Planes count one by one, which covers every order of their arrival. Sources that are known to be
    `silent`, by population, bring nothing.
    """
    positive = np.zeros(neurons, np.int64)
    negative = np.zeros(neurons, np.int64)
    for projection in projections:
        weight = projection.weight
        for rows in row_parts(weight):
            ends = weight.indptr[rows.start : rows.stop + 1]
            stored = slice(ends[0], ends[-1])
            units = in_units(weight.data[stored], projection.exponent)
            if silent is not None:
                units[silent[projection.pre][weight.indices[stored]]] = 0
            up, down = one_sided_sums(units, ends)
            positive[rows] += up
            negative[rows] += down
    return positive, negative


def one_step_bounds(netlist: Netlist) -> tuple[IntArray, IntArray]:
    """Largest positive and negative synaptic sum that one step can bring to each compartment.

    No order of arrival and no input can bring a running sum outside ``-negative … positive``: it is reached
    when every positive (negative) synapse is hit at once.
    """
    positive = np.zeros(netlist.n_compartments, np.int64)
    negative = np.zeros(netlist.n_compartments, np.int64)
    for core in range(netlist.n_cores):
        _, compartment, weight = netlist.synapses_of(core)
        np.add.at(positive, compartment, np.maximum(weight, 0))
        np.add.at(negative, compartment, np.maximum(-weight, 0))
    return positive, negative


def largest_current(sums: IntArray | FloatArray, decay_u: IntArray | int) -> FloatArray:
    """Largest current that sums of one sign add up to.

    What loses ``lost / 4096`` a step and gains x cannot climb beyond ``x * 4096 / lost``.
    """
    return sums * (DECAY_ONE << MEMBRANE_SHIFT) / (decay_u + 1)


def extreme_membranes(
    threshold: IntArray, bias: IntArray, decay_v: IntArray | int, up: FloatArray, down: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Highest and, as a magnitude, lowest membrane that currents up to `up` and down to ``-down`` bring about.

    A membrane above its threshold is reset: what a step begins with is at most that. Below zero it sinks
    until it loses as much as it gains; infinite where it loses nothing.
    """
    kept = (DECAY_ONE - decay_v) / DECAY_ONE
    highest = kept * (threshold << MEMBRANE_SHIFT) + up + np.maximum(bias, 0)
    return highest, settled(down + np.maximum(-bias, 0), kept)


class Reach(NamedTuple):
    """What no input can exceed, whole numbers; all (compartments,) int64."""

    sums: IntArray  # of the weights of one sign that one step brings, in membrane units
    current: IntArray
    highest: IntArray  # the membrane, held against the threshold
    stored: IntArray  # the membrane after that, of either sign


def reach(netlist: Netlist) -> Reach:
    """Bounds of the registers of each compartment, whatever the input."""
    bounds = one_step_bounds(netlist)
    up, down = (np.floor(largest_current(sums, netlist.decay_u)) for sums in bounds)
    highest, lowest = extreme_membranes(netlist.threshold, netlist.bias, netlist.decay_v, up, down)
    sinking = np.floor(np.minimum(lowest, MEMBRANE_MAX + 1))  # beyond its register counts as just beyond
    return Reach(
        sums=np.maximum(*bounds) << MEMBRANE_SHIFT,
        current=np.maximum(up, down).astype(np.int64),
        highest=np.floor(highest).astype(np.int64),
        stored=np.maximum(netlist.threshold << MEMBRANE_SHIFT, sinking.astype(np.int64)),
    )


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


def prove_ranges(network: IntegerNetwork) -> tuple[RangeProof, ...]:
    """Bound every register of every population.

    The accumulator is bounded by the positive and the negative weights of a neuron taken separately, which
    covers every order of arrival. A membrane is bounded above by its threshold (it is reset when it passes
    it) plus one step, and below by what the leak lets negative input add up to; its own synapse counts once,
    since it is reset before. Without a leak that is all that arrives in a recording, where the network says
    how long one is.
    """
    proofs = []
    length = network.input.clocks.length or np.inf
    spikes: dict[int, FloatArray] = {INPUT: np.full(network.input.size, length)}  # in a recording, at most
    for post, population in enumerate(network.populations):
        into = [projection for projection in network.projections if projection.post == post]
        sums = one_sided(into, population.size)
        up, down = (largest_current(side, population.decay_u) for side in sums)
        rise, fall = extreme_membranes(population.threshold, population.bias, population.decay_v, up, down)
        itself, others = _inhibition(into, population.size, spikes, length)
        if population.decay_v == 0:
            sinking = np.maximum(-population.bias, 0)
            sunk = np.multiply(sinking, length, out=np.zeros(population.size), where=sinking > 0)
            fall = largest_current(itself + others, population.decay_u) + sunk
        spikes[post] = _most_spikes(population, up, itself, length)
        proofs.append(
            RangeProof(
                layer=population.name,
                accumulator=float(np.maximum(*sums).max(initial=0) << MEMBRANE_SHIFT),
                current=float(np.maximum(up, down).max(initial=0)),
                membrane=float(np.maximum(rise, fall).max(initial=0)),
            )
        )
    return tuple(proofs)


def _inhibition(
    into: Sequence[IntegerProjection], neurons: int, spikes: Mapping[int, FloatArray], length: float
) -> tuple[FloatArray, FloatArray]:
    """Negative weight that a neuron's own synapse brings, once, and what all others bring in a recording."""
    itself = np.zeros(neurons)
    others = np.zeros(neurons)
    for p in into:
        inhibition = -p.effective().minimum(0)
        inhibition.eliminate_zeros()  # a zero of what has no end is none
        if p.pre == p.post and inhibition.nnz == np.count_nonzero(diagonal := inhibition.diagonal()):
            itself += diagonal
        else:
            others += inhibition @ spikes.get(p.pre, np.full(inhibition.shape[1], length))
    return itself, others


def _most_spikes(
    population: IntegerPopulation, up: FloatArray, itself: FloatArray, length: float
) -> FloatArray:
    """Spikes of each neuron in a recording at most, where its registers keep all or nothing."""
    if population.decay_v != 0 or population.decay_u + 1 != DECAY_ONE:
        return np.full(population.size, length)
    step = np.maximum(up + np.maximum(population.bias, 0), 1)
    pause = np.floor((itself + population.threshold) * (1 << MEMBRANE_SHIFT) / step)
    return 1 + np.floor((length - 1) / (pause + 1))
