"""What ``data describe`` says of recordings: rates per taxel and polarity, their course, taxels that look broken."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.report.encode import HIDDEN
from spikeloom.runtime.report.sections import Section, Table, Text

HOT = 5.0
"""A taxel is hot if its rate is above this many times the median over taxels that are not dead."""

RULES = {
    "dead": "no event in any of these recordings",
    "one-sided": "events of one polarity only",
    "hot": f"more than {HOT:g} times the median rate of the taxels that are not dead",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Duration:
    """Of recordings, in seconds."""

    shortest: float
    median: float
    longest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """Events per second by polarity."""

    falling: float
    rising: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorRate(Rate):
    """Events per second by polarity, of the sensor and of each taxel, over the time that was recorded."""

    taxels: tuple[Rate, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Described:
    """Statistics of one split under the keys that scripts rely on; polarity 0 is falling, 1 is rising."""

    source: str
    split: str
    recordings: int
    taxels: int
    bin_s: float
    steps: int
    duration_s: Duration
    events: int  # Those that share taxel, polarity and bin count once
    found: EventCounts | None
    labels: Mapping[int, int]
    unlabelled: int
    rate: SensorRate
    dead: tuple[int, ...]
    one_sided: tuple[int, ...]
    hot: tuple[int, ...]
    rules: Mapping[str, str]
    picture: str | None
    # (steps, 2); events per second of the whole sensor, mean over the recordings that last so long
    course: FloatArray = field(metadata=HIDDEN)


def describe(recordings: Recordings, bin_s: float, picture: str | None = None) -> Described:
    """Count the events of one split, whose bins are so many seconds wide."""
    lengths = np.array([recordings.steps_of(index) for index in range(len(recordings))])
    per_taxel = recordings.events.sum(axis=(0, 3), dtype=np.int64)
    per_step = recordings.events.sum(axis=(0, 1), dtype=np.int64).T
    running = (lengths[:, None] > np.arange(recordings.steps)).sum(axis=0)
    total = per_taxel.sum(axis=1)
    alive = total > 0
    middle = float(np.median(total[alive])) if alive.any() else 0.0
    rate = per_taxel / (lengths.sum() * bin_s)
    falling, rising = (float(rate[:, polarity].sum()) for polarity in (0, 1))
    labels = dict(zip(*(found.tolist() for found in np.unique(recordings.labels, return_counts=True)), strict=True))
    shortest, median, longest = (float(of(lengths) * bin_s) for of in (np.min, np.median, np.max))
    return Described(
        source=recordings.source,
        split=recordings.split,
        recordings=len(recordings),
        taxels=recordings.taxels,
        bin_s=bin_s,
        steps=recordings.steps,
        duration_s=Duration(shortest=shortest, median=median, longest=longest),
        events=int(total.sum()),
        found=recordings.counts,
        unlabelled=labels.pop(UNLABELLED, 0),
        labels=labels,
        rate=SensorRate(
            falling=falling,
            rising=rising,
            taxels=tuple(Rate(falling=low, rising=high) for low, high in rate.tolist()),
        ),
        dead=tuple(np.flatnonzero(~alive).tolist()),
        one_sided=tuple(np.flatnonzero((per_taxel > 0).sum(axis=1) == 1).tolist()),
        hot=tuple(np.flatnonzero(total > HOT * middle).tolist()),
        rules=RULES,
        picture=picture,
        course=per_step / (running[:, None] * bin_s),
    )


def described_sections(result: Described) -> Iterable[Section]:
    """Statistics for people."""
    duration, rate, labels = result.duration_s, result.rate, result.labels
    short, middle, long = (f"{seconds:g}" for seconds in (duration.shortest, duration.median, duration.longest))
    lasts = f"{long} s" if short == long else f"{short} … {long} s (median {middle} s)"
    each = sorted(set(labels.values()))
    spread = number(each[0], "recording") if len(each) == 1 else f"{each[0]} … {each[-1]} recordings" if each else ""
    lines = [
        f"{result.source}, {result.split}: {number(result.recordings, 'recording')}, "
        f"{number(result.taxels, 'taxel')}, {lasts} in bins of {result.bin_s:g} s",
        f"  labels: {number(len(labels), 'class') + f', {spread} each' if labels else 'none'}"
        + (f"; {number(result.unlabelled, 'recording')} without" if labels and result.unlabelled else ""),
        f"  events: {result.events:,} after binning; {rate.falling:.1f} falling and {rate.rising:.1f} rising "
        "per second",
    ]
    lines += [] if result.found is None else [f"  found: {result.found}"]
    broken = {"dead": result.dead, "one-sided": result.one_sided, "hot": result.hot}
    for kind, taxels in broken.items():
        lines.append(f"  {kind} taxels: {', '.join(map(str, taxels)) or 'none'} ({result.rules[kind]})")
    lines += [] if result.picture is None else [f"  picture: {result.picture}"]
    yield Section("Recordings", [Text("\n".join(lines))])
    rows = []
    for taxel, one in enumerate(rate.taxels):
        looks = ", ".join(kind for kind, taxels in broken.items() if taxel in taxels)
        rows.append([str(taxel), f"{one.falling:.2f}", f"{one.rising:.2f}", looks])
    yield Section("Taxels", [Table(["taxel", "falling/s", "rising/s", "looks"], rows)])
