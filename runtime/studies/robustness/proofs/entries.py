"""Entries of a recording in steps of a network: each holds events or none, and can be flipped.

An event that goes changes nothing where its step holds another one of the same channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.models.recordings.events import fitted, join_bins

Events = EventArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cells:
    """Entries of a recording in steps of a network, each of which can be flipped."""

    cells: IntArray  # (entries, 2) int64; channel and step, by step
    there: BoolArray  # (entries,) bool; whether there is an event
    cost: IntArray  # (entries,) int64; events of the recording that must come or go

    def words_of(self, entry: int, netlist: Netlist) -> str:
        """An entry that is flipped."""
        channel, step = self.cells[entry].tolist()
        taxel, polarity = divmod(channel, netlist.polarities)
        joined = f", bins of {netlist.bins}" if netlist.bins > 1 else ""
        change = "removed" if self.there[entry] else "added"
        return f"taxel {taxel}, polarity {polarity}, step {step}{joined}: {change}"


def channels_of(events: Events, netlist: Netlist) -> Events:
    """Input channels (samples, channels, steps) of changed recordings (samples, taxels, polarities, bins)."""
    joined = join_bins(events, netlist.bins)
    length = netlist.clocks.length
    return with_clocks(joined if length is None else fitted(joined, length), netlist.clocks)


def cells_of(events: Events, netlist: Netlist) -> Cells:
    """Entries of one recording (taxels, polarities, bins), of the steps that it and the network have."""
    flat = events.reshape(-1, events.shape[-1])
    counts = np.add.reduceat(flat, np.arange(0, flat.shape[1], netlist.bins), axis=1, dtype=np.int64)
    counts = counts[:, : netlist.clocks.length]
    step, channel = np.indices(counts.T.shape).reshape(2, -1)
    events_in = counts.T.ravel()
    return Cells(cells=np.stack([channel, step], axis=1), there=events_in > 0, cost=np.maximum(events_in, 1))
