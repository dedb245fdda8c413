"""Which integers differ between two compilations of what should be one network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import INPUT, IntegerNetwork, Sparse


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightDifference:
    """A synapse whose weight was rounded to another integer.

    Parameters
    ----------
    layer, source : str
        Names of the populations at its end and at its start; ``input`` is the input.
    post, pre : int
        Neuron, and neuron or channel.
    first, second : int
        Weights in weight units, all planes together.
    """

    layer: str
    source: str
    post: int
    pre: int
    first: int
    second: int

    def __str__(self) -> str:
        return f"{self.layer} {self.post} from {self.source} {self.pre}: {self.first} and {self.second}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """What differs.

    Parameters
    ----------
    synapses : int
        Synapses that either has.
    weights : tuple of WeightDifference
        Those that differ.
    registers : tuple of str
        Layers with other thresholds, biases or decays, and which.
    """

    synapses: int
    weights: tuple[WeightDifference, ...]
    registers: tuple[str, ...]

    @property
    def equal(self) -> bool:
        """Whether nothing differs."""
        return not (self.weights or self.registers)


def compare(first: IntegerNetwork, second: IntegerNetwork) -> Comparison:
    """List every integer in which two networks of the same layers differ.

    Names are the first network's; layers are matched by their place.

    Raises
    ------
    ModelError
        If they have other layers.
    """
    sizes = [[network.input.size, *(p.size for p in network.populations)] for network in (first, second)]
    if sizes[0] != sizes[1]:
        shown = [", ".join(map(str, side)) for side in sizes]
        raise ModelError(
            f"compare: one network has layers of {shown[0]}, the other of {shown[1]}; give two of one kind"
        )
    names = {INPUT: "input"} | {index: population.name for index, population in enumerate(first.populations)}
    whole = [_weights(network) for network in (first, second)]
    synapses, weights = 0, []
    for pre, post in sorted(set(whole[0]) | set(whole[1])):
        one, other = (side.get((pre, post)) for side in whole)
        empty = abs(one if one is not None else other) * 0  # type: ignore[arg-type]
        one, other = (empty if side is None else side for side in (one, other))
        synapses += int((_pattern(one) + _pattern(other)).nnz)
        difference = (one - other).tocoo()
        for row, column in sorted(zip(*difference.coords, strict=True)):
            values = int(one[row, column]), int(other[row, column])
            if values[0] != values[1]:
                weights.append(
                    WeightDifference(
                        layer=names[post],
                        source=names[pre],
                        post=int(row),
                        pre=int(column),
                        first=values[0],
                        second=values[1],
                    )
                )
    registers = []
    for a, b in zip(first.populations, second.populations, strict=True):
        found: dict[str, tuple[Any, Any]] = {
            "thresholds": (a.threshold, b.threshold),
            "biases": (a.bias, b.bias),
            "decays": ((a.decay_u, a.decay_v), (b.decay_u, b.decay_v)),
        }
        other_ones = [what for what, (x, y) in found.items() if not np.array_equal(x, y)]
        registers += [f"{a.name}: {', '.join(other_ones)}"] if other_ones else []
    return Comparison(synapses=synapses, weights=tuple(weights), registers=tuple(registers))


def _weights(network: IntegerNetwork) -> dict[tuple[int, int], Sparse]:
    """Weights between each two populations, in weight units, planes added up."""
    found: dict[tuple[int, int], Sparse] = {}
    for projection in network.projections:
        ends = projection.pre, projection.post
        found[ends] = found[ends] + projection.effective() if ends in found else projection.effective()
    return found


def _pattern(weight: Sparse) -> Sparse:
    ones = weight.copy()
    ones.data = np.ones_like(ones.data)
    return ones
