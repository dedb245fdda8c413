"""A history-free network in levels: weights as whole multiples of a step of each neuron, sums that may saturate.

A membrane that forgets within a step (decay 0) is the one that a TactileSGNet and a crossbar core have in common. With
its weights in the levels that ``m`` axons of an input give, a neuron spikes where ``sum_i k_i x_i`` of whole numbers
reaches a threshold, a whole number, too. Sums over more inputs than fit a core are made of partial sums, which count
``MOST`` at the most, above zero and below: that is what :mod:`truenorth.in_time` can lead from core to core.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.ir import INPUT, Network, Population
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray

BIN_TICKS = 20
"""Ticks of a data step whose sums travel in time: a millisecond each of the sensor's 20."""

MOST = BIN_TICKS - 1
"""Spikes that a partial sum sends at the most."""

WEIGHTS = {2: (1, -1), 3: (1, 2, -4), 4: (1, 2, 4, -8)}
"""Weights of the axon types of an input, in levels, by how many axons it has."""

COPIES = tuple(WEIGHTS)
"""Axons of an input that can be asked for."""

MOST_COPIES = 3
"""Axons of an input of a layer that receives a clock: with four every type is an input's."""

EMPTYING = 4
"""Axons by which a clock empties neurons of partial sums: more than these can hold."""

SEARCHED = np.linspace(0.1, 1.0, 19)
"""Shares of the largest weight that are tried as the largest level of a codebook."""


def codebook(weight: FloatArray, copies: int) -> tuple[IntArray, FloatArray]:
    """Weights (neurons, inputs) as whole multiples, the levels, of a step (neurons,) of each neuron, in float32.

    The weights of the types are 1 and -1; 1, 2 and -4; 1, 2, 4 and -8 steps, which gives for 2, 3, 4 copies the levels
    -1…1, -4…3, -8…7. Of the steps that are tried a neuron has the one of least squared error.

    >>> level, step = codebook(np.array([[0.5, -0.4, 0.02]]), 2)
    >>> level.tolist(), [f"{each:.2f}" for each in step]
    ([[1, -1, 0]], ['0.45'])
    """
    low, high = min(WEIGHTS[copies]), sum(WEIGHTS[copies][:-1])
    largest = np.maximum(np.abs(weight).max(axis=1, keepdims=True), 1e-12)
    best = np.full(len(weight), np.inf)
    step, level = np.ones(len(weight)), np.zeros(weight.shape, np.int64)
    for share in (*SEARCHED, *(-low / k for k in range(1, -low))):  # the latter: the largest weight is level k
        tried = share * largest / -low
        rounded = np.clip(np.rint(weight / tried), low, high)
        error = ((rounded * tried - weight) ** 2).sum(axis=1)
        better = error < best
        best[better], step[better], level[better] = error[better], tried[better, 0], rounded[better]
    return level, step.astype(np.float32).astype(np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """Neurons that spike where the sum of their levels (neurons, inputs) reaches their threshold (neurons,).

    An input has `copies` axons; `width` inputs are added up together, fewer than all where the sum travels in time.
    """

    name: str
    level: IntArray
    threshold: IntArray
    copies: int
    width: int

    @property
    def groups(self) -> list[slice]:
        """Inputs that are added up together."""
        inputs = self.level.shape[1]
        return [slice(first, min(first + self.width, inputs)) for first in range(0, inputs, self.width)]

    @property
    def is_split(self) -> bool:
        """Whether its sums travel in time."""
        return bool(self.width < self.level.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelNetwork:
    """A chain of history-free layers in whole numbers; `label` (voters,) is what each of the last votes for."""

    taxels: int
    polarities: int
    classes: int
    layers: tuple[Layer, ...]
    label: IntArray


def in_levels(network: Network, copies: int, chip: Target) -> LevelNetwork:
    """Round a history-free chain of layers to levels; ModelError if it is none, has clocks, or a step joins bins.

    An input has `copies` axons, 2 to 4; layers that receive a clock take three at the most.
    """
    if network.input.clocks.channels:
        raise ModelError("has clocks; sums in time are for networks without")
    if network.input.bins > 1:
        raise ModelError(f"a step joins {network.input.bins} bins; sums in time are for networks of single bins")
    layers = []
    for index, population in enumerate(network.populations):
        if population.beta or population.alpha:
            what, kept = ("membranes", population.beta) if population.beta else ("currents", population.alpha)
            raise ModelError(f"{population.name}: keeps {kept:g} of its {what} a step, sums in time forget all")
        incoming = [projection for projection in network.projections if projection.post == index]
        if [projection.pre for projection in incoming] != [index - 1 if index else INPUT]:
            raise ModelError(f"{population.name}: does not receive from the layer before and nothing else")
        layers.append(_layer(population, incoming[0].weight.toarray(), copies, chip))
    return LevelNetwork(
        taxels=network.input.taxels,
        polarities=network.input.polarities,
        classes=network.classes,
        layers=tuple(layers),
        label=network.readout.label,
    )


def _layer(population: Population, weight: FloatArray, copies: int, chip: Target) -> Layer:
    """Levels of a layer: in as many copies as were asked for, if its inputs fit a core so and it receives no clock."""
    fan_in = int(np.count_nonzero(weight, axis=1).max(initial=0))
    for tried in dict.fromkeys((copies, min(copies, MOST_COPIES))):
        level, step = codebook(weight, tried)
        threshold = np.floor((population.theta - population.bias) / step).astype(np.int64) + 1
        whole = fan_in * tried < chip.limit("core.axons")
        if tried <= MOST_COPIES or (whole and threshold.min(initial=1) > 0):
            break
    return Layer(
        name=population.name,
        level=read_only(level),
        threshold=read_only(threshold),
        copies=tried,
        # with the axons of a clock beside: groups of 126 inputs with two axons each, 84 with three
        width=weight.shape[1] if whole else (chip.limit("core.axons") - EMPTYING) // tried,
    )


@dataclass(frozen=True, slots=True)
class PartialSums:
    """Partial sums of a layer that travel in time, those that saturate, and the largest."""

    layer: str
    partial: int
    saturated: int
    largest: int

    def __add__(self, other: PartialSums) -> PartialSums:
        """Of two recordings."""
        largest = max(self.largest, other.largest)
        return PartialSums(self.layer, self.partial + other.partial, self.saturated + other.saturated, largest)


def run_levels(
    network: LevelNetwork, events: EventArray, *, most: int = MOST
) -> tuple[dict[str, BoolArray], tuple[PartialSums, ...]]:
    """Spikes (steps, neurons) of each layer for one recording (channels, steps), and the partial sums of split layers.

    Partial sums count `most` at the most.
    """
    active = (events > 0).T.astype(np.float64)  # whole numbers, so that the products are exact and fast
    spikes, counts = {}, []
    for layer in network.layers:
        sums = np.stack([active[:, group] @ layer.level[:, group].T.astype(np.float64) for group in layer.groups])
        if layer.is_split:
            size = np.abs(sums)
            beyond = int(np.count_nonzero(size > most))
            counts.append(PartialSums(layer.name, size.size, beyond, int(size.max(initial=0))))
            sums = np.clip(sums, -most, most)
        spikes[layer.name] = sums.sum(axis=0) >= layer.threshold
        active = spikes[layer.name].astype(np.float64)
    return spikes, tuple(counts)
