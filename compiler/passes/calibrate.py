"""Run the float network on training recordings, so that scales can be chosen by what they do to spikes.

The network is not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.interpret import BATCH, Layer, float_simulation, raster, step_late, threads
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, FloatArray, IntArray

if TYPE_CHECKING:
    from spikeloom.compiler.layer_kernel import Raster

FEW = 32
"""Recordings on which storage is chosen, evenly spaced over the split: eight thousand steps a neuron."""

MANY = 256
"""Recordings on which the errors of several planes are made to cancel (one plane gains too little from more)."""

NUDGES = (0.08, 0.04, 0.02, 0.01, 0.005, 0.0025)
"""Shares of its threshold by which a neuron's bias is moved up or down, one after another, where that keeps spikes."""


Array = TypeVar("Array", bound=AnyArray)


@dataclass(frozen=True, slots=True, eq=False)
class Spikes:
    """Spikes of a population, kept at a bit each; an index into samples and steps gives them as booleans."""

    bits: EventArray  # (samples, steps, bytes), the first neuron lowest
    size: int  # Neurons

    def __getitem__(self, rows: Any) -> BoolArray:
        """Spikes of some recordings and steps, neurons last."""
        return np.unpackbits(self.bits[rows], axis=-1, count=self.size, bitorder="little").view(np.bool_)

    @property
    def total(self) -> int:
        """Spikes of all neurons."""
        return int(np.bitwise_count(self.bits).sum(dtype=np.int64))


def packed(spikes: BoolArray) -> Spikes:
    """Keep spikes (samples, steps, neurons) at a bit each."""
    return Spikes(np.packbits(spikes, axis=-1, bitorder="little"), spikes.shape[-1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Spikes of the float64 model on the calibration recordings.

    They are run in parts of ``BATCH`` recordings, each evenly spaced over all: the first is a sample of the
    whole.
    """

    events: BoolArray  # (samples, steps, channels) bool; input events
    spikes: tuple[Spikes, ...] = ()  # Spikes of each population
    sent: tuple[Spikes, ...] = ()  # What the first populations send instead, once they are rounded
    _rasters: dict[tuple[Any, ...], Raster] = field(init=False, default_factory=dict)

    def source(self, pre: int, post: int, rows: slice = slice(None)) -> BoolArray:
        """What a projection brings in each step: events, spikes of its source population, its own a step late.

        Of a population that was rounded already they are the chip's.
        """
        if pre == INPUT:
            return self.events[rows]
        if pre == post:
            return step_late(self.spikes[pre][rows])
        return (self.sent if pre < len(self.sent) else self.spikes)[pre][rows]

    def rate(self, pre: int, post: int) -> FloatArray:
        """Spikes a step that a projection brings from each neuron."""
        counts = (np.count_nonzero(self.source(pre, post, rows), axis=(0, 1)) for rows in self.parts())
        return np.asarray(sum(counts) / max(1, self.events.shape[0] * self.events.shape[1]))

    @property
    def rates(self) -> tuple[FloatArray, ...]:
        """Spikes of each neuron a step, of all populations."""
        return tuple(self.rate(pre, INPUT) for pre in range(len(self.spikes)))

    def parts(self) -> list[slice]:
        """Recordings that run together."""
        count = -(-len(self.events) // BATCH)
        return [slice(first, None, count) for first in range(count)]

    def raster(self, pres: Sequence[int], post: int, rows: slice) -> Raster:
        """What a population receives in some recordings; kept for the next candidate if recordings are few."""
        key = *pres, post, rows.start
        sources = self._rasters.get(key) or raster([self.source(pre, post, rows) for pre in pres])
        if len(self.events) <= FEW:
            self._rasters[key] = sources
        return sources

    def moved(self, layer: Layer, post: int, parts: int | None = None) -> IntArray:
        """What a layer without loops does unlike population `post`, given its sources, in the first `parts`.

        Of each neuron the entries in which its spikes differ, and how many more there are; (2, neurons).
        """

        def part(rows: slice) -> AnyArray:
            return layer.moved(self.raster(layer.pres, post, rows), self.spikes[post].bits[rows])

        counts = list(threads().map(part, self.parts()[:parts]))
        return np.asarray(np.sum(counts, axis=0, dtype=np.int64))

    def after(self, layer: Layer) -> Calibration:
        """A copy in which the populations to come receive what the next `layer` sends."""
        bits = np.empty((*self.events.shape[:2], -(-layer.size // 8)), np.uint8)

        def part(rows: slice) -> None:
            post = len(self.sent)
            bits[rows] = packed(layer.run([self.source(pre, post, rows) for pre in layer.pres])[0]).bits

        list(threads().map(part, self.parts()))
        return replace(self, sent=(*self.sent, Spikes(bits, layer.size)))


def evenly_spaced(events: Array, count: int = FEW) -> Array:
    """At most `count` recordings, evenly spaced over the first axis."""
    chosen = np.linspace(0, len(events) - 1, min(count, len(events))).round().astype(np.int64)
    return cast(Array, events[chosen])


def fewer(calibration: Calibration, count: int = FEW) -> Calibration:
    """A calibration on at most `count` of its recordings, evenly spaced."""
    if len(calibration.events) <= count:
        return calibration

    def some(spikes: tuple[Spikes, ...]) -> tuple[Spikes, ...]:
        return tuple(Spikes(evenly_spaced(each.bits, count), each.size) for each in spikes)

    events = evenly_spaced(calibration.events, count)
    return Calibration(events=events, spikes=some(calibration.spikes), sent=some(calibration.sent))


def calibrate(network: Network, events: BoolArray) -> Calibration:
    """Run the float64 model on all of these training recordings, (samples, steps, channels) bool.

    DataError if there is no recording, or its channels are not the network's.
    """
    if not len(events):
        raise DataError("calibration: the split is empty; give recordings with a train split")
    if events.shape[2] != network.input.size:
        raise DataError(
            f"calibration: the recordings have {events.shape[2]} channels, the network has {network.input.size}; "
            "give recordings of the sensor that it was trained on"
        )
    known = Calibration(events=events)
    for layer in float_simulation(network).layers:
        known = known.after(layer)
    return Calibration(events=events, spikes=known.sent)
