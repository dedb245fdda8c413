"""What ``data describe`` says of recordings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from spikeloom.models.recordings.counts import EventCounts, Oddities, number, oddities
from spikeloom.models.recordings.describe import RULES, Description
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.report.sections import Section, Table, Text


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
class SensorRate:
    """Events per second by polarity, of the sensor and of each taxel."""

    falling: float
    rising: float
    taxels: tuple[Rate, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Described:
    """Statistics of one split under the keys that scripts rely on; see :class:`describe.Description`."""

    source: str
    split: str
    recordings: int
    taxels: int
    bin_s: float
    steps: int
    duration_s: Duration
    events: int
    found: Oddities | None
    labels: Mapping[int, int]
    unlabelled: int
    rate: SensorRate
    dead: tuple[int, ...]
    one_sided: tuple[int, ...]
    hot: tuple[int, ...]
    rules: Mapping[str, str]
    picture: str | None


def described(
    recordings: Recordings, description: Description, counts: EventCounts | None, picture: str | None
) -> Described:
    """Statistics, what was odd about the events of a file, and where the picture is."""
    shortest, median, longest = description.duration_s
    falling, rising = (float(description.rate[:, polarity].sum()) for polarity in (0, 1))
    return Described(
        source=recordings.source,
        split=recordings.split,
        recordings=description.recordings,
        taxels=recordings.taxels,
        bin_s=description.bin_s,
        steps=recordings.steps,
        duration_s=Duration(shortest=shortest, median=median, longest=longest),
        events=description.events,
        found=None if counts is None else oddities(counts),
        labels={label: count for label, count in description.classes.items() if label != UNLABELLED},
        unlabelled=description.classes.get(UNLABELLED, 0),
        rate=SensorRate(
            falling=falling,
            rising=rising,
            taxels=tuple(Rate(falling=low, rising=high) for low, high in description.rate.tolist()),
        ),
        dead=description.dead,
        one_sided=description.one_sided,
        hot=description.hot,
        rules=RULES,
        picture=picture,
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
