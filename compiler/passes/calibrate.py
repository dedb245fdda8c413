"""Run the float network on training recordings, so that scales can be chosen by what they do to spikes.

The network is not changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.interpret import run_float, step_late
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import BoolArray

FEW = 32
"""Recordings on which storage is chosen, evenly spaced over the split: eight thousand steps a neuron."""

MANY = 256
"""Recordings on which the errors of several planes are made to cancel (one plane gains too little from more)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Spikes of the float64 model on the calibration recordings."""

    events: BoolArray  # (samples, steps, channels) bool; input events
    spikes: tuple[BoolArray, ...]  # Spikes of each population

    def source(self, pre: int, post: int) -> BoolArray:
        """What a projection brings in each step: spikes of its source population, its own a step late, or events."""
        if pre == INPUT:
            return self.events
        return step_late(self.spikes[pre]) if pre == post else self.spikes[pre]


def evenly_spaced(events: BoolArray, count: int = FEW) -> BoolArray:
    """At most `count` recordings, evenly spaced over the first axis."""
    return events[np.linspace(0, len(events) - 1, min(count, len(events))).round().astype(np.int64)]


def fewer(calibration: Calibration, count: int = FEW) -> Calibration:
    """A calibration on at most `count` of its recordings, evenly spaced."""
    spikes = tuple(evenly_spaced(spikes, count) for spikes in calibration.spikes)
    return Calibration(events=evenly_spaced(calibration.events, count), spikes=spikes)


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
