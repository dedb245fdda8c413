"""Build a network of crossbar cores piece by piece: cores, axons, neurons, crossing points, wires.

A draft checks nothing that a chip limits: it may break any rule, and :mod:`truenorth.legalize` lists them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.truenorth.netlist import AXON_TYPES, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

Rows = list[tuple[int, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Neuron:
    """Parameters of a neuron; meanings as in :class:`netlist.CrossbarNetlist`."""

    weights: tuple[int, ...] = (1,)
    """Of the axon types; zero for those that are not named."""
    leak: int = 0
    leak_reversal: bool = False
    threshold: int = 1
    mask_bits: int = 0
    reset_mode: int = RESET_TO
    reset: int = 0
    negative_threshold: int = 0
    negative_saturates: bool = False
    initial: int = 0


RELAY = Neuron()
"""Spikes in every tick in which its axon of type 0 does, and remembers nothing."""


def history_free(weights: tuple[int, ...], threshold: int, *, bias: int = 0) -> Neuron:
    """A neuron that spikes when its sum and bias reach the threshold, and forgets everything within the tick.

    The threshold is a leak: what is at least zero after it spikes and is reset to zero, what is below zero is reset to
    zero by the negative threshold. (The encoding of RANC's ``teaconversion.py``.)
    """
    return Neuron(weights=weights, leak=bias - threshold, threshold=0)


def crossing_points(levels: IntArray, weights: Sequence[int]) -> IntArray:
    """Which axons of an input to join, as 0 and 1 along a new last axis, so that their weights add up to each level.

    One weight is negative, the others are 1, 2, 4 as far as they go.

    Examples
    --------
    >>> crossing_points(np.array([-3, -2, -1, 0, 1, 2, 3]), (-3, 1, 2)).tolist()
    [[1, 0, 0], [1, 1, 0], [1, 0, 1], [0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]]
    >>> crossing_points(np.array([-4, -1, 0, 3]), (1, 2, -4)).tolist()
    [[0, 0, 1], [1, 1, 1], [0, 0, 0], [1, 1, 0]]
    """
    negative = levels < 0
    rest = np.where(negative, levels - min(weights), levels)
    points = [negative if weight < 0 else (rest & weight) > 0 for weight in weights]
    return np.stack(points, axis=-1).astype(np.int64)


@dataclass(slots=True, kw_only=True)
class Core:
    """A core in the making at a place: axons as (line, type), neurons as (Neuron, layer, number).

    `synapses` has for each axon the neurons of the core at its crossing points.
    """

    x: int
    y: int
    axons: list[tuple[int, int]] = field(default_factory=list)
    neurons: list[tuple[Neuron, int, int]] = field(default_factory=list)
    synapses: list[list[int]] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class Draft:
    """A network in the making; neurons are named by (core, number on the core), axons by (core, line)."""

    layers: list[str] = field(default_factory=list)
    cores: list[Core] = field(default_factory=list)
    wires: Rows = field(default_factory=list)
    feeds: Rows = field(default_factory=list)
    clocks: Rows = field(default_factory=list)
    votes: Rows = field(default_factory=list)

    def core(self, x: int, y: int) -> int:
        """Add a core at a place."""
        self.cores.append(Core(x=x, y=y))
        return len(self.cores) - 1

    def axon(self, core: int, kind: int = 0, *, line: int | None = None) -> int:
        """Add an axon of a type, on the next line by default; return its line."""
        line = len(self.cores[core].axons) if line is None else line
        self.cores[core].axons.append((line, kind))
        self.cores[core].synapses.append([])
        return line

    def neuron(self, core: int, neuron: Neuron, *, layer: str = "relays", number: int = 0) -> int:
        """Add a neuron; return its number on the core."""
        if layer not in self.layers:
            self.layers.append(layer)
        self.cores[core].neurons.append((neuron, self.layers.index(layer), number))
        return len(self.cores[core].neurons) - 1

    def connect(self, core: int, line: int, neurons: Sequence[int]) -> None:
        """Set the crossing points of the axon on a line with neurons of the core."""
        lines = [held for held, _ in self.cores[core].axons]
        self.cores[core].synapses[lines.index(line)] += neurons

    def wire(self, source: tuple[int, int], core: int, line: int, delay: int = 1) -> None:
        """Lead the spikes of a neuron to the axon on a line of a core."""
        self.wire_to(source, (self.cores[core].x, self.cores[core].y), line, delay)

    def wire_to(self, source: tuple[int, int], place: tuple[int, int], line: int, delay: int = 1) -> None:
        """The same, the core by its place."""
        self.wires.append((*source, *place, line, delay))

    def feed(self, channel: int, core: int, line: int, *, tick: int = 0) -> None:
        """Lead the events of an input channel to an axon, so many ticks after the first of their data step."""
        self.feeds.append((channel, core, line, tick))

    def clock(self, core: int, line: int, *, period: int, phase: int = 0) -> None:
        """Let an axon have a spike every `period` ticks, from tick `phase` on."""
        self.clocks.append((core, line, period, phase))

    def vote(self, source: tuple[int, int], label: int, *, first: int = 0) -> None:
        """Let the spikes of a neuron count for a class, from tick `first` on."""
        self.votes.append((*source, label, first))

    def split(self, source: tuple[int, int], targets: Sequence[tuple[int, int]], via: int, *, delay: int = 1) -> None:
        """Lead the spikes of a neuron to several axons: an axon of the core `via`, and a relay for each.

        Every spike arrives ``1 + delay`` ticks later: one to the relays, the rest from there.
        """
        line = self.axon(via)
        relays = [self.neuron(via, RELAY) for _ in targets]
        self.connect(via, line, relays)
        self.wire(source, via, line)
        for relay, (core, target) in zip(relays, targets, strict=True):
            self.wire((via, relay), core, target, delay)

    def netlist(
        self,
        *,
        taxels: int,
        polarities: int,
        classes: int,
        bin_ticks: int = 1,
        clocks: Clocks = NO_CLOCKS,
        target: str = "truenorth",
        provenance: Mapping[str, Any] | None = None,
    ) -> CrossbarNetlist:
        """What was drafted, as arrays."""
        neurons = [entry for core in self.cores for entry in core.neurons]
        first = np.cumsum([0, *(len(core.neurons) for core in self.cores)])

        def column(values: Sequence[Any]) -> npt.NDArray[np.int64]:
            return read_only(np.array(values, np.int64).reshape(len(values)))

        def rows(table: Rows, width: int) -> list[npt.NDArray[np.int64]]:
            return [read_only(part) for part in np.array(table, np.int64).reshape(-1, width).T]

        wires, feeds, ticking, votes = rows(self.wires, 6), rows(self.feeds, 4), rows(self.clocks, 4), self.votes
        label, opens = np.full(len(neurons), -1), np.zeros(len(neurons), np.int64)
        for core, number, voted, tick in votes:
            label[first[core] + number], opens[first[core] + number] = voted, tick
        weights = [(*neuron.weights, *[0] * (AXON_TYPES - len(neuron.weights))) for neuron, _, _ in neurons]
        held = [sorted(set(points)) for core in self.cores for points in core.synapses]
        parameters = {
            name: column([getattr(neuron, name) for neuron, _, _ in neurons])
            for name in Neuron.__dataclass_fields__
            if name != "weights"
        }
        return CrossbarNetlist(
            target=target,
            taxels=taxels,
            polarities=polarities,
            classes=classes,
            bin_ticks=bin_ticks,
            layers=tuple(self.layers),
            core_x=column([core.x for core in self.cores]),
            core_y=column([core.y for core in self.cores]),
            core_neurons=read_only(first),
            core_axons=read_only(np.cumsum([0, *(len(core.axons) for core in self.cores)])),
            axon_line=column([line for core in self.cores for line, _ in core.axons]),
            axon_type=column([kind for core in self.cores for _, kind in core.axons]),
            axon_synapses=read_only(np.cumsum([0, *map(len, held)])),
            synapse_neuron=column([neuron for points in held for neuron in points]),
            weight=read_only(np.array(weights, np.int64).reshape(-1, AXON_TYPES)),
            layer=column([layer for _, layer, _ in neurons]),
            neuron=column([number for _, _, number in neurons]),
            readout_class=read_only(label),
            readout_first=read_only(opens),
            wire_neuron=read_only(first[wires[0]] + wires[1]),
            **dict(zip(("wire_x", "wire_y", "wire_line", "wire_delay"), wires[2:], strict=True)),
            **dict(zip(("feed_channel", "feed_core", "feed_line", "feed_tick"), feeds, strict=True)),
            **dict(zip(("clock_core", "clock_line", "clock_period", "clock_phase"), ticking, strict=True)),
            **parameters,
            provenance=dict(provenance or {}),
            clocks=clocks,
        )
