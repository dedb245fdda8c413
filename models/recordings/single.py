"""One recording as it was read, and what is worth a second look in several of them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.evtouch import BIN_S, WIDTH

SEVERAL = 8
"""Recordings from which on what none of them has tells something."""

SILENT = 10
"""A recording this many times as long as its events was hardly meant."""

_RELEASED = re.compile(r"sample_[0-9]+_label_")


@dataclass(frozen=True, slots=True)
class Single:
    """What is known of one recording in bins."""

    where: str  # What messages call it
    shape: tuple[int, ...]  # (taxels, polarities, steps with events)
    label: str | None
    counts: EventCounts
    steps: int  # Its length; 0 where it has no events, and nothing says how long it is
    bin_s: float | None  # Seconds of a bin, where somebody said so
    assumed: bool = False  # Whether an array does not say it
    sent: bool = False  # Whether it came as events


def unit_notes(read: Sequence[Single]) -> list[str]:
    """One line for all recordings whose times look wrong."""
    odd = [(each.where, note) for each in read for note in each.counts.notes]
    others = f" (and {len(odd) - 1} more)" if len(odd) > 1 else ""
    return [f"{place}{others}: {note}" for place, note in odd[:1]]


def silent_notes(read: Sequence[Single], source: str) -> list[str]:
    """One line for all recordings without events."""
    silent = [each for each in read if not each.counts.events]
    unknown = sum(each.steps == 0 for each in silent)
    line = f"{source}: {number(len(silent), 'recording')} without events"
    taken = "taken" if unknown == len(silent) else f"{unknown} of them taken"
    return [f"{line}: {taken} as long as the others" if unknown else line] if silent else []


def width_notes(read: Sequence[Single], names: Sequence[str], source: str) -> list[str]:
    """What bins arrays have that do not say it; in the released layout they are known."""
    guessed = [
        name for each, name in zip(read, names, strict=True) if each.assumed and not _RELEASED.match(name)
    ]
    line = f"{source}: nothing says how long a bin of its arrays is: {BIN_S:g} s is assumed"
    return [f"{line}; write the seconds to {WIDTH} beside them"] if guessed else []


def length_notes(source: str, ends: IntArray, steps: IntArray) -> list[str]:
    """Lengths (samples,) in a smaller unit leave nearly all of every recording silent, whose events end there."""
    if (SILENT * ends >= steps).any():
        return []
    return [f"{source}: no event after a tenth of each recording: are the lengths right, in seconds?"]


def polarity_notes(read: Sequence[Single], source: str, heard: BoolArray) -> list[str]:
    """A polarity that nothing has, of those (polarities,) `heard`, among several recordings that came as events."""
    none = np.flatnonzero(~heard)
    if len(read) < SEVERAL or not all(each.sent for each in read) or not len(none):
        return []
    return [f"{source}: no event of polarity {none[0]} in {number(len(read), 'recording')}"]


def taxel_notes(source: str, alive: BoolArray) -> list[str]:
    """Taxels that count from 1 leave the first silent, and no other; those (taxels,) that are `alive` have events."""
    if len(alive) < 4 or alive[0] or not alive[1:].all():
        return []
    return [
        f"{source}: no event at taxel 0, some at each of 1..{len(alive) - 1}: if these count from 1, count from 0"
    ]
