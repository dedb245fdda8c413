"""Leave out neurons that provably do nothing on the chip: they cannot fire, or their spikes reach no neuron.

The bounds hold for any input, register rounding included, so every spike that is left is as before.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.passes.prune import (
    Known,
    Masks,
    either,
    grow,
    none_of,
    of_source,
    settled,
    spread,
    touched,
    zeroed,
)
from spikeloom.compiler.targets.loihi1.bounds import largest_current, one_sided
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.registers import MEMBRANE_SHIFT
from spikeloom.compiler.types import BoolArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal:
    """What was left out of one layer."""

    layer: str  # Population
    silent: int  # Neurons that no input can make fire, in the float model or on the chip
    unread: int  # Neurons that fire, but without a synapse that is not zero to any that is left, and without a vote
    never_fired: int = field(metadata={"key": "unused"})  # On the training recordings; on request only
    synapses: int  # Synapses from and to all of these that would not have been zero


def removable(network: IntegerNetwork) -> tuple[Masks, Masks]:
    """Neurons that the chip need not hold: silent, as no input can make them fire, or unread, as none receives them.

    Neurons that vote are never among them, and every population keeps one neuron; no neuron is in both.
    """
    silent = spread(network, lambda post, known: _silent(network, post, known))
    unread: Known = {}
    for pre in reversed(range(len(network.populations))):
        if pre == network.readout.population:
            silent[pre] = np.zeros(network.populations[pre].size, np.bool_)
        grow(network, pre, unread, lambda at, known: _unread(network, at, known, silent))
        if np.all(unread[pre]):
            kept = slice(None) if any(p.pre == p.post == pre for p in network.projections) else 0
            unread[pre][kept] = False  # all that a neuron's spikes may depend on
        elif np.all(silent[pre] | unread[pre]):
            silent[pre][np.argmax(silent[pre])] = False  # whatever else goes
    indices = range(len(network.populations))
    return tuple(silent[i] for i in indices), tuple(unread[i] for i in indices)


def _silent(network: IntegerNetwork, post: int, silent: Known) -> BoolArray:
    """Neurons whose membrane stays at or below its threshold as long as those known to be silent do not fire."""
    population = network.populations[post]
    into = [p for p in network.projections if p.post == post]
    positive, _ = one_sided(into, population.size, silent)
    step = np.maximum(largest_current(positive, population.decay_u) + population.bias, 0)
    return settled(step, population.realised_beta) <= population.threshold << MEMBRANE_SHIFT


def _unread(network: IntegerNetwork, pre: int, unread: Known, silent: Known) -> BoolArray:
    """Neurons of one population, not silent, without a vote or a synapse to one that is neither."""
    received = np.full(network.populations[pre].size, pre == network.readout.population)
    for p in network.projections:
        if p.pre == pre:
            counts = np.repeat(~(silent[p.post] | unread[p.post]), np.diff(p.weight.indptr)) & (
                p.weight.data != 0
            )
            received[p.weight.indices[counts]] = True
    return ~received & ~silent[pre]


def without_channels(network: IntegerNetwork, channels: BoolArray) -> IntegerNetwork:
    """Set the weights from some input channels, (channels,) bool, to zero; the structure stays."""
    none = none_of(network)
    projections = (
        replace(p, weight=zeroed(p.weight, none[p.post], channels)) if p.pre == INPUT else p
        for p in network.projections
    )
    return replace(network, projections=tuple(projections))


def compact(network: IntegerNetwork, gone: Masks) -> tuple[IntegerNetwork, tuple[IntArray, ...]]:
    """Take neurons out: the rest, renumbered, and which neuron of the original each one is, by population."""
    kept = tuple(np.flatnonzero(~mask) for mask in gone)
    if not any(mask.any() for mask in gone):
        return network, kept
    projections = []
    for p in network.projections:
        weight = p.weight[kept[p.post]]
        if p.pre != INPUT:
            weight = weight[:, kept[p.pre]]
        projections.append(replace(p, weight=weight.tocsr()))
    readout = network.readout
    return (
        replace(
            network,
            populations=tuple(
                replace(
                    population,
                    scale=population.scale[ids],
                    threshold=population.threshold[ids],
                    bias_mantissa=population.bias_mantissa[ids],
                    bias_exponent=population.bias_exponent[ids],
                )
                for population, ids in zip(network.populations, kept, strict=True)
            ),
            projections=tuple(projections),
            readout=replace(readout, label=readout.label[kept[readout.population]]),
        ),
        kept,
    )


def removals(network: Network, silent: Masks, unread: Masks, quiet: Masks) -> tuple[Removal, ...]:
    """Count what was left out of `network`, layer by layer; `quiet` are those that go by evidence, not by proof."""
    gone = either(silent, unread)
    removed = []
    for post, population in enumerate(network.populations):
        by_evidence = quiet[post] & gone[post]
        synapses = 0
        for p in network.projections:
            if p.post == post:
                going = touched(p.weight, gone[post], of_source(gone, p.pre, p.weight.shape[1]))
                synapses += int((going & (p.weight.data != 0)).sum())
        removed.append(
            Removal(
                layer=population.name,
                silent=int((silent[post] & ~by_evidence).sum()),
                unread=int((unread[post] & ~by_evidence).sum()),
                never_fired=int(by_evidence.sum()),
                synapses=synapses,
            )
        )
    return tuple(removed)
