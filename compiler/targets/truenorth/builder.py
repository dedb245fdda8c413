"""Build a network of crossbar cores piece by piece: cores, axons, neurons, crossing points, wires.

A draft checks nothing that a chip limits: it may break any rule, and :mod:`truenorth.legalize` lists them
all.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.netlist import AXON_TYPES, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

Rows = list[tuple[int, ...]]
Place = tuple[int, int]
"""Core, and neuron or line on it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Neuron:
    """Parameters of a neuron; meanings as in :class:`netlist.CrossbarNetlist`."""

    weights: tuple[int, ...] = (1,)  # Of the axon types; zero for those that are not named
    leak: int = 0
    leak_reversal: bool = False
    threshold: int = 1
    reset_mode: int = RESET_TO
    reset: int = 0
    negative_threshold: int = 0
    negative_saturates: bool = False
    initial: int = 0


RELAY = Neuron()
"""Spikes in every tick in which its axon of type 0 does, and remembers nothing."""


def history_free(weights: tuple[int, ...], threshold: int) -> Neuron:
    """A neuron that spikes when its sum reaches the threshold, and forgets everything within the tick.

    The threshold is a leak: what is at least zero after it spikes and is reset to zero, what is below zero
    is reset to zero by the negative threshold. (The encoding of RANC's ``teaconversion.py``.)
    """
    return Neuron(weights=weights, leak=-threshold, threshold=0)


def crossing_points(levels: IntArray, weights: Sequence[int]) -> IntArray:
    """Which axons of an input to join, as 0 and 1 along a new last axis, so that their weights add up to each level.

    One weight is negative, the others are 1, 2, 4 as far as they go.
    """
    negative = levels < 0
    rest = np.where(negative, levels - min(weights), levels)
    points = [negative if weight < 0 else (rest & weight) > 0 for weight in weights]
    return np.stack(points, axis=-1).astype(np.int64)


@dataclass(slots=True)
class Core:
    """A core in the making at a place: axons as (line, type, neurons they join), neurons as (Neuron, layer, number)."""

    x: int
    y: int
    axons: list[tuple[int, int, list[int]]] = field(default_factory=list)
    neurons: list[tuple[Neuron, int, int]] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class Draft:
    """A network in the making; neurons are named by (core, number on the core), axons by (core, line)."""

    layers: list[str] = field(default_factory=list)
    cores: list[Core] = field(default_factory=list)
    wires: Rows = field(default_factory=list)
    feeds: Rows = field(default_factory=list)
    clocks: Rows = field(default_factory=list)
    votes: Rows = field(default_factory=list)

    def core(self, x: int = 0, y: int = 0) -> int:
        """Add a core at a place."""
        self.cores.append(Core(x, y))
        return len(self.cores) - 1

    def neuron(self, core: int, neuron: Neuron, *, layer: str = "relays", number: int = 0) -> int:
        """Add a neuron; return its number on the core."""
        if layer not in self.layers:
            self.layers.append(layer)
        self.cores[core].neurons.append((neuron, self.layers.index(layer), number))
        return len(self.cores[core].neurons) - 1

    def axon(self, core: int, kind: int = 0, neurons: Sequence[int] = (), *, line: int | None = None) -> int:
        """Add an axon of a type that joins neurons of its core, on the next line by default; return its line."""
        line = len(self.cores[core].axons) if line is None else line
        self.cores[core].axons.append((line, kind, sorted(set(neurons))))
        return line

    def inputs(self, core: int, points: IntArray, *, kept: int = 0) -> Iterator[tuple[int, int]]:
        """Add axons for inputs by their crossing points (inputs, neurons, copies); yields each with its input.

        A copy that joins nothing is left out, except those of the first `kept` inputs.
        """
        for row, copies in enumerate(points.transpose(0, 2, 1)):
            for kind, joined in enumerate(map(np.flatnonzero, copies)):
                if row < kept or joined.size:
                    yield row, self.axon(core, kind, joined.tolist())

    def wire(self, source: Place, core: int, line: int, delay: int = 1) -> None:
        """Lead the spikes of a neuron to the axon on a line of a core."""
        self.wires.append((*source, core, line, delay))

    def feed(self, channel: int, core: int, line: int, *, tick: int = 0) -> None:
        """Lead the events of an input channel to an axon, so many ticks after the first of their data step."""
        self.feeds.append((channel, core, line, tick))

    def clock(self, core: int, line: int, *, period: int, phase: int = 0) -> None:
        """Let an axon have a spike every `period` ticks, from tick `phase` on."""
        self.clocks.append((core, line, period, phase))

    def vote(self, source: Place, label: int, *, first: int = 0) -> None:
        """Let the spikes of a neuron count for a class, from tick `first` on."""
        self.votes.append((*source, label, first))

    def placed(self, network: Any, chip: Target, remedy: str, **facts: Any) -> CrossbarNetlist:
        """What was drafted for a network, its cores line by line in a square; CapacityError if there are too many."""
        count = len(self.cores)
        if count > chip.limit("chip.cores"):
            raise CapacityError((chip.exceeded("chip", "chip.cores", count, remedy),))
        side = max(int(np.ceil(np.sqrt(count))), -(-count // chip.limit("mesh.height")))
        for number, core in enumerate(self.cores):
            core.y, core.x = divmod(number, side)
        sensor = {name: getattr(network, name) for name in ("taxels", "polarities", "classes")}
        return self.netlist(**sensor, target=chip.name, **facts)

    def netlist(
        self,
        *,
        bin_ticks: int = 1,
        target: str = "truenorth",
        provenance: Mapping[str, Any] | None = None,
        **facts: Any,
    ) -> CrossbarNetlist:
        """What was drafted, as arrays; `facts` are sizes of the sensor, classes, and whatever else a netlist says."""
        neurons = [entry for core in self.cores for entry in core.neurons]
        axons = [entry for core in self.cores for entry in core.axons]
        first = np.cumsum([0, *(len(core.neurons) for core in self.cores)])

        def columns(table: Sequence[Any], *names: str) -> dict[str, Any]:
            values = np.array(table, np.int64).reshape(-1, len(names))
            return {
                name: read_only(np.ascontiguousarray(column))
                for name, column in zip(names, values.T, strict=True)
            }

        wires = [
            (first[core] + number, self.cores[end].x, self.cores[end].y, line, delay)
            for core, number, end, line, delay in self.wires
        ]
        label = np.full(len(neurons), -1)
        opens = np.zeros(len(neurons), np.int64)
        for core, number, voted, tick in self.votes:
            label[first[core] + number], opens[first[core] + number] = voted, tick
        weights = [(*neuron.weights, *[0] * (AXON_TYPES - len(neuron.weights))) for neuron, _, _ in neurons]
        parameters = [name for name in Neuron.__dataclass_fields__ if name != "weights"]
        return CrossbarNetlist(
            target=target,
            bin_ticks=bin_ticks,
            layers=tuple(self.layers),
            core_neurons=read_only(first),
            core_axons=read_only(np.cumsum([0, *(len(core.axons) for core in self.cores)])),
            axon_synapses=read_only(np.cumsum([0, *(len(joined) for _, _, joined in axons)])),
            synapse_neuron=read_only(
                np.array([neuron for _, _, joined in axons for neuron in joined], np.int64)
            ),
            weight=read_only(np.array(weights, np.int64).reshape(-1, AXON_TYPES)),
            readout_class=read_only(label),
            readout_first=read_only(opens),
            **columns([(core.x, core.y) for core in self.cores], "core_x", "core_y"),
            **columns([(line, kind) for line, kind, _ in axons], "axon_line", "axon_type"),
            **columns([(layer, number) for _, layer, number in neurons], "layer", "neuron"),
            **columns(
                [[getattr(neuron, name) for name in parameters] for neuron, _, _ in neurons], *parameters
            ),
            **columns(wires, "wire_neuron", "wire_x", "wire_y", "wire_line", "wire_delay"),
            **columns(self.feeds, "feed_channel", "feed_core", "feed_line", "feed_tick"),
            **columns(self.clocks, "clock_core", "clock_line", "clock_period", "clock_phase"),
            provenance=dict(provenance or {}),
            **facts,
        )
