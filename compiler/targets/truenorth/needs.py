"""What a float network needs that crossbar cores do not have: every reason, with its layer and its neuron.

Nothing is lowered. Bounds are those that no layout can avoid: a layer that breaks none of them may still not fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import Fault
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.ir import Network, fan_in
from spikeloom.compiler.targets.base import Target

MOST_COPIES = 4
"""Axons of an input beyond which types repeat: there are four."""

LEAK, CURRENT, FAN_IN, WEIGHTS, TARGETS = "leak", "current", "fan_in", "weights", "targets"
"""Kinds of needs."""

REMEDIES = {
    LEAK: "forget within a step, or leak by a constant",
    CURRENT: "leave the current away",
    FAN_IN: "split the sum, or give the layer fewer inputs",
    WEIGHTS: "fewer weights, or each input on several axons of different types",
    TARGETS: "copy the neurons, or split their spikes by relays",
}
"""What would mend each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Need:
    """A need that the chip does not meet.

    Parameters
    ----------
    layer : int
        Population.
    kind : str
        One of the above.
    fault : Fault
        In words.
    """

    layer: int
    kind: str
    fault: Fault


def needs(network: Network, chip: Target) -> tuple[Need, ...]:
    """Every need that the chip does not meet, layer by layer."""
    return tuple(need for layer in range(len(network.populations)) for need in _layer(network, layer, chip))


def targets_of(network: Network, layer: int, chip: Target) -> int:
    """Axons that each neuron of a layer must reach at the least.

    Its spikes go to every core that holds neurons which hear it, and there to two axons of different types: with one
    each, all neurons of a core would have to divide their inputs into the same four groups of equal weights.
    """
    held = chip.limit("core.neurons")
    heard = [network.populations[projection.post].size for projection in network.projections if projection.pre == layer]
    return sum(2 * -(-size // held) for size in heard)


def levels(network: Network, layer: int) -> IntArray:
    """Number of different weights, zero left out, of each neuron of a layer; (neurons,) int64."""
    found = np.zeros(network.populations[layer].size, np.int64)
    for projection in network.projections:
        if projection.post == layer:
            rows = np.split(projection.weight.data, projection.weight.indptr[1:-1])
            found = np.maximum(found, [len(np.unique(row[row != 0])) for row in rows])
    return found


def _layer(network: Network, layer: int, chip: Target) -> Iterator[Need]:
    population = network.populations[layer]
    axons, kinds = chip.limit("core.axons"), chip.limit("core.axon_types")
    everyone = f"{population.name}, all {population.size:,} neurons"

    def need(kind: str, where: str, found: str, allowed: str, rule: str) -> Need:
        fault = Fault(where=where, found=found, allowed=allowed, rule=f"{chip.name}.{rule}", remedy=REMEDIES[kind])
        return Need(layer=layer, kind=kind, fault=fault)

    if 0 < population.beta < 1:
        yield need(
            LEAK, everyone, f"keep {population.beta:g} of their membranes a step", "an added leak", "neuron.leak"
        )
    if population.alpha:
        yield need(
            CURRENT, everyone, f"keep {population.alpha:g} of their currents a step", "no current", "neuron.leak"
        )
    heard = fan_in(network, layer)
    if heard.max(initial=0) > axons:
        where = _worst(population.name, heard, axons)
        yield need(FAN_IN, where, f"{heard.max():,} inputs", str(axons), "core.axons")
    copies = min(max(axons // max(int(heard.max(initial=0)), 1), 1), MOST_COPIES, kinds)
    distinct, allowed = levels(network, layer), 2**copies - 1
    if distinct.max(initial=0) > allowed:
        beside = f"{allowed} with {copies} axon{'s' * (copies > 1)} an input"
        where = _worst(population.name, distinct, allowed)
        yield need(WEIGHTS, where, f"{distinct.max():,} different weights", beside, "neuron.weight_bits")
    reached = targets_of(network, layer, chip)
    if reached > chip.limit("neuron.targets"):
        allowed_axons = str(chip.limit("neuron.targets"))
        yield need(TARGETS, everyone, f"send spikes to {reached} axons at least", allowed_axons, "neuron.targets")


def _worst(name: str, amounts: IntArray, allowed: int) -> str:
    """The neuron with most, and how many more there are with too much."""
    more = int(np.count_nonzero(amounts > allowed)) - 1
    return f"{name}, neuron {int(np.argmax(amounts))}" + (f" (and {more:,} more)" if more else "")
