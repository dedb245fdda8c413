"""The commands under ``spikeloom data``: fetch recordings, describe them, convert them to the released layout."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.types import FloatArray
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.counts import EventCounts, number, show_notes
from spikeloom.models.recordings.events import data_splits, joined_bins, load_data, require_events
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.fetch import DATA_SETS, data_folder, fetch_data
from spikeloom.models.recordings.grasps import SPLITS, SYNTHETIC, synthetic_split
from spikeloom.models.recordings.release import SOURCES, write_event_lines, write_released
from spikeloom.models.sensors import read_layout
from spikeloom.runtime.commands.exchange.described import describe, described_sections, picture
from spikeloom.runtime.commands.options import add_bin_option, add_common
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import require_bins
from spikeloom.runtime.report.sections import Outcome, Section, Text

Arguments = argparse.Namespace


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchedData:
    """Where released recordings are, and what to give to ``--data``."""

    name: str
    path: Path
    new: bool
    bytes: int
    sha256: str
    data: str


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

    def command(name: str, action: Callable[[Arguments], Outcome], summary: str) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = actions.add_parser(name, help=summary, description=summary)
        sub.set_defaults(action=action)
        add_common(sub)
        return sub

    sub = command("fetch", _fetch, "download released recordings; --data then takes their name")
    sub.add_argument("name", choices=tuple(DATA_SETS))
    sub.add_argument("--url", help="another address of the same file")
    sub.add_argument("--dir", help="where to put it (default: $SPIKELOOM_DATA, or spikeloom in the user's cache)")

    sub = command("describe", _describe, "counts, rates by taxel and polarity, duration, dead and hot taxels")
    _source(sub)
    sub.add_argument("--split", default="test", help="split to read (default: test)")
    sub.add_argument("--picture", metavar="OUT.png", help="draw it")

    sub = command("convert", _convert, "write the released layout: SPLIT/sample_N_label_L.npy")
    _source(sub)
    sub.add_argument("--split", default="test", help="split of recordings that have none (default: test)")
    sub.add_argument("--join", type=int, default=1, metavar="N", help="make one bin of N, an event where one has any")
    sub.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT",
        help="new folder, or a zip; or a .csv of event lines, of one recording",
    )


def _source(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        metavar="SRC",
        help=f"folder, zip, .csv, .npz or .npy with recordings, '{SYNTHETIC}', or {' or '.join(map(repr, DATA_SETS))}",
    )
    add_bin_option(parser)
    parser.add_argument("--taxels", metavar="N|COORDS.csv", help="how many there are, or where: x,y[,z] in mm")


def _fetch(arguments: Arguments) -> Outcome:
    fetched = fetch_data(arguments.name, url=arguments.url, folder=arguments.dir)
    data = DATA_SETS[arguments.name]
    default = fetched.path == data_folder() / data.file
    result = FetchedData(
        name=arguments.name,
        path=fetched.path,
        new=fetched.new,
        bytes=data.size,
        sha256=data.sha256,
        data=arguments.name if default else str(fetched.path),
    )
    return Outcome(result, _fetch_sections)


def _fetch_sections(result: FetchedData) -> Iterable[Section]:
    state = "fetched" if result.new else "already there"
    yield Section(
        "Fetched",
        [
            Text(f"{result.name}: {state}, {result.bytes:,} bytes, sha256 as released"),
            Text(f"  {result.path}\n  use it with --data {result.data}"),
        ],
    )


def _describe(arguments: Arguments) -> Outcome:
    if arguments.picture is not None:
        if Path(arguments.picture).suffix.lower() != ".png":
            raise OptionError(f"--picture {arguments.picture}: allowed is a PNG; give a name that ends in .png")
        require_place(arguments.picture, "--picture", arguments)
    count, places = _layout(arguments.taxels)
    recordings = _load(arguments.source, arguments.split, arguments.bin, count)
    show_notes(recordings.counts)
    result = describe(recordings, arguments.bin, arguments.picture)
    if places is None and recordings.taxels == len(NEUTOUCH):
        places = NEUTOUCH
    if arguments.picture is not None:
        with write_atomically(arguments.picture) as file:
            file.write(picture(result, places).file("png"))
    return Outcome(result, described_sections)


def _convert(arguments: Arguments) -> Outcome:
    lines = arguments.output.lower().endswith(".csv")
    if lines or arguments.output.lower().endswith(".zip"):
        require_place(arguments.output, "-o", arguments)
    bins = arguments.join
    require_bins(bins)
    count, places = _layout(arguments.taxels)
    present = tuple(SPLITS) if arguments.source == SYNTHETIC else data_splits(arguments.source)
    loaded = [_load(arguments.source, split, arguments.bin, count, places) for split in present or (arguments.split,)]
    for recordings in loaded:
        show_notes(recordings.counts)
    loaded = [joined_bins(recordings, bins) for recordings in loaded]
    taxels = max(recordings.taxels for recordings in loaded)
    steps = max(recordings.steps for recordings in loaded)
    if lines:
        write_event_lines(arguments.output, loaded, bins * arguments.bin)
    else:
        write_released(arguments.output, [_grown(recordings, taxels, steps) for recordings in loaded])
    splits = {
        recordings.split: ConvertedSplit(recordings=len(recordings), found=_padded(recordings, steps))
        for recordings in loaded
    }
    result = Converted(
        source=arguments.source,
        output=arguments.output,
        taxels=taxels,
        steps=steps,
        names=None if lines else SOURCES,
        splits=splits,
    )
    return Outcome(result, _convert_sections)


def _convert_sections(result: Converted) -> Iterable[Section]:
    lines = [f"{result.output}: {number(result.taxels, 'taxel')}, {number(result.steps, 'bin')}"]
    for split, made in result.splits.items():
        lines.append(f"  {split}: {number(made.recordings, 'recording')}")
        lines += [] if made.found is None else [f"    found: {made.found}"]
    if result.names is not None:
        lines.append(f"  names: {result.names} in it says which recording became which")
    yield Section("Converted", [Text("\n".join(lines))])


def _padded(recordings: Recordings, steps: int) -> EventCounts | None:
    """What was odd, and how many recordings are filled up to so many steps."""
    if recordings.counts is None:
        return None
    padded = int(np.count_nonzero(recordings.step_counts < steps))
    return replace(recordings.counts, shorter=None, padded=padded)


def _grown(recordings: Recordings, taxels: int, steps: int) -> Recordings:
    """Silence for the taxels and the time that only another split has."""
    events = np.zeros((len(recordings), taxels, 2, steps), dtype=np.uint8)
    events[:, : recordings.taxels, :, : recordings.steps] = recordings.events
    return replace(recordings, events=events, lengths=None)


def _load(source: str, split: str, bin_s: float, taxels: int | None, places: FloatArray | None = None) -> Recordings:
    if source == SYNTHETIC:
        require_events(SYNTHETIC, bin_s)
        return synthetic_split(split) if places is None else synthetic_split(split, coordinates=places)
    return load_data(source, split, bin_s=bin_s, taxels=taxels)


def _layout(taxels: str | None) -> tuple[int | None, FloatArray | None]:
    """Number of taxels and their positions, as far as ``--taxels`` says them."""
    return (None, None) if taxels is None else read_layout(taxels)
