"""What recordings hold: rates per taxel and polarity, their course, and taxels that look broken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.evtouch import Recordings

HOT = 5.0
"""A taxel is hot if its rate is above this many times the median over taxels that are not dead."""

RULES = {
    "dead": "no event in any of these recordings",
    "one-sided": "events of one polarity only",
    "hot": f"more than {HOT:g} times the median rate of the taxels that are not dead",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Description:
    """Statistics of one split; polarity 0 is falling, 1 is rising."""

    recordings: int
    events: int  # Those that share taxel, polarity and bin count once
    bin_s: float  # Width of a bin, seconds
    duration_s: tuple[float, float, float]  # Shortest, median and longest recording, seconds
    classes: Mapping[int, int]  # Recordings of each label
    rate: FloatArray  # (taxels, 2) float64; events per second, over the time that was recorded
    # (steps, 2) float64; events per second of the whole sensor, mean over the recordings that last so long
    course: FloatArray
    # dead, one_sided, hot: Taxels that look broken, see `RULES`
    dead: tuple[int, ...]
    one_sided: tuple[int, ...]
    hot: tuple[int, ...]


def describe(recordings: Recordings, bin_s: float) -> Description:
    """Count the events of one split, whose bins are so many seconds wide."""
    lengths = np.array([recordings.steps_of(index) for index in range(len(recordings))])
    per_taxel = recordings.events.sum(axis=(0, 3), dtype=np.int64)
    per_step = recordings.events.sum(axis=(0, 1), dtype=np.int64).T
    running = (lengths[:, None] > np.arange(recordings.steps)).sum(axis=0)
    total = per_taxel.sum(axis=1)
    alive = total > 0
    middle = float(np.median(total[alive])) if alive.any() else 0.0
    labels, counts = np.unique(recordings.labels, return_counts=True)
    return Description(
        recordings=len(recordings),
        events=int(total.sum()),
        bin_s=bin_s,
        duration_s=(lengths.min() * bin_s, float(np.median(lengths)) * bin_s, lengths.max() * bin_s),
        classes=dict(zip(labels.tolist(), counts.tolist(), strict=True)),
        rate=per_taxel / (lengths.sum() * bin_s),
        course=per_step / (running[:, None] * bin_s),
        dead=tuple(np.flatnonzero(~alive).tolist()),
        one_sided=tuple(np.flatnonzero((per_taxel > 0).sum(axis=1) == 1).tolist()),
        hot=tuple(np.flatnonzero(total > HOT * middle).tolist()),
    )
