"""Leave out what provably does nothing: neurons that can never fire, neurons whose spikes reach no neuron.

The bounds hold for any input, so every spike that is left is as before. A neuron that cannot fire in the float model
is taken out before rounding: its weights then no longer take room in the accumulators of its targets, whose scales
become finer. Left out on request only: neurons that did not fire on the training recordings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.ir import INPUT, IntegerNetwork, IntegerProjection, Network, Sparse, row_parts, with_data
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.passes.range_proof import settled
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

Masks = tuple[BoolArray, ...]
"""Some neurons of each population."""

Known = dict[int, BoolArray]
"""Neurons that are known to do nothing, by population; the channels of the input under ``INPUT``."""

Net = TypeVar("Net", Network, IntegerNetwork)

FLOAT32_ROUNDING = 2.0**-23
"""Relative error of one float32 operation, doubled: the float model is silent in that precision and order too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal:
    """What was left out of one layer."""

    layer: str  # Population
    silent: int  # Neurons that no input can make fire, in the float model or on the chip
    unread: int  # Neurons that fire, but without a synapse that is not zero to any that is left, and without a vote
    never_fired: int = field(metadata={"key": "unused"})  # On the training recordings; on request only
    synapses: int  # Synapses from and to all of these that would not have been zero


def never_fires(network: Network) -> Masks:
    """Neurons of the float model that no input can make fire, in any order of summation, in float32 or wider.

    Neurons that vote are never among them.

    A neuron that has not fired holds at most ``sum(positive weights) + bias``, added up by the leak, where a current
    that outlasts its step has added up the weights already.
    """
    silent = _spread(network, _never_fires)
    return _without_voters(network, tuple(silent[post] for post in range(len(network.populations))))


def _spread(network: Net, judge: Callable[[Net, int, Known], BoolArray]) -> Known:
    """Neurons of all populations that `judge` finds silent, first population first: silence spreads."""
    silent: Known = {INPUT: np.zeros(network.input.size, np.bool_)}
    for post in range(len(network.populations)):
        _grow(network, post, silent, judge)
    return silent


def _grow(network: Net, post: int, known: Known, judge: Callable[[Net, int, Known], BoolArray]) -> None:
    """Let `judge` say which neurons of a population do nothing, given what is known to do nothing."""
    known[post] = np.zeros(network.populations[post].size, np.bool_)
    known[post] = judge(network, post, known)
    if any(p.pre == p.post == post for p in network.projections):
        while not np.array_equal(known[post], more := judge(network, post, known)):
            known[post] = more


def _sums(network: Net, post: int, silent: Known) -> tuple[FloatArray, FloatArray]:
    """Sums of the positive weights into each neuron from those that are not silent, and of all their magnitudes."""
    up, total = np.zeros((2, network.populations[post].size))
    for p in network.projections:
        if p.post == post:
            fires = (~silent[p.pre]).astype(np.float64)
            for rows in row_parts(p.weight):
                part = replace(p, weight=p.weight[rows])
                weight = part.effective() if isinstance(part, IntegerProjection) else part.weight
                up[rows] += weight.maximum(0) @ fires
                total[rows] += abs(weight) @ fires
    return up, total


def _never_fires(network: Network, post: int, silent: Known) -> BoolArray:
    """Neurons of one population that cannot fire as long as those that are known to be silent do not."""
    population = network.populations[post]
    up, total = _sums(network, post, silent)
    inputs = sum(p.weight.shape[1] for p in network.projections if p.post == post)
    lasts = population.alpha * (1 + 8 * FLOAT32_ROUNDING)
    gathered = np.inf if lasts >= 1 else 1 / (1 - lasts)
    slack = (inputs + 8) * FLOAT32_ROUNDING * (total + np.abs(population.bias)) * gathered
    with np.errstate(invalid="ignore"):
        most = np.maximum(np.where(up > 0, up * gathered, 0.0) + population.bias + slack, 0)
    kept = population.beta * (1 + 8 * FLOAT32_ROUNDING)
    return settled(most, kept) <= population.theta * (1 - 8 * FLOAT32_ROUNDING)


def never_fired(network: Network, calibration: Calibration) -> Masks:
    """Neurons that did not fire on the calibration recordings; never among them are those that vote."""
    return _without_voters(network, tuple(rate == 0 for rate in calibration.rates))


def none_of(network: Network | IntegerNetwork) -> Masks:
    """No neuron of any population."""
    return tuple(np.zeros(population.size, np.bool_) for population in network.populations)


def either(first: Masks, second: Masks) -> Masks:
    """Neurons of one mask or the other."""
    return tuple(np.asarray(a | b, np.bool_) for a, b in zip(first, second, strict=True))


def disconnect(network: Network, gone: Masks) -> Network:
    """Set the weights from and to some neurons, and their biases, to zero; the structure stays."""
    if not any(mask.any() for mask in gone):
        return network
    return replace(
        network,
        populations=tuple(
            replace(population, bias=np.where(mask, 0.0, population.bias))
            for population, mask in zip(network.populations, gone, strict=True)
        ),
        projections=tuple(
            replace(p, weight=zeroed(p.weight, gone[p.post], of_source(gone, p.pre, p.weight.shape[1])))
            for p in network.projections
        ),
        convolution=None,
    )


def removable(network: IntegerNetwork) -> tuple[Masks, Masks]:
    """Neurons that the chip need not hold: silent, as no input can make them fire, or unread, as none receives them.

    Neurons that vote are never among them, and every population keeps one neuron; no neuron is in both.
    """
    silent = _spread(network, _silent)
    unread: Known = {}
    for pre in reversed(range(len(network.populations))):
        if pre == network.readout.population:
            silent[pre] = np.zeros(network.populations[pre].size, np.bool_)
        _grow(network, pre, unread, lambda net, at, known: _unread(net, at, known, silent))
        if np.all(unread[pre]):
            kept = slice(None) if any(p.pre == p.post == pre for p in network.projections) else 0
            unread[pre][kept] = False  # all that a neuron's spikes may depend on
        elif np.all(silent[pre] | unread[pre]):
            silent[pre][np.argmax(silent[pre])] = False  # whatever else goes
    indices = range(len(network.populations))
    return tuple(silent[i] for i in indices), tuple(unread[i] for i in indices)


def _silent(network: IntegerNetwork, post: int, silent: Known) -> BoolArray:
    """The same on the chip: the membrane stays at or below its threshold, register rounding included."""
    population = network.populations[post]
    inflow = _sums(network, post, silent)[0] * (1 << MEMBRANE_SHIFT)
    step = np.maximum(settled(inflow, population.realised_alpha) + population.bias, 0)
    return settled(step, population.realised_beta) <= population.threshold << MEMBRANE_SHIFT


def _unread(network: IntegerNetwork, pre: int, unread: Known, silent: Known) -> BoolArray:
    """Neurons of one population, not silent, without a vote or a synapse to one that is neither."""
    received = np.full(network.populations[pre].size, pre == network.readout.population)
    for p in network.projections:
        if p.pre == pre:
            counts = np.repeat(~(silent[p.post] | unread[p.post]), np.diff(p.weight.indptr)) & (p.weight.data != 0)
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
                zeroed = _touched(p.weight, gone[post], of_source(gone, p.pre, p.weight.shape[1]))
                synapses += int((zeroed & (p.weight.data != 0)).sum())
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


def _without_voters(network: Network, masks: Masks) -> Masks:
    voting = network.readout.population
    return tuple(np.zeros_like(mask) if i == voting else mask for i, mask in enumerate(masks))


def of_source(masks: Sequence[BoolArray], pre: int, size: int) -> BoolArray:
    """Of `masks` that of a source; none of the `size` channels if it is the input."""
    return np.zeros(size, np.bool_) if pre == INPUT else masks[pre]


def _touched(weight: Sparse, rows: BoolArray, columns: BoolArray) -> BoolArray:
    """Whether each stored synapse is in one of these rows or columns."""
    return np.asarray(np.repeat(rows, np.diff(weight.indptr)) | columns[weight.indices])


def zeroed(weight: Sparse, rows: BoolArray, columns: BoolArray) -> Sparse:
    """Set some rows and columns to zero; the structure stays."""
    return with_data(weight, np.where(_touched(weight, rows, columns), 0, weight.data))
