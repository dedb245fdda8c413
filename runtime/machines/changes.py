"""What changed events bring about: beside the known run of a recording, on any chip."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.types import AnyArray, IntArray

PART = 64
"""Changed recordings that run together."""


class Changes(NamedTuple):
    """Changes of one recording, each of some entries that are flipped: an event comes or goes."""

    cells: IntArray  # (flips, 2) int64; channel and step, by step within each change
    bounds: IntArray  # (changes + 1,) int64; of each change in the flips

    def of(self, index: int) -> IntArray:
        """Entries of one change, (flips, 2)."""
        return self.cells[self.bounds[index] : self.bounds[index + 1]]


class Effects(NamedTuple):
    """What changes bring about."""

    # come, gone: (changes, classes) int64; votes that a changed run has and the known one has not, and the
    # other way
    come: IntArray
    gone: IntArray
    end: IntArray  # (changes,) int64; chip step from which on a changed run spikes as the known one

    @property
    def votes(self) -> IntArray:
        """What is added to the votes, (changes, classes)."""
        return self.come - self.gone


class Past(NamedTuple):
    """What is known of the group of changed events before one."""

    steps: int  # From it to this one, at least
    single: bool = False  # Whether it was one event, exactly so many steps ago


class Groups(NamedTuple):
    """What groups of changed events, each of one step, turn against a decision at most, whatever came before."""

    lag: int  # Steps from an event to the first vote that it can alter
    # (steps, reach, classes) int32; votes that the decision loses and a class gains from `lag` steps after the group
    # until `lag` steps after the next, if nothing is known of the groups before it: by its step; and by how many steps
    # later the next one comes, from 1, the last of them standing for later ones and for none
    lost: npt.NDArray[np.int32]
    # The same of a step (2, reach, classes), of one event and of any number, given what is known of the group before
    after: Callable[[Past, int], npt.NDArray[np.int32]]


def single(cells: IntArray) -> Changes:
    """Each entry flipped alone."""
    return Changes(cells, np.arange(len(cells) + 1))


def joined(changes: list[IntArray]) -> Changes:
    """Changes of several entries each, (flips, 2), put in order."""
    ordered = [each[np.argsort(each[:, 1], kind="stable")] for each in changes]
    none = np.zeros((0, 2), np.int64)
    return Changes(np.concatenate([none, *ordered]), np.cumsum([0, *map(len, changes)]))


def by_running(run: Callable[[Any], IntArray], channels: AnyArray, changes: Changes) -> Effects:
    """The definition: each changed recording (channels, steps) is run from its first step to its last.

    `run` gives votes (samples, classes) of recordings (samples, channels, steps).
    """
    known = run(channels[None])[0]
    votes = []
    for first in range(0, len(changes.bounds) - 1, PART):
        part = range(first, min(first + PART, len(changes.bounds) - 1))
        changed = np.repeat(channels[None], len(part), axis=0)
        for row, index in zip(changed, part, strict=True):
            channel, step = changes.of(index).T
            row[channel, step] ^= 1
        votes.append(run(changed))
    moved = np.concatenate([np.zeros((0, len(known)), np.int64), *votes]) - known
    return Effects(
        np.maximum(moved, 0), np.maximum(-moved, 0), np.full(len(moved), channels.shape[1] + LATE)
    )


LATE = 1 << 20
"""Steps after a recording by which every run is over."""
