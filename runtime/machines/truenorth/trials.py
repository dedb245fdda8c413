"""What it does to the decisions when a layer of the float model is changed into something that crossbar cores can do.

One forward pass, in float32, with the layers before the first change taken from the pass of the network as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.interpret import BATCH, BoolArray, Floating, float_recurrence, lasting_currents, product, vote
from spikeloom.compiler.ir import INPUT, Network, Population
from spikeloom.compiler.targets.truenorth.codebook import LevelNetwork, Levels, run_levels
from spikeloom.runtime.machines.votes import readout_counts

LEAKS = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Constant leaks that are tried, in thresholds."""

FEW = 2
"""Batches of recordings on which a leak is chosen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Change:
    """What is done to a layer; what is None stays as it is.

    Parameters
    ----------
    beta, alpha : float, optional
        Decay of membrane and current.
    leak : float, optional
        Constant leak toward zero, in membrane units, in place of the decay.
    echoes : bool
        Inputs come again one and two steps later, with weights times the decay and its square, to a membrane that
        forgets.
    levels : Levels, optional
        Other weights for the first projection.
    inputs, most : int, optional
        With levels: the sum is made of parts of so many inputs, each of which counts `most` steps at the most, above
        zero and below.
    """

    beta: float | None = None
    alpha: float | None = None
    leak: float | None = None
    echoes: bool = False
    levels: Levels | None = None
    inputs: int | None = None
    most: int | None = None


class Trial:
    """A network on recordings, and its accuracy with layers changed.

    Parameters
    ----------
    network : Network
    events : (samples, steps, channels) bool
    labels : (samples,) int64
    """

    def __init__(self, network: Network, events: BoolArray, labels: IntArray) -> None:
        self.network = network
        self.labels = labels
        self.parts = [events[first : first + BATCH] for first in range(0, len(events), BATCH)]
        self.saturated = 0.0
        self._clipped = self._partial = 0
        self.spikes = [self._run(part, {}, None) for part in self.parts]

    def accuracy(self, changes: Mapping[int, Change]) -> float:
        """Share of recordings that are decided rightly with these layers changed.

        The share of partial sums that saturate, in the last layer that has such, is kept in ``saturated``.
        """
        readout, decided = self.network.readout, []
        clipped = parts = 0
        for events, spikes in zip(self.parts, self.spikes, strict=True):
            self._clipped = self._partial = 0
            found = self._run(events, changes, spikes)
            decided.append(vote(readout_counts(readout, self.network.classes, found[readout.population])))
            clipped, parts = clipped + self._clipped, parts + self._partial
        self.saturated = clipped / max(parts, 1)
        return float(np.mean(np.concatenate(decided) == self.labels))

    def accuracy_of(self, levels: LevelNetwork) -> float:
        """Share of recordings that a network in whole numbers, as it is on the chip, decides rightly."""
        decided = []
        for events in self.parts:
            for recording in events:
                votes = run_levels(levels, recording.T).spikes[-1].sum(axis=0)
                decided.append(np.bincount(levels.label, weights=votes, minlength=levels.classes).argmax())
        return float(np.mean(np.array(decided) == self.labels))

    def leak_for(self, layer: int) -> float:
        """Constant leak that moves the fewest spikes of a layer, its inputs as they are."""
        population = self.network.populations[layer]
        leaks = [share * population.theta for share in LEAKS]
        moved = np.zeros(len(leaks), np.int64)
        for events, spikes in zip(self.parts[:FEW], self.spikes, strict=False):
            sums = self._sums(layer, events, spikes, Change())
            moved += [np.count_nonzero(leaking(population, sums.copy(), leak) != spikes[layer]) for leak in leaks]
        return leaks[int(np.argmin(moved))]

    def _run(self, events: BoolArray, changes: Mapping[int, Change], before: list[BoolArray] | None) -> list[BoolArray]:
        """Spikes of all layers; those that no change reaches are taken from `before`."""
        spikes: list[BoolArray] = []
        other: set[int] = set()
        for layer, population in enumerate(self.network.populations):
            heard = {projection.pre for projection in self.network.projections if projection.post == layer}
            if before is not None and layer not in changes and not heard & other:
                spikes.append(before[layer])
                continue
            other.add(layer)
            change = changes.get(layer, Change())
            spikes.append(_neurons(population, self._sums(layer, events, spikes, change), change))
        return spikes

    def _sums(self, layer: int, events: BoolArray, spikes: list[BoolArray], change: Change) -> Floating:
        """Synaptic sums of a layer, (samples, steps, neurons) float32; a change of weights is of the first of them."""
        total: Floating | None = None
        for projection in self.network.projections:
            if projection.post == layer:
                heard = events if projection.pre == INPUT else spikes[projection.pre]
                if total is None and change.levels is not None:
                    total = self._in_levels(change.levels, heard, change.inputs, change.most)
                else:
                    more = product(projection.weight, heard, np.float32)
                    total = more if total is None else total + more
        assert total is not None, "verify: every population is reached"
        return total

    def _in_levels(self, levels: Levels, heard: BoolArray, inputs: int | None, most: int | None) -> Floating:
        """Sums of weights in levels; with `most`, of parts that saturate there."""
        samples, steps, channels = heard.shape
        flat = heard.reshape(samples * steps, channels).astype(np.float32)
        width = channels if inputs is None else inputs
        total = np.zeros((len(flat), len(levels.level)), np.float32)
        for first in range(0, channels, width):
            part = flat[:, first : first + width] @ levels.level[:, first : first + width].T
            if most is not None:
                self._clipped += int(np.count_nonzero(np.abs(part) > most))
                self._partial += part.size
                np.clip(part, -most, most, out=part)
            total += part
        return (total * levels.step).reshape(samples, steps, -1)


def leaking(population: Population, sums: Floating, leak: float) -> BoolArray:
    """Spikes of neurons that lose a constant of their membrane a step, toward zero; `sums` is overwritten."""
    spikes = np.empty(sums.shape, np.bool_)
    sums += population.bias.astype(sums.dtype)
    u = np.zeros_like(sums[:, 0])
    for step in range(sums.shape[1]):
        u = np.sign(u) * np.maximum(np.abs(u) - sums.dtype.type(leak), 0)
        u += sums[:, step]
        fired = np.greater(u, population.theta, out=spikes[:, step])
        u *= ~fired
    return spikes


def _neurons(population: Population, sums: Floating, change: Change) -> BoolArray:
    if change.leak is not None:
        alpha = population.alpha if change.alpha is None else change.alpha
        return leaking(population, lasting_currents(sums, alpha) if alpha else sums, change.leak)
    beta = population.beta if change.beta is None else change.beta
    if change.echoes:
        sums = sums + population.bias.astype(sums.dtype)
        heard = sums.copy()
        for lag in (1, 2):
            heard[:, lag:] += sums.dtype.type(population.beta**lag) * sums[:, :-lag]
        return float_recurrence(replace(population, beta=0.0, bias=np.zeros(population.size)), heard)[0]
    changed = replace(population, beta=beta, alpha=population.alpha if change.alpha is None else change.alpha)
    return float_recurrence(changed, sums)[0]
