"""What a float network needs that crossbar cores do not have: every reason, with its layer and its neuron.

Nothing is lowered. Bounds are those that no layout can avoid: a layer that breaks none of them may still not fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.errors import Violation
from spikeloom.compiler.ir import Network, fan_in
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import IntArray


def needs(network: Network, chip: Target) -> tuple[Violation, ...]:
    """Every need that the chip does not meet, layer by layer."""
    return tuple(
        Violation(owner=owner, used=used, allowed=allowed, rule=f"{chip.name}.{rule}", remedy=remedy)
        for layer in range(len(network.populations))
        for owner, used, allowed, rule, remedy in _needs_of(network, layer, chip)
    )


def _needs_of(network: Network, layer: int, chip: Target) -> Iterator[tuple[str, str, str, str, str]]:
    """Owner, what is needed, what is allowed, the rule, and what to do."""
    population, axons = network.populations[layer], chip.limit("core.axons")
    name = population.name
    everyone = f"{name}, all {population.size:,} neurons"
    if 0 < population.beta < 1:
        kept = f"keep {population.beta:g} of their membranes a step"
        yield everyone, kept, "an added leak", "neuron.leak", "forget within a step, or leak by a constant"
    if population.alpha:
        kept = f"keep {population.alpha:g} of their currents a step"
        yield everyone, kept, "no current", "neuron.leak", "omit the current"
    inputs = fan_in(network, layer)
    most = int(inputs.max(initial=0))
    if most > axons:
        remedy = "split the sum, or give the layer fewer inputs"
        yield _worst(name, inputs, axons), f"{most:,} inputs", str(axons), "core.axons", remedy
    copies = min(max(axons // max(most, 1), 1), chip.limit("core.axon_types"))
    distinct, allowed = _distinct_weights(network, layer), 2**copies - 1
    if distinct.max(initial=0) > allowed:
        where, found = _worst(name, distinct, allowed), f"{distinct.max():,} different weights"
        beside = f"{allowed} with {copies} axon{'s' * (copies > 1)} an input"
        remedy = "fewer weights, or each input on several axons of different types"
        yield where, found, beside, "neuron.weight_bits", remedy
    # spikes go to every core that holds neurons which receive them, and there to two axons of different types: with one
    # each, all neurons of a core would have to divide their inputs into the same four groups of equal weights
    receivers = [network.populations[each.post].size for each in network.projections if each.pre == layer]
    reached = sum(2 * -(-size // chip.limit("core.neurons")) for size in receivers)
    if reached > (targets := chip.limit("neuron.targets")):
        remedy = "copy the neurons, or split their spikes by relays"
        yield everyone, f"send spikes to {reached} axons at least", str(targets), "neuron.targets", remedy


def _distinct_weights(network: Network, layer: int) -> IntArray:
    """Number of different weights, zero left out, of each neuron of a layer; (neurons,) int64."""
    found = np.zeros(network.populations[layer].size, np.int64)
    for projection in network.projections:
        if projection.post == layer:
            rows = np.split(projection.weight.data, projection.weight.indptr[1:-1])
            found = np.maximum(found, [len(np.unique(row[row != 0])) for row in rows])
    return found


def _worst(name: str, amounts: IntArray, allowed: int) -> str:
    """The neuron with most, and how many more there are with too much."""
    more = int(np.count_nonzero(amounts > allowed)) - 1
    return f"{name}, neuron {int(np.argmax(amounts))}" + (f" (and {more:,} more)" if more else "")
