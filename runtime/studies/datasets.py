"""What recordings hold, and what was written of them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.models.recordings.classes import listed
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings
from spikeloom.runtime.report.sections import Section, Table, Text

HOT = 5.0
"""A taxel is hot if its rate is above this many times the median over taxels that are not dead."""

RULES = {
    "dead": "no event in any of these recordings",
    "one-sided": "events of one polarity only",
    "hot": f"more than {HOT:g} times the median rate of the taxels that are not dead",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """Events per second of the sensor and of each taxel by polarity, over the time that was recorded."""

    falling: float
    rising: float
    taxels: Sequence[Mapping[str, float]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Described:
    """Statistics of one split under the keys that scripts rely on; polarity 0 is falling, 1 is rising."""

    source: str
    split: str
    recordings: int
    taxels: int
    bin_s: float
    steps: int
    duration_s: Mapping[str, float]
    events: int  # Those that share taxel, polarity and bin count once
    found: EventCounts | None
    labels: Mapping[int | str, int]
    unlabelled: int
    rate: Rate
    dead: tuple[int, ...]
    one_sided: tuple[int, ...]
    hot: tuple[int, ...]
    rules: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertedSplit:
    """A split that was written, and what was odd about its events."""

    recordings: int
    found: EventCounts | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Converted:
    """Recordings that were written; `names` is the table of what became what."""

    source: str
    output: str
    taxels: int
    steps: int
    names: str | None
    splits: Mapping[str, ConvertedSplit]


def describe(recordings: Recordings) -> Described:
    """Count the events of one split."""
    lengths = recordings.step_counts
    bin_s = recordings.seconds
    per_taxel = recordings.events.sum(axis=(0, 3), dtype=np.int64)
    total = per_taxel.sum(axis=1)
    alive = total > 0
    middle = float(np.median(total[alive])) if alive.any() else 0.0
    rate = per_taxel / (lengths.sum() * bin_s)
    totals = {name: float(rate[:, polarity].sum()) for polarity, name in enumerate(("falling", "rising"))}
    counted = zip(
        *(found.tolist() for found in np.unique(recordings.labels, return_counts=True)), strict=True
    )
    labels: dict[int | str, int] = dict(counted)
    ends = {"shortest": lengths.min(), "median": np.median(lengths), "longest": lengths.max()}
    return Described(
        source=recordings.source,
        split=recordings.split,
        recordings=len(recordings),
        taxels=recordings.taxels,
        bin_s=bin_s,
        steps=recordings.steps,
        duration_s={name: float(steps * bin_s) for name, steps in ends.items()},
        events=int(total.sum()),
        found=recordings.counts,
        unlabelled=labels.pop(UNLABELLED, 0),
        labels=labels if recordings.names is None else _by_name(labels, recordings.names),
        rate=Rate(**totals, taxels=[dict(zip(totals, each, strict=True)) for each in rate.tolist()]),
        dead=tuple(np.flatnonzero(~alive).tolist()),
        one_sided=tuple(np.flatnonzero((per_taxel > 0).sum(axis=1) == 1).tolist()),
        hot=tuple(np.flatnonzero(total > HOT * middle).tolist()),
        rules=RULES,
    )


def _by_name(labels: Mapping[int | str, int], names: Sequence[str]) -> dict[int | str, int]:
    """Recordings of each class by its name."""
    return {names[int(label)]: count for label, count in labels.items()}


def described_sections(result: Described) -> Iterator[Section]:
    """Statistics for people."""
    duration = result.duration_s
    rate = result.rate
    labels = result.labels
    short, middle, long = (f"{seconds:g}" for seconds in duration.values())
    lasts = f"{long} s" if short == long else f"{short} … {long} s (median {middle} s)"
    each = sorted(set(labels.values()))
    spread = (
        number(each[0], "recording")
        if len(each) == 1
        else f"{each[0]} … {each[-1]} recordings"
        if each
        else ""
    )
    lines = [
        f"{result.source}, {result.split}: {number(result.recordings, 'recording')}, "
        f"{number(result.taxels, 'taxel')}, {lasts} in bins of {result.bin_s:g} s",
        f"  labels: {number(len(labels), 'class') + f', {spread} each' if labels else 'none'}"
        + (f"; {number(result.unlabelled, 'recording')} without" if labels and result.unlabelled else ""),
        *(
            [f"  classes: {listed(named)}"]
            if (named := [each for each in labels if isinstance(each, str)])
            else []
        ),
        f"  events: {result.events:,} after binning; {rate.falling:.1f} falling and {rate.rising:.1f} rising "
        "per second",
    ]
    if result.found is not None:
        lines.append(f"  found: {result.found}")
    broken = {"dead": result.dead, "one-sided": result.one_sided, "hot": result.hot}
    for kind, taxels in broken.items():
        lines.append(f"  {kind} taxels: {', '.join(map(str, taxels)) or 'none'} ({result.rules[kind]})")
    yield Section("Recordings", [Text("\n".join(lines))])
    rows = []
    for taxel, one in enumerate(rate.taxels):
        looks = ", ".join(kind for kind, taxels in broken.items() if taxel in taxels)
        rows.append([str(taxel), *(f"{each:.2f}" for each in one.values()), looks])
    yield Section("Taxels", [Table(["taxel", "falling/s", "rising/s", "looks"], rows)])


def converted_sections(result: Converted) -> Iterator[Section]:
    """What was written, for people."""
    lines = [f"{result.output}: {number(result.taxels, 'taxel')}, {number(result.steps, 'bin')}"]
    for split, made in result.splits.items():
        lines.append(f"  {split}: {number(made.recordings, 'recording')}")
        lines += [] if made.found is None else [f"    found: {made.found}"]
    if result.names is not None:
        lines.append(f"  names: {result.names} in it says which recording became which")
    yield Section("Converted", [Text("\n".join(lines))])


def padded(recordings: Recordings, taxels: int) -> Recordings:
    """Silence for the taxels that only another split has."""
    missing = taxels - recordings.taxels
    return replace(recordings, held=np.pad(recordings.events, [(0, 0), (0, missing), (0, 0), (0, 0)]))
