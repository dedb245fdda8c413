"""Small changes of a recording: events that come or go, taxels that fail, another place in time.

All are made in the bins of the recording, as :mod:`stress.disturbances` does, before a network joins them; so an event
that goes changes nothing where its step holds another one of the same channel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.events import fitted, join_bins
from spikeloom.runtime.studies.stress.disturbances import held, moved

Events = npt.NDArray[np.uint8]

KINDS = {
    "removed": "one event less",
    "added": "one event more",
    "dead": "a taxel sends nothing",
    "stuck": "a taxel sends both polarities in every bin",
    "two dead": "two taxels send nothing",
    "shifted": "all events earlier or later",
    "start cut": "no events in the first bins",
    "end cut": "no events in the last bins",
}
"""What is tried on each recording, by name."""

SIZED = ("shifted", "start cut", "end cut")
"""Those that are larger or smaller: by so many bins."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cells:
    """Entries of a recording in steps of a network, each of which can be flipped."""

    cells: IntArray  # (entries, 2) int64; channel and step, by step
    there: npt.NDArray[np.bool_]  # (entries,) bool; whether there is an event
    cost: IntArray  # (entries,) int64; events of the recording that must come or go


def channels_of(events: Events, netlist: Netlist) -> Events:
    """Input channels (samples, channels, steps) of changed recordings (samples, taxels, polarities, bins)."""
    joined, length = join_bins(events, netlist.bins), netlist.clocks.length
    return with_clocks(joined if length is None else fitted(joined, length), netlist.clocks)


def cells_of(events: Events, netlist: Netlist) -> Cells:
    """Entries of one recording (taxels, polarities, bins), of the steps that it and the network have."""
    flat = events.reshape(-1, events.shape[-1])
    counts = np.add.reduceat(flat, np.arange(0, flat.shape[1], netlist.bins), axis=1, dtype=np.int64)
    counts = counts[:, : netlist.clocks.length]
    step, channel = np.indices(counts.T.shape).reshape(2, -1)
    found = counts.T.ravel()
    return Cells(cells=np.stack([channel, step], axis=1), there=found > 0, cost=np.maximum(found, 1))


class Failure(NamedTuple):
    """A change that is no single event; `numbers` are those of taxels, or bins."""

    kind: str
    numbers: tuple[int, ...]
    events: Events  # (taxels, polarities, bins); what becomes of the recording

    @property
    def words(self) -> str:
        """Which it is."""
        if self.kind in SIZED:
            return f"{self.numbers[0]} bins"
        return f"taxel{'s' if len(self.numbers) > 1 else ''} {' and '.join(map(str, self.numbers))}"


def failures(events: Events, shift: int) -> Iterator[Failure]:
    """All other small changes of one recording (taxels, polarities, bins), the smallest of a kind first.

    `shift` is how many bins it is moved by at most; what leaves it is lost.
    """
    taxels, _, bins = events.shape
    one = events[None]
    for kind, value in (("dead", 0), ("stuck", 1)):
        for taxel in range(taxels):
            yield Failure(kind, (taxel,), held(one, np.array([taxel]), value)[0])
    for pair in combinations(range(taxels), 2):
        yield Failure("two dead", pair, held(one, np.array(pair), 0)[0])
    for size in range(1, min(shift, bins - 1) + 1):
        for by in (size, -size):
            yield Failure("shifted", (by,), moved(one, partial(np.add, by))[0])
    for cut in range(1, bins):
        for kind, part in (("start cut", slice(cut)), ("end cut", slice(bins - cut, None))):
            changed = events.copy()
            changed[..., part] = 0
            yield Failure(kind, (cut,), changed)


def words_of(cell: IntArray, there: bool, netlist: Netlist) -> str:
    """An entry that is flipped."""
    taxel, polarity = divmod(int(cell[0]), netlist.polarities)
    joined = f", bins of {netlist.bins}" if netlist.bins > 1 else ""
    return f"taxel {taxel}, polarity {polarity}, step {int(cell[1])}{joined}: {'removed' if there else 'added'}"
