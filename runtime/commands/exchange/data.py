"""The commands under ``spikeloom data``: fetch recordings, describe them, convert them to the released layout."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.describe import RULES, Description, describe
from spikeloom.models.recordings.eventfiles import UNLABELLED
from spikeloom.models.recordings.events import EventCounts, data_splits, joined_bins, load_data, require_events
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.fetch import DATA_SETS, data_folder, fetch_data
from spikeloom.models.recordings.found import counts_json, counts_text, number, show_notes
from spikeloom.models.recordings.grasps import SPLITS, SYNTHETIC, synthetic_split
from spikeloom.models.recordings.release import SOURCES, write_event_lines, write_released
from spikeloom.models.sensors import read_layout
from spikeloom.runtime.commands.options import add_bin_option, add_common
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import require_bins
from spikeloom.runtime.report.tables import table

Arguments = argparse.Namespace
Outcome = tuple[dict[str, Any], Callable[[dict[str, Any]], str], int]
Json = dict[str, Any]


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
    def progress(have: int, size: int) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\x1b[Kfetching {arguments.name}: {100 * have // size} % …")
            sys.stderr.flush()

    fetched = fetch_data(arguments.name, url=arguments.url, folder=arguments.dir, progress=progress)
    data = DATA_SETS[arguments.name]
    default = fetched.path == data_folder() / data.file
    report = {
        "name": arguments.name,
        "path": str(fetched.path),
        "new": fetched.new,
        "bytes": data.size,
        "sha256": data.sha256,
        "data": arguments.name if default else str(fetched.path),
    }
    return report, _fetch_text, 0


def _fetch_text(report: Json) -> str:
    state = "fetched" if report["new"] else "already there"
    return (
        f"{report['name']}: {state}, {report['bytes']:,} bytes, sha256 as released\n"
        f"  {report['path']}\n  use it with --data {report['data']}"
    )


def _describe(arguments: Arguments) -> Outcome:
    if arguments.picture is not None:
        _check_picture(arguments.picture)
        require_place(arguments.picture, "--picture", arguments)
    count, places = _layout(arguments.taxels)
    recordings, counts = _load(arguments.source, arguments.split, arguments.bin, count)
    show_notes(counts)
    description = describe(recordings, arguments.bin)
    if places is None and recordings.taxels == len(NEUTOUCH):
        places = NEUTOUCH
    if arguments.picture is not None:
        from spikeloom.runtime.report.data_picture import draw

        draw(arguments.picture, description, places, title=f"{recordings.source}, {recordings.split}")
    return _description_json(recordings, description, counts, arguments.picture), _description_text, 0


def _description_json(
    recordings: Recordings, description: Description, counts: EventCounts | None, picture: str | None
) -> Json:
    """Statistics under the keys that scripts rely on."""
    return {
        "source": recordings.source,
        "split": recordings.split,
        "recordings": description.recordings,
        "taxels": recordings.taxels,
        "bin_s": description.bin_s,
        "steps": recordings.steps,
        "duration_s": dict(zip(("shortest", "median", "longest"), description.duration_s, strict=True)),
        "events": description.events,
        "found": None if counts is None else counts_json(counts),
        "labels": {str(label): number for label, number in description.classes.items() if label != UNLABELLED},
        "unlabelled": description.classes.get(UNLABELLED, 0),
        "rate": {
            "falling": float(description.rate[:, 0].sum()),
            "rising": float(description.rate[:, 1].sum()),
            "taxels": [{"falling": low, "rising": high} for low, high in description.rate.tolist()],
        },
        "dead": list(description.dead),
        "one_sided": list(description.one_sided),
        "hot": list(description.hot),
        "rules": RULES,
        "picture": picture,
    }


def _description_text(report: Json) -> str:
    """Statistics for people."""
    duration, rate = report["duration_s"], report["rate"]
    short, middle, long = (f"{duration[key]:g}" for key in ("shortest", "median", "longest"))
    lasts = f"{long} s" if short == long else f"{short} … {long} s (median {middle} s)"
    labels = report["labels"]
    each = sorted(set(labels.values()))
    spread = number(each[0], "recording") if len(each) == 1 else f"{each[0]} … {each[-1]} recordings" if each else ""
    lines = [
        f"{report['source']}, {report['split']}: {number(report['recordings'], 'recording')}, "
        f"{number(report['taxels'], 'taxel')}, "
        f"{lasts} in bins of {report['bin_s']:g} s",
        f"  labels: {number(len(labels), 'class') + f', {spread} each' if labels else 'none'}"
        + (f"; {number(report['unlabelled'], 'recording')} without" if labels and report["unlabelled"] else ""),
        f"  events: {report['events']:,} after binning; {rate['falling']:.1f} falling and {rate['rising']:.1f} rising "
        "per second",
    ]
    if report["found"] is not None:
        lines.append(f"  found: {counts_text(report['found'])}")
    broken = {kind: set(report[kind.replace("-", "_")]) for kind in RULES}
    for kind, taxels in broken.items():
        shown = ", ".join(map(str, sorted(taxels))) or "none"
        lines.append(f"  {kind} taxels: {shown} ({report['rules'][kind]})")
    if report["picture"] is not None:
        lines.append(f"  picture: {report['picture']}")
    rows = [
        [
            str(taxel),
            f"{one['falling']:.2f}",
            f"{one['rising']:.2f}",
            ", ".join(kind for kind, taxels in broken.items() if taxel in taxels),
        ]
        for taxel, one in enumerate(rate["taxels"])
    ]
    return "\n".join([*lines, "", table(["taxel", "falling/s", "rising/s", "looks"], rows)])


def _convert(arguments: Arguments) -> Outcome:
    lines = arguments.output.lower().endswith(".csv")
    if lines or arguments.output.lower().endswith(".zip"):
        require_place(arguments.output, "-o", arguments)
    bins = arguments.join
    require_bins(bins)
    count, places = _layout(arguments.taxels)
    present = tuple(SPLITS) if arguments.source == SYNTHETIC else data_splits(arguments.source)
    loaded = [_load(arguments.source, split, arguments.bin, count, places) for split in present or (arguments.split,)]
    for _, counts in loaded:
        show_notes(counts)
    loaded = [(joined_bins(recordings, bins), counts) for recordings, counts in loaded]
    taxels = max(recordings.taxels for recordings, _ in loaded)
    steps = max(recordings.steps for recordings, _ in loaded)
    if lines:
        write_event_lines(arguments.output, [recordings for recordings, _ in loaded], bins * arguments.bin)
    else:
        write_released(arguments.output, [_grown(recordings, taxels, steps) for recordings, _ in loaded])
    report = {
        "source": arguments.source,
        "output": arguments.output,
        "taxels": taxels,
        "steps": steps,
        "names": None if lines else SOURCES,
        "splits": {
            recordings.split: {
                "recordings": len(recordings),
                "found": None if counts is None else counts_json(counts, steps),
            }
            for recordings, counts in loaded
        },
    }
    return report, _convert_text, 0


def _convert_text(report: Json) -> str:
    lines = [f"{report['output']}: {number(report['taxels'], 'taxel')}, {number(report['steps'], 'bin')}"]
    for split, made in report["splits"].items():
        lines.append(f"  {split}: {number(made['recordings'], 'recording')}")
        if made["found"] is not None:
            lines.append(f"    found: {counts_text(made['found'])}")
    if report["names"] is not None:
        lines.append(f"  names: {report['names']} in it says which recording became which")
    return "\n".join(lines)


def _grown(recordings: Recordings, taxels: int, steps: int) -> Recordings:
    """Silence for the taxels and the time that only another split has."""
    events = np.zeros((len(recordings), taxels, 2, steps), dtype=np.uint8)
    events[:, : recordings.taxels, :, : recordings.steps] = recordings.events
    return Recordings(
        events=events,
        labels=recordings.labels,
        files=recordings.files,
        split=recordings.split,
        source=recordings.source,
    )


def _load(
    source: str, split: str, bin_s: float, taxels: int | None, places: FloatArray | None = None
) -> tuple[Recordings, EventCounts | None]:
    if source == SYNTHETIC:
        require_events(SYNTHETIC, bin_s)
        return (synthetic_split(split) if places is None else synthetic_split(split, coordinates=places)), None
    return load_data(source, split, bin_s=bin_s, taxels=taxels)


def _layout(taxels: str | None) -> tuple[int | None, FloatArray | None]:
    """Number of taxels and their positions, as far as ``--taxels`` says them."""
    return (None, None) if taxels is None else read_layout(taxels)


def _check_picture(path: str) -> None:
    """Refuse before the work, not after it."""
    if Path(path).suffix.lower() != ".png":
        raise OptionError(f"--picture {path}: allowed is a PNG; give a name that ends in .png")
