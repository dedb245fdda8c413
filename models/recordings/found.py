"""What was found while events were put into bins, for people and for scripts."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from spikeloom.models.recordings.events import GAP_S, EventCounts
from spikeloom.models.recordings.evtouch import Recordings

Json = dict[str, Any]


def show_counts(recordings: Recordings, counts: EventCounts | None) -> None:
    """Say on stderr what was found while events were put into bins; the released layout has nothing to say."""
    if counts is not None:
        sys.stderr.write(f"{recordings.source}: {counts_text(counts_json(counts))}\n")
        show_notes(counts)


def show_notes(counts: EventCounts | None) -> None:
    """Say on stderr what is worth a second look."""
    if counts is not None:
        sys.stderr.writelines(f"spikeloom: warning: {note}\n" for note in counts.notes)


def counts_json(counts: EventCounts, steps: int | None = None) -> Json:
    """Counts under the keys that scripts rely on; `steps` where all recordings were filled up to one length."""
    found = asdict(counts)
    kept = {key: found[key] for key in ("events", "out_of_order", "duplicates", "gaps")} | {"gap_s": GAP_S}
    key, length = ("shorter", max(counts.steps)) if steps is None else ("padded", steps)
    return kept | {key: sum(own < length for own in counts.steps)}


def counts_text(found: Json) -> str:
    """Counts for people."""
    if "padded" in found:
        lengths = f"{number(found['padded'], 'recording')} padded at the end"
    else:
        lengths = f"{number(found['shorter'], 'recording')} shorter than the longest"
    return (
        f"{number(found['events'], 'event')} read, {found['out_of_order']:,} out of order, "
        f"{number(found['duplicates'], 'duplicate')} in a bin, "
        f"{number(found['gaps'], 'gap')} over {found['gap_s']:g} s, {lengths}"
    )


def number(count: int, noun: str) -> str:
    """A count with its noun.

    Examples
    --------
    >>> number(1, "class"), number(2000, "event")
    ('1 class', '2,000 events')
    """
    plural = f"{noun}es" if noun.endswith("s") else f"{noun}s"
    return f"{count:,} {noun if count == 1 else plural}"
