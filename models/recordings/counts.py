"""Anomalies that were found while events were put into bins: counted, said on stderr, kept as JSON."""

import sys
from dataclasses import dataclass, field
from functools import cache

from spikeloom.compiler.files import one_line

GAP_S = 0.5
"""A silence longer than this, between two events, counts as a gap; seconds."""


UNIT_SPAN_S = 60.0
"""Up to this length of a recording no unit is doubted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventCounts:
    """What was counted while recordings were put into bins; the fields are keys in JSON."""

    events: int  # Events read, duplicates included
    out_of_order: int = 0  # Events with a time before that of an event that came earlier
    # Events whose taxel already had one of the same polarity in the same bin; they count once
    duplicates: int = 0
    gaps: int = 0  # Silences longer than `gap_s` between two events of a recording
    gap_s: float = GAP_S
    shorter: int = 0  # Recordings shorter than the longest
    # What is worth a second look: times that look like another unit, taxels that seem to count from 1, a
    # table of labels
    notes: tuple[str, ...] = field(default=(), metadata={"hidden": True})

    def __str__(self) -> str:
        """Counts for people."""
        return (
            f"{number(self.events, 'event')} read, {self.out_of_order:,} out of order, "
            f"{number(self.duplicates, 'duplicate')} in a bin, {number(self.gaps, 'gap')} over {self.gap_s:g} s, "
            f"{number(self.shorter, 'recording')} shorter than the longest"
        )


def time_note(first: float, last: float, moments: int) -> str:
    """Why the times of a recording look wrong: its first and last, of so many different ones; or nothing.

    A sensor that is touched sends several events a second: fewer than one, for a minute, are in a smaller unit.

    >>> time_note(0, 2000, 40), time_note(0, 2, 40)
    ('times up to 2000 s with less than an event a second; write seconds', '')
    >>> time_note(90, 95, 200)
    'events begin at 90 s; count times from the start of the recording'
    """
    if last > UNIT_SPAN_S and moments < last - first:
        return f"times up to {last:g} s with less than an event a second; write seconds"
    if first > max(last - first, 10 * GAP_S):
        return f"events begin at {first:g} s; count times from the start of the recording"
    return ""


@cache
def show_counts(source: str, split: str, counts: EventCounts | None) -> None:
    """Say on stderr, once, what was counted and is worth a second look; the released layout has nothing to say."""
    if counts is not None:
        sys.stderr.write(one_line(f"{source}, {split}: {counts}") + "\n")
        show_notes(counts)


def show_notes(counts: EventCounts | None) -> None:
    """Say on stderr what is worth a second look."""
    if counts is not None:
        sys.stderr.writelines(f"{one_line(f'spikeloom: warning: {note}')}\n" for note in counts.notes)


def number(count: int, noun: str) -> str:
    """A count with its noun.

    Examples
    --------
    >>> number(1, "class"), number(2000, "event"), number(2, "polarity")
    ('1 class', '2,000 events', '2 polarities')
    """
    plural = f"{noun}es" if noun.endswith("s") else f"{noun}s"
    plural = f"{noun[:-1]}ies" if noun.endswith("ty") else plural
    return f"{count:,} {noun if count == 1 else plural}"
