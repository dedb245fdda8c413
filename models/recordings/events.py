"""Recordings in any form that we read: the released layout, files of events or arrays, one of them, or a name.

Events are put into time bins of one width, and the bins of arrays joined to it. Nothing is corrected silently:
what came out of order, what fell on an event of the same taxel, polarity and bin, and long silences are counted. Each
recording counts for its own length.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.types import AnyArray, EventArray, IntArray
from spikeloom.models.recordings import evtouch
from spikeloom.models.recordings.arrays import Binned, bins_joined, one_width, read_binned
from spikeloom.models.recordings.classes import class_in_name, is_number, numbered
from spikeloom.models.recordings.conditions import group_notes, groups_of
from spikeloom.models.recordings.counts import GAP_S, EventCounts, time_note
from spikeloom.models.recordings.csvtable import NOTHING, Row, is_table, rows_beside
from spikeloom.models.recordings.eventfiles import EventStream, read_stream
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.models.recordings.fetch import DATA_SETS, find_data
from spikeloom.models.recordings.single import (
    Single,
    event_notes,
    silent_notes,
    unit_notes,
    width_notes,
)
from spikeloom.models.recordings.stored import EventFile, Stored

MAX_STEPS = 1_000_000

# Times typed in decimals fall on edges, and 0.58 / 0.02 is 28.999999999999996. Of a bin; three roundings of
# a quotient below MAX_STEPS are off by a third of it at most.
_EDGE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bins:
    """Which width bins are to have: as asked for, else as a network was trained on, else as stated beside arrays."""

    source: str
    asked: float | None
    default: float | None
    stated: float | None

    @property
    def of_events(self) -> float:
        """Seconds of a bin that events are put into."""
        return self.asked or self.default or self.stated or BIN_S


def load_data(
    path: str | os.PathLike[str],
    split: str = "test",
    *,
    bin_s: float | None = None,
    default_bin_s: float | None = None,
    taxels: int | None = None,
    classes: int | None = None,
    names: Sequence[str] | None = None,
    limit: int | None = None,
    groups: Sequence[str] | None = None,
) -> evtouch.Recordings:
    """Read the first `limit` recordings of a split, files in plain string order.

    The path is a folder or zip in the released layout; a folder or zip of ``.csv``, ``.npz`` and ``.npy``
    recordings, flat (it stands for any split) or with ``train/``, ``validation/`` and ``test/``; one such file; or
    the name of a fetched data set. `bin_s` is the width of a time bin in seconds, by default `default_bin_s`, which a
    network was trained on, or `BIN_S`; the bins of arrays are joined to it. `taxels` and `classes` are the network's,
    as are the `names` of classes; without `taxels` the highest with an event decides. Labels are `UNLABELLED`
    where nothing says them. An event file is as long as a table of recordings says, else until its last event; one
    without events, or an array without steps, of which no table says it, is as long as the others in the median.
    `groups` name columns of a table of recordings, or fields of file names; by default they are all columns that
    the table has beside file, label and length. In the released layout all recordings have labels and the same taxels.

    DataError if a recording cannot be used; OptionError if `bin_s` or `limit` cannot be.
    """
    _require_options(bin_s, limit)
    place = _place_of(path)
    source = place.name or str(place)
    with _data_set(place, split) as (members, splits):
        folder = _folder_of(split, splits, source)
        chosen = sorted(splits[folder].items())[:limit]
        files = [member for _, member in chosen]
        stated = evtouch.parse_width(source, members, files[0])
        bins = _Bins(source=source, asked=bin_s, default=default_bin_s, stated=stated)
        table = rows_beside(members, files, source)
        released = bool(folder) and all(name.lower().endswith(".npy") for name, _ in chosen)
        rows = [table.rows.get(member, NOTHING) for member in files]
        single = place.is_file() and files == [source]
        where = [source if single else f"{source}: {Path(folder, name).as_posix()}" for name, _ in chosen]
        read, file = _read_all(
            [(member, members[member]) for member in files], where, rows, bins, taxels, released=released
        )
    classes_read = [each.label for each in read]
    in_names = (
        _classes_in_names(splits) if classes_read == [class_in_name(name) for name, _ in chosen] else set()
    )
    labels, names = numbered(classes_read, {*table.classes, *in_names}, names, source)
    for each, label in zip(read, labels.tolist(), strict=True):
        evtouch.require_class(each.where, label, classes)
    width = one_width([each.bin_s for each in read], source)
    steps = _lengths(read, file, source)
    events = Stored(file, int(steps.max()))
    notes = [*table.notes, *silent_notes(read, source), *unit_notes(read)]
    notes += width_notes(read, [name for name, _ in chosen], source)
    data = evtouch.Recordings(
        held=events,
        labels=labels,
        names=names,
        files=tuple(name for name, _ in chosen),
        split=split,
        source=source,
        lengths=None if steps.min() == steps.max() else steps,
        bin_s=width,
        groups=groups_of(source, [name for name, _ in chosen], [row.groups for row in rows], groups),
    )
    notes += event_notes(data, read, taxels)
    notes += group_notes(source, [row.groups for row in rows]) if groups is None else []
    return data if released and not notes else replace(data, counts=_sum_counts(read, steps, notes))


def _classes_in_names(splits: Mapping[str, Mapping[str, str]]) -> set[str]:
    """Names of classes in those of the files of all splits: a part of them is numbered as all are."""
    classes = {class_in_name(name) for files in splits.values() for name in files}
    return {name for name in classes if name is not None and not is_number(name)}


def _require_options(bin_s: float | None, limit: int | None) -> None:
    """Refuse a width that no bin has, and no recordings."""
    if bin_s is not None and not (math.isfinite(bin_s) and bin_s > 0):
        raise OptionError(f"--bin {bin_s:g}: not a duration; give seconds above 0, for example {BIN_S:g}")
    if limit is not None and limit < 1:
        raise OptionError(f"--limit {limit}: at least 1 recording is needed; give a positive number")


def _folder_of(split: str, splits: Collection[str], source: str) -> str:
    """Where a split lies, or what stands for any; DataError if there is neither."""
    if split not in splits and "" not in splits:
        present = ", ".join(sorted(splits))
        fault = f"split {split!r} is missing or empty"
        raise DataError(f"{source}: {fault}; splits with recordings: {present}")
    return split if split in splits else ""


def _place_of(path: str | os.PathLike[str]) -> Path:
    """Where a data set lies, which may have been fetched by its name."""
    return find_data(str(path)) if str(path) in DATA_SETS else Path(path)


def _lengths(read: Sequence[Single], file: EventFile, source: str) -> IntArray:
    """Steps of each recording; refused if all, filled up with silence, are too large."""
    steps = np.array([each.steps for each in read], np.int64)
    if not steps.any():
        raise DataError(f"{source}: no events in any recording; check how they were written")
    steps[steps == 0] = round(float(np.median(steps[steps > 0])))
    size = math.prod(file.shape[:3]) * int(steps.max())
    evtouch.require_memory(source, size)
    evtouch.require_lively(source, size, sum(each.counts.events for each in read))
    return steps


def _sum_counts(read: Sequence[Single], steps: IntArray, notes: Sequence[str]) -> EventCounts:
    """Counts of all recordings together."""
    names = ("events", "out_of_order", "duplicates", "gaps")
    sums = {name: sum(getattr(each.counts, name) for each in read) for name in names}
    return EventCounts(**sums, shorter=int(np.count_nonzero(steps < steps.max())), notes=tuple(notes))


def _read_all(
    files: Sequence[tuple[str, Callable[[], IO[Any]]]],
    where: Sequence[str],
    rows: Sequence[Row],
    bins: _Bins,
    taxels: int | None,
    *,
    released: bool,
) -> tuple[list[Single], EventFile]:
    """All recordings, and their events; refused as soon as they are too large together."""
    read: list[Single] = []
    stored = EventFile()
    size = sent = 0
    for (name, opener), place, row in zip(files, where, rows, strict=True):
        single, grid = _read(name, opener, place, bins, taxels, row)
        _require_alike(single, read[0] if read else single, released)
        read.append(single)
        size += grid.size
        sent += single.counts.events
        evtouch.require_memory(bins.source, size)
        evtouch.require_lively(bins.source, size, sent)
        stored.append(grid)
    return read, stored


def _require_alike(read: Single, first: Single, released: bool) -> None:
    """Refuse other polarities than the first recording has; in the released layout other taxels, and no label."""
    if released and read.label is None:
        raise DataError(
            f"{read.where}: no label in the name, allowed is sample_N_label_L.npy; rename it, list it in "
            "recordings.csv, or remove it"
        )
    same = slice(0 if released else 1, 2)
    if read.shape[same] != first.shape[same]:
        raise DataError(
            f"{read.where}: shape {read.shape}, the recordings before it have {first.shape}; "
            "taxels and polarities of a split must agree"
        )


def require_events(where: str, bin_s: float | None, width: float = BIN_S) -> None:
    """Refuse a width of bins for what has bins already, of another width."""
    if bin_s not in (None, width):
        raise OptionError(f"--bin {bin_s:g}: {where} holds bins, not times; omit --bin")


SPLITS = ("train", "validation", "test")


def data_splits(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Splits that a data set has; none if it is flat or one recording, DataError if there are no recordings."""
    with _data_set(_place_of(path)) as (_, splits):
        return tuple(sorted(filter(None, splits)))


def need_labels(recordings: evtouch.Recordings, what: str) -> evtouch.Recordings:
    """Return the recordings if all have labels; else a DataError says `what` needs them, for example training."""
    missing = recordings.labels == evtouch.UNLABELLED
    if missing.any():
        file = recordings.files[int(np.argmax(missing))]
        raise DataError(
            f"{recordings.source}: {file}: no label, {what} needs one for every recording; "
            "add a label column, name the file like grasp_7_label_3.csv, or list it with its label in recordings.csv"
        )
    return recordings


def bin_events(
    stream: EventStream, bin_s: float = BIN_S, *, taxels: int | None = None
) -> tuple[EventArray, EventCounts]:
    """Put the events of one recording into bins.

    Bin ``k`` holds the times from ``k * bin_s`` to before the next; a time less than a billionth of a bin
    before an edge counts as on it, so that decimals fall where they say. The last bin holds the last event.

    Returns
    -------
    events : (taxels, 2, steps) uint8
        1 where there is at least one event; without `taxels` the highest with an event decides how many
        there are.
    counts : EventCounts
        For this recording.

    DataError if an event is later than `MAX_STEPS` bins.
    """
    latest = int(np.argmax(stream.time_s))
    last = float(stream.time_s[latest])
    first = float(stream.time_s.min())
    note = time_note(first, last, len(np.unique(stream.time_s)))
    if last / bin_s >= MAX_STEPS:
        remedy = (
            "write seconds"
            if note.endswith("seconds")
            else "count from the start of the recording or use wider bins"
        )
        raise DataError(
            f"{stream.at(latest)}: time {last:g} s is past {MAX_STEPS} bins of {bin_s:g} s, the limit of a recording; "
            f"{remedy}"
        )
    step = np.floor(stream.time_s / bin_s + _EDGE).astype(np.int64)
    steps = int(step.max()) + 1
    n = int(stream.taxel.max()) + 1 if taxels is None else taxels
    evtouch.require_memory(stream.name, n * 2 * steps, evtouch.MAX_FILE_BYTES)
    grid = np.zeros((n, 2, steps), dtype=np.uint8)
    grid[stream.taxel, stream.polarity, step] = 1
    sent = len(stream.time_s)
    return grid, EventCounts(
        events=sent,
        out_of_order=int(np.count_nonzero(stream.time_s < np.maximum.accumulate(stream.time_s))),
        duplicates=sent - int(np.count_nonzero(grid)),
        gaps=int(np.count_nonzero(np.diff(np.sort(stream.time_s)) > GAP_S)),
        notes=(note,) if note else (),
    )


def joined_bins(recordings: evtouch.Recordings, bins: int) -> evtouch.Recordings:
    """Recordings of which one bin was made of so many, with an event wherever one of theirs had one.

    The last bin of a recording may be made of fewer.
    """
    if bins == 1:
        return recordings
    lengths = None if recordings.lengths is None else -(-recordings.lengths // bins)
    return recordings.changed(
        -(-recordings.steps // bins), lambda events, _: join_bins(events, bins), lengths
    )


def join_bins(events: AnyArray, bins: int) -> AnyArray:
    """Events (..., steps) in bins as many times as long, (..., ceil(steps / bins)).

    Examples
    --------
    >>> join_bins(np.array([[0, 1, 0, 0, 1]], np.uint8), 2).tolist()
    [[1, 0, 1]]
    """
    if bins == 1:
        return events.copy()
    return np.maximum.reduceat(events, np.arange(0, events.shape[-1], bins), axis=-1)


def of_length(recordings: evtouch.Recordings, steps: int | None) -> evtouch.Recordings:
    """Recordings of so many steps each: shorter ones end in silence that counts, longer ones are cut; None: as is."""
    if steps is None:
        return recordings
    return recordings.changed(steps, lambda events, _: fitted(events, steps), None)


def fitted(events: AnyArray, steps: int) -> AnyArray:
    """Events (..., steps) cut to so many steps, or filled up with silence.

    Examples
    --------
    >>> fitted(np.array([[1, 1, 1]]), 2).tolist(), fitted(np.array([[1]]), 3).tolist()
    ([[1, 1]], [[1, 0, 0]])
    """
    missing = max(steps - events.shape[-1], 0)
    return np.pad(events[..., :steps], [(0, 0)] * (events.ndim - 1) + [(0, missing)])


@contextmanager
def _data_set(
    path: Path, split: str = "test"
) -> Iterator[tuple[evtouch.Members, dict[str, dict[str, str]]]]:
    """Openers of all files, and by split, ``""`` for any, their names and members; DataError if there are none."""
    source = path.name or str(path)
    if path.is_file():
        if path.suffix.lower() in evtouch.SUFFIXES:
            files = [path, *(each / evtouch.WIDTH for each in path.absolute().parents[:2])]
            beside = {file.name: partial(file.open, "rb") for file in reversed(files) if file.is_file()}
            yield beside, {"": {path.name: path.name}}
            return
        with path.open("rb") as file:
            if file.read(2) != b"PK":
                raise DataError(
                    f"{path}: not a recording; give a folder, a released zip, or a .csv, .npz or .npy file"
                )
    with evtouch.opened(path) as members:
        plain = {
            name: member
            for name, member in members.items()
            if not is_table(name) and PurePosixPath(name).name != evtouch.WIDTH
        }
        above: evtouch.Members = {}
        splits = evtouch.splits_of(source, plain, {*SPLITS, split})
        if not splits and (path.is_dir() or path.suffix.lower() == ".zip"):  # networks are zips, too
            splits = _flat(plain)
            width = path.absolute().parent / evtouch.WIDTH
            if path.is_dir() and width.is_file():  # the folder is a split, then, and it stands beside all
                above = {width.name: partial(width.open, "rb")}
        if not splits:
            raise DataError(
                f"{source}: no recordings (train/ or test/ with .csv, .npz or sample_N_label_L.npy); "
                "give the folder or zip that holds train/ and test/"
            )
        yield {**above, **members}, splits


def _flat(members: evtouch.Members) -> dict[str, dict[str, str]]:
    """Recordings that are in no split."""
    flat = {name: name for name in members if "/" not in name and not name.startswith(".")}
    return {"": flat} if flat else {}


def _read(
    name: str,
    opener: Callable[[], IO[Any]],
    where: str,
    bins: _Bins,
    taxels: int | None,
    row: Row,
) -> tuple[Single, EventArray]:
    """One recording, with what a table says of it, and its events."""
    binned = read_binned(name, opener, where, taxels)
    if binned is not None:
        found, grid = _rebinned(binned, where, bins, row.duration_s)
    else:
        stream = read_stream(name, taxels=taxels, where=where, opener=opener)
        found, grid = _from_events(stream, where, bins.of_events, taxels, row.duration_s)
    if row.label is None or found.label == row.label:
        return found, grid
    if found.label is not None:
        raise DataError(f"{where}: label {found.label}, and {row.label} in its table; fix one of them")
    return replace(found, label=row.label), grid


def _rebinned(
    binned: Binned, where: str, bins: _Bins, duration_s: float | None
) -> tuple[Single, EventArray]:
    """A recording from an array, in bins as wide as wanted; its table says how long it is where it has no steps."""
    own = binned.bin_s or bins.stated
    place = where if binned.bin_s else bins.source
    count, width = bins_joined(own, bins.asked, bins.default, place)
    grid = join_bins(binned.events, count) if count > 1 and binned.events.size else binned.events
    busy = np.flatnonzero(grid.any(axis=(0, 1)))
    counts = EventCounts(
        events=int(np.count_nonzero(binned.events)),
        out_of_order=0,
        duplicates=int(np.count_nonzero(binned.events)) - int(np.count_nonzero(grid)),
        gaps=int(np.count_nonzero((np.diff(busy) - 1) * (width or BIN_S) > GAP_S)),
    )
    steps = grid.shape[2] or _steps(duration_s or 0.0, width or BIN_S, where)
    return Single(where, grid.shape, binned.label, counts, steps, width, assumed=own is None), grid


def _from_events(
    stream: EventStream, where: str, bin_s: float, taxels: int | None, duration_s: float | None
) -> tuple[Single, EventArray]:
    """A recording from events, as long as its table says."""
    if len(stream.time_s):
        grid, counts = bin_events(stream, bin_s, taxels=taxels)
    else:
        grid = np.zeros((taxels or 1, 2, 0), np.uint8)
        counts = EventCounts(events=0, out_of_order=0, duplicates=0, gaps=0)
    steps = grid.shape[2]
    if duration_s is not None:
        last = float(stream.time_s.max(initial=0.0))
        steps = max(steps, _steps(duration_s, bin_s, where))
        if last > duration_s:
            raise DataError(
                f"{where}: an event at {last:g} s, its table says {duration_s:g} s; fix one of them"
            )
    return Single(where, grid.shape, stream.label, counts, steps, bin_s), grid


def _steps(duration_s: float, bin_s: float, where: str) -> int:
    """Bins of a recording that is so long."""
    if duration_s / bin_s > MAX_STEPS:
        raise DataError(
            f"{where}: {duration_s:g} s in its table are past {MAX_STEPS} bins of {bin_s:g} s; use wider bins"
        )
    return math.ceil(duration_s / bin_s - _EDGE)
