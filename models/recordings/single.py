"""One recording as it was read, and what is worth a second look in several of them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.types import AnyArray, BoolArray, IntArray
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.evtouch import BIN_S, WIDTH, Recordings

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


def heard(recordings: Recordings) -> tuple[BoolArray, IntArray]:
    """Channels (taxels, polarities) with an event, and the step after the last event of each recording (samples,)."""
    channels = np.zeros(recordings.held.shape[1:3], np.bool_)
    ends = []
    for part in recordings.parts():
        channels |= part.events.any(axis=(0, 3))
        busy = part.events.any(axis=(1, 2))
        ends.append(np.where(busy, np.arange(1, busy.shape[1] + 1), 0).max(axis=1))
    return channels, np.concatenate(ends)


def event_notes(recordings: Recordings, read: Sequence[Single], taxels: int | None) -> list[str]:
    """What is odd about where and when there are events; taxels that are not `taxels` of a network were counted."""
    channels, ends = heard(recordings)
    notes = [] if taxels is not None else _taxel_notes(np.asarray(channels.any(axis=1)))
    if (SILENT * ends < recordings.step_counts).all():
        notes += ["no event after a tenth of each recording: are the lengths right, in seconds?"]
    silent = np.flatnonzero(~channels.any(axis=0))
    if sum(each.counts.events > 0 for each in read) >= SEVERAL and len(silent):
        notes += [f"no event of polarity {silent[0]} in {number(len(read), 'recording')}"]
    return [f"{recordings.source}: {note}" for note in notes]


def _taxel_notes(alive: AnyArray) -> list[str]:
    """Taxels that count from 1 leave the first silent, and no other; those (taxels,) that are `alive` have events."""
    if len(alive) < 4 or alive[0] or not alive[1:].all():
        return []
    return [f"no event at taxel 0, some at each of 1..{len(alive) - 1}: if these count from 1, count from 0"]


def other_sensor(recordings: Recordings) -> str | None:
    """Note that events are of a smaller sensor: in many recordings the last quarter of the taxels has none."""
    channels, _ = heard(recordings)
    last = int(np.flatnonzero(channels.any(axis=1)).max(initial=-1))
    if (
        recordings.bin_s is None
        or len(recordings) < SEVERAL
        or 4 * (recordings.taxels - 1 - last) <= recordings.taxels
    ):
        return None
    return f"{recordings.source}: has events of taxels 0..{last} only, the network has {recordings.taxels}"
