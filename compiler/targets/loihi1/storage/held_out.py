"""Which storage is good enough: the cheapest whose decisions are the float model's on recordings that chose no scale.

A network decides the recordings that it was trained on by wide margins, which hide what rounding does to new
ones. So a recording that is held out loses a quarter of its events, and each quarter of its steps decides by
its own votes: a few spikes that move tell there, and one run of each model gives four decisions. Nothing but
the training split is read.
"""

import numpy as np

from spikeloom.compiler.interpret import channels_last, vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.passes.calibrate import FEW, Spikes, calibrate, evenly_spaced
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork, integer_simulation
from spikeloom.compiler.types import AnyArray, IntArray

HELD = 96
"""Recordings that are held out at most, evenly spaced over those that choose no scale."""

KEPT = 0.75
"""Share of their events that are left."""

PARTS = 4
"""Parts of each, of the same length, that decide by themselves."""


def split(count: int) -> tuple[IntArray, IntArray, IntArray]:
    """Which of so many recordings choose the scales, which may choose those of several planes, and are held out.

    >>> [part.tolist() for part in split(5)]
    [[0, 2, 4], [0, 2, 4], [1, 3]]
    """
    every = np.arange(count)
    few = evenly_spaced(every, min(FEW, -(-count // 2)))
    left_out = evenly_spaced(np.setdiff1d(every, few), HELD) if count > 1 else every[:0]
    return few, np.setdiff1d(every, left_out), left_out


def thinned(events: AnyArray) -> AnyArray:
    """Recordings (samples, taxels, polarities, steps) that have lost events at random, always the same ones."""
    draw = np.random.default_rng(0)
    return np.stack([each * (draw.random(each.shape, np.float32) < KEPT) for each in events])


class HeldOut:
    """Decisions of the float model in each part of thinned recordings, and a chip's beside them.

    Recordings are (samples, taxels, polarities, steps); parts in which the float model casts no vote do not
    count.
    """

    def __init__(self, network: Network, events: AnyArray) -> None:
        self._readout = network.readout
        self._classes = network.classes
        self._known = calibrate(network, channels_last(thinned(events), network.input.clocks))
        votes = self._votes(self._known.spikes)
        self._decided = vote(votes)
        self._voted = votes.any(axis=1)

    def equal(self, integer: IntegerNetwork) -> int:
        """Number of decisions that are the same on the chip."""
        chip = self._known
        for layer in integer_simulation(integer).layers:
            chip = chip.after(layer)
        return int(np.count_nonzero((vote(self._votes(chip.sent)) == self._decided) & self._voted))

    def __len__(self) -> int:
        return int(np.count_nonzero(self._voted))

    def _votes(self, spikes: tuple[Spikes, ...]) -> IntArray:
        """Votes of every part for each class, (parts of samples, classes)."""
        labels = self._readout.label[:, None] == np.arange(self._classes)
        parts = np.array_split(np.arange(self._known.events.shape[1]), PARTS)
        counts = [spikes[self._readout.population][:, part].sum(axis=1) for part in parts]
        return np.asarray(np.concatenate(counts) @ labels)
