"""The commands under ``spikeloom data``: fetch recordings, describe them, convert them to the released layout."""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import EventCounts, number, show_notes
from spikeloom.models.recordings.events import data_splits, joined_bins, load_data, require_events
from spikeloom.models.recordings.evtouch import UNLABELLED, Recordings, require_polarities
from spikeloom.models.recordings.fetch import Fetched, fetch_data
from spikeloom.models.recordings.grasps import SPLITS, SYNTHETIC, synthetic_split
from spikeloom.models.recordings.release import SOURCES, write_event_lines, write_released
from spikeloom.models.sensors import read_layout
from spikeloom.runtime.commands.options import add_common, add_options
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import require_bins
from spikeloom.runtime.report.sections import Outcome, Section, Table, Text
from spikeloom.runtime.requests.exchange import ConvertRequest, DescribeRequest, FetchRequest
from spikeloom.runtime.requests.fields import Request

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
    labels: Mapping[int, int]
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the commands under ``data``."""
    actions = parser.add_subparsers(dest="data_command", required=True, metavar="COMMAND")
    for name, kind, action in ACTIONS:
        sub = actions.add_parser(name, help=kind.__doc__, description=kind.__doc__)
        sub.set_defaults(action=action, request=kind)
        add_options(sub, kind)
        add_common(sub)


def _fetch(request: FetchRequest) -> Outcome:
    return Outcome(fetch_data(request.name, url=request.url), _fetch_sections)


def _fetch_sections(result: Fetched) -> Iterator[Section]:
    state = "fetched" if result.new else "already there"
    yield Section(
        "Fetched",
        [
            Text(f"{result.name}: {state}, {result.bytes:,} bytes, sha256 as released"),
            Text(f"  {result.path}\n  use it with --data {result.data}"),
        ],
    )


def _describe(request: DescribeRequest) -> Outcome:
    count, _ = _layout(request.taxels)
    recordings = _load(request.source, request.split, request.bin, count)
    require_polarities(recordings)
    show_notes(recordings.counts)
    return Outcome(describe(recordings), described_sections)


def describe(recordings: Recordings) -> Described:
    """Count the events of one split."""
    lengths, bin_s = recordings.step_counts, recordings.seconds
    per_taxel = recordings.events.sum(axis=(0, 3), dtype=np.int64)
    total = per_taxel.sum(axis=1)
    alive = total > 0
    middle = float(np.median(total[alive])) if alive.any() else 0.0
    rate = per_taxel / (lengths.sum() * bin_s)
    totals = {name: float(rate[:, polarity].sum()) for polarity, name in enumerate(("falling", "rising"))}
    labels = dict(zip(*(found.tolist() for found in np.unique(recordings.labels, return_counts=True)), strict=True))
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
        labels=labels,
        rate=Rate(**totals, taxels=[dict(zip(totals, each, strict=True)) for each in rate.tolist()]),
        dead=tuple(np.flatnonzero(~alive).tolist()),
        one_sided=tuple(np.flatnonzero((per_taxel > 0).sum(axis=1) == 1).tolist()),
        hot=tuple(np.flatnonzero(total > HOT * middle).tolist()),
        rules=RULES,
    )


def described_sections(result: Described) -> Iterator[Section]:
    """Statistics for people."""
    duration, rate, labels = result.duration_s, result.rate, result.labels
    short, middle, long = (f"{seconds:g}" for seconds in duration.values())
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


def _convert(request: ConvertRequest) -> Outcome:
    lines = request.output.lower().endswith(".csv")
    if lines or request.output.lower().endswith(".zip") or not Path(request.output).exists():
        require_place(request.output, "-o", request)
    require_bins(bins := request.join)
    count, places = _layout(request.taxels)
    present = tuple(SPLITS) if request.source == SYNTHETIC else data_splits(request.source)
    loaded = [_load(request.source, split, request.bin, count, places) for split in present or (request.split,)]
    for recordings in loaded:
        show_notes(recordings.counts)
    loaded = [joined_bins(recordings, bins) for recordings in loaded]
    taxels = max(recordings.taxels for recordings in loaded)
    steps = max(recordings.steps for recordings in loaded)
    if lines:
        write_event_lines(request.output, loaded, bins * loaded[0].seconds)
    else:
        grown = [_grown(recordings, taxels, steps) for recordings in loaded]
        known = loaded[0].bin_s is not None or bins > 1
        write_released(request.output, grown, round(bins * loaded[0].seconds, 12) if known else None)
    result = Converted(
        source=request.source,
        output=request.output,
        taxels=taxels,
        steps=steps,
        names=None if lines else SOURCES,
        splits={each.split: ConvertedSplit(recordings=len(each), found=each.counts) for each in loaded},
    )
    return Outcome(result, _convert_sections)


def _convert_sections(result: Converted) -> Iterator[Section]:
    lines = [f"{result.output}: {number(result.taxels, 'taxel')}, {number(result.steps, 'bin')}"]
    for split, made in result.splits.items():
        lines.append(f"  {split}: {number(made.recordings, 'recording')}")
        lines += [] if made.found is None else [f"    found: {made.found}"]
    if result.names is not None:
        lines.append(f"  names: {result.names} in it says which recording became which")
    yield Section("Converted", [Text("\n".join(lines))])


def _grown(recordings: Recordings, taxels: int, steps: int) -> Recordings:
    """Silence for the taxels and the time that only another split has."""
    events = np.zeros((len(recordings), taxels, 2, steps), dtype=np.uint8)
    events[:, : recordings.taxels, :, : recordings.steps] = recordings.events
    return replace(recordings, events=events, lengths=None)


def _load(
    source: str, split: str, bin_s: float | None, taxels: int | None, places: FloatArray | None = None
) -> Recordings:
    if source == SYNTHETIC:
        require_events(SYNTHETIC, bin_s)
        return synthetic_split(split) if places is None else synthetic_split(split, coordinates=places)
    return load_data(source, split, bin_s=bin_s, taxels=taxels)


def _layout(taxels: str | None) -> tuple[int | None, FloatArray | None]:
    """Number of taxels and their positions, as far as ``--taxels`` says them."""
    return (None, None) if taxels is None else read_layout(taxels)


ACTIONS: tuple[tuple[str, type[Request], Callable[[Any], Outcome]], ...] = (
    ("fetch", FetchRequest, _fetch),
    ("describe", DescribeRequest, _describe),
    ("convert", ConvertRequest, _convert),
)
