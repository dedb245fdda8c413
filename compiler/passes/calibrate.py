"""Run the float network on training recordings, so that scales can be chosen by what they do to spikes.

The network is not changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.interpret import BATCH, Layer, raster, run_float, step_late, threads
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import BoolArray, IntArray

FEW = 32
"""Recordings on which storage is chosen, evenly spaced over the split: eight thousand steps a neuron."""

MANY = 256
"""Recordings on which the errors of several planes are made to cancel (one plane gains too little from more)."""


NUDGES = (0.08, 0.04, 0.02, 0.01)
"""Shares of its threshold by which a neuron's bias is moved up or down, one after another, where that keeps spikes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Spikes of the float64 model on the calibration recordings."""

    events: BoolArray  # (samples, steps, channels) bool; input events
    spikes: tuple[BoolArray, ...]  # Spikes of each population
    rounded: Mapping[int, BoolArray] = field(default_factory=dict)  # Those of populations that were rounded before

    def source(self, pre: int, post: int, rows: slice = slice(None)) -> BoolArray:
        """What a projection brings in each step: events, spikes of its source population, its own a step late.

        Of a population that was rounded already they are the chip's.
        """
        if pre == INPUT:
            return self.events[rows]
        return step_late(self.spikes[pre][rows]) if pre == post else self.rounded.get(pre, self.spikes[pre])[rows]

    def moved(self, layer: Layer, post: int) -> IntArray:
        """What a layer without loops does unlike population `post`, given its sources.

        Of each neuron the entries in which its spikes differ, and how many more there are; (2, neurons).
        """

        def part(start: int) -> npt.NDArray[np.int32]:
            rows = slice(start, start + BATCH)
            return layer.moved(raster([self.source(pre, post, rows) for pre in layer.pres]), self.spikes[post][rows])

        total = np.zeros((2, layer.size), np.int64)
        for counts in threads().map(part, range(0, len(self.events), BATCH)):
            total += counts
        return total

    def after(self, layer: Layer, post: int) -> Calibration:
        """The same where the populations to come receive what population `post` sends as it was rounded."""
        parts = (slice(start, start + BATCH) for start in range(0, len(self.events), BATCH))
        ran = threads().map(lambda rows: layer.run([self.source(pre, post, rows) for pre in layer.pres])[0], parts)
        return replace(self, rounded={**self.rounded, post: np.concatenate(list(ran))})


def evenly_spaced(events: BoolArray, count: int = FEW) -> BoolArray:
    """At most `count` recordings, evenly spaced over the first axis."""
    return events[np.linspace(0, len(events) - 1, min(count, len(events))).round().astype(np.int64)]


def fewer(calibration: Calibration, count: int = FEW) -> Calibration:
    """A calibration on at most `count` of its recordings, evenly spaced."""
    return Calibration(
        events=evenly_spaced(calibration.events, count),
        spikes=tuple(evenly_spaced(spikes, count) for spikes in calibration.spikes),
        rounded={post: evenly_spaced(spikes, count) for post, spikes in calibration.rounded.items()},
    )


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
    return Calibration(events=events, spikes=run_float(network, events).spikes)
