"""The commands under ``spikeloom data``: fetch recordings, describe them, convert them to the released layout."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import show_notes
from spikeloom.models.recordings.events import data_splits, joined_bins, load_data, require_events
from spikeloom.models.recordings.evtouch import Recordings, require_polarities
from spikeloom.models.recordings.fetch import Fetched, fetch_data
from spikeloom.models.recordings.grasps import SPLITS, SYNTHETIC, synthetic_split
from spikeloom.models.recordings.release import SOURCES, write_event_lines, write_released
from spikeloom.models.sensors import read_layout
from spikeloom.runtime.commands.options import add_common, add_options
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import require_bins, warn_of_few
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.requests.exchange import ConvertRequest, DescribeRequest, FetchRequest
from spikeloom.runtime.requests.fields import Request
from spikeloom.runtime.studies.datasets import (
    Converted,
    ConvertedSplit,
    converted_sections,
    describe,
    described_sections,
    padded,
)


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
    warn_of_few(recordings)
    return Outcome(describe(recordings), described_sections)


def _convert(request: ConvertRequest) -> Outcome:
    lines = request.output.lower().endswith(".csv")
    if lines or request.output.lower().endswith(".zip") or not Path(request.output).exists():
        require_place(request.output, "-o", request)
    require_bins(bins := request.join)
    count, places = _layout(request.taxels)
    present = tuple(SPLITS) if request.source == SYNTHETIC else data_splits(request.source)
    loaded = [
        _load(request.source, split, request.bin, count, places) for split in present or (request.split,)
    ]
    for recordings in loaded:
        show_notes(recordings.counts)
    longest = max(loaded, key=lambda recordings: recordings.steps)
    loaded = [joined_bins(recordings, bins) for recordings in loaded]
    taxels = max(recordings.taxels for recordings in loaded)
    steps = max(recordings.steps for recordings in loaded)
    if lines:
        write_event_lines(request.output, loaded, bins * loaded[0].seconds)
    else:
        grown = [padded(recordings, taxels) for recordings in loaded]
        known = loaded[0].bin_s is not None or bins > 1
        write_released(request.output, grown, round(bins * loaded[0].seconds, 12) if known else None)
    warn_of_few(longest, bins)
    result = Converted(
        source=request.source,
        output=request.output,
        taxels=taxels,
        steps=steps,
        names=None if lines else SOURCES,
        splits={each.split: ConvertedSplit(recordings=len(each), found=each.counts) for each in loaded},
    )
    return Outcome(result, converted_sections)


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
