"""Spikes of a layer of the float network held against the chip's, at a bit each."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.layer_kernel import compiled_and_cached

NOWHERE, UNREAD = -1, -2
"""Seats of neurons that the chip does not hold; the spikes of the latter are not compared, as they reach no neuron."""


@compiled_and_cached
def meeting(spikes: Any, packed: Any, depth: Any, seat: Any, begin: Any) -> Any:
    """Spikes that are compared, and how many of them the chip has, too.

    `spikes` (recordings, steps, neurons) uint8 count from the step `begin` (recordings,) on, `packed` are as of
    ``Trace.packed``, and `seat` (neurons,) is each neuron's compartment.
    """
    here, both = 0, 0
    for recording in range(spikes.shape[0]):
        for t in range(begin[recording], spikes.shape[1]):
            fired, words = spikes[recording, t], packed[recording, t + depth]
            for neuron in range(len(seat)):
                if fired[neuron] and seat[neuron] != UNREAD:
                    place = seat[neuron]
                    here += 1
                    if place >= 0:
                        both += (words[place >> 6] >> np.uint64(place & 63)) & np.uint64(1)
    return here, both
