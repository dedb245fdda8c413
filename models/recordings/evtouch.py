"""Recordings in one array, and the layout of the released ones: folders, zips and npy files, checked.

The layout is ``train/`` and ``test/`` with files ``sample_N_label_L.npy``, possibly inside one top folder. A
recording is (taxels, polarities, steps), values 0 and 1; of two polarities, 1 is the rising one (it leads at
first contact).
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, Self, SupportsIndex, overload

import numpy as np

from spikeloom.compiler.archive import arrays_digest, opened_zip, read_npy
from spikeloom.compiler.arrays import frozen
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.files import reading
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, IntArray
from spikeloom.models.recordings.counts import EventCounts, number
from spikeloom.models.recordings.stored import Change, Stored

MAX_POLARITIES = 8
"""Most polarities of a taxel; an array with more has its axes in another order."""

MAX_TOTAL_BYTES = 2 << 30
MAX_FILE_BYTES = 64 << 20  # the released recordings have 0.1 MB

MAX_SILENT_BYTES = 256 << 20
"""Most bytes of bins that hold no event, beside `EVENT_BYTES` for each event: a small file may announce many."""

EVENT_BYTES = 4096

PART_BYTES = 16 << 20
"""Bytes of bins that are looked at together."""

BIN_S = 0.02
"""Width of a bin in seconds, as in the released recordings."""

UNLABELLED = -1

SUFFIXES = (".npy", ".npz", ".csv")
"""Suffixes of files that hold a recording: bins, or else events."""

WIDTH = "bins.npy"
"""File beside the splits that holds one number, seconds of a bin; the released recordings have none."""

_GIVE = "give the folder or zip that holds train/ and test/"

Members = Mapping[str, Callable[[], IO[Any]]]


def called(label: int, names: Sequence[str] | None) -> str:
    """Name of a class; its number where it has none, as of a network with more classes than the recordings name."""
    return names[label] if names is not None and 0 <= label < len(names) else str(label)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recordings:
    """Event recordings of one split, in one array: shorter ones are filled up with silence that does not count."""

    # (samples, taxels, polarities, steps) uint8; 1 where a taxel sent an event of that polarity in that
    # step; an array is C-contiguous and read-only
    held: EventArray | Stored
    labels: IntArray  # (samples,) int64; class of each recording, or `UNLABELLED`; read-only
    files: tuple[str, ...]  # File name of each recording
    split: str  # For example ``test``
    source: str  # Name of the folder, zip or generator
    # (samples,) int64, or None; steps of each recording; read-only. None where all have as many as the
    # array, as in the released layout.
    lengths: IntArray | None = None
    counts: EventCounts | None = None  # Anomalies of their events; None where they had bins already
    bin_s: float | None = None  # Seconds of a bin, where somebody said so; of those before any were joined
    names: tuple[str, ...] | None = None  # Of classes, where their numbers do not say all
    # Value of each recording by group, see :mod:`models.recordings.conditions`
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("held", "labels", "lengths"):
            array = getattr(self, name)
            if isinstance(array, np.ndarray):
                object.__setattr__(self, name, frozen(np.ascontiguousarray(array).view()))

    def __repr__(self) -> str:
        """One line instead of the arrays."""
        size = f"{number(len(self), 'recording')}, {number(self.taxels, 'taxel')}"
        return f"{self.source}, {self.split}: {size}, up to {number(self.steps, 'step')}"

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self.files)

    @overload
    def __getitem__(self, index: SupportsIndex) -> tuple[EventArray, int]: ...

    @overload
    def __getitem__(self, index: slice) -> Self: ...

    def __getitem__(self, index: SupportsIndex | slice) -> tuple[EventArray, int] | Self:
        """Events (taxels, polarities, steps) of one recording, as long as it is, and its label; or a slice of all."""
        if isinstance(index, slice):
            return self.part(index)
        place = range(len(self))[index]
        return self.held[place : place + 1][0, ..., : self.steps_of(place)], int(self.labels[place])

    def __iter__(self) -> Iterator[tuple[EventArray, int]]:
        """Events and label of each recording."""
        return map(self.__getitem__, range(len(self)))

    @property
    def events(self) -> EventArray:
        """All of them in memory."""
        return self.held.whole if isinstance(self.held, Stored) else self.held

    @property
    def seconds(self) -> float:
        """Seconds of a bin, by default ``BIN_S``."""
        return BIN_S if self.bin_s is None else self.bin_s

    @property
    def taxels(self) -> int:
        """Taxels of each recording."""
        return int(self.held.shape[1])

    @property
    def steps(self) -> int:
        """Time steps of the longest recording."""
        return int(self.held.shape[3])

    @property
    def step_counts(self) -> IntArray:
        """Time steps of each recording; (samples,) int64."""
        return np.full(len(self), self.steps) if self.lengths is None else self.lengths

    def class_name(self, label: int) -> str:
        """What a class is called; its number, where it has no name."""
        return called(label, self.names)

    def steps_of(self, index: int) -> int:
        """Time steps of one recording."""
        return int(self.step_counts[index])

    def part(self, chosen: slice | AnyArray, split: str | None = None) -> Self:
        """Some of the recordings, by indices, truth values or a slice; of another `split` if it has a name."""
        indices = np.arange(len(self))[chosen]
        return replace(
            self,
            held=self.held[chosen] if isinstance(chosen, slice) else self.events[chosen],
            labels=self.labels[chosen],
            files=tuple(self.files[index] for index in indices),
            split=split or self.split,
            lengths=None if self.lengths is None else self.lengths[chosen],
            groups={name: tuple(values[index] for index in indices) for name, values in self.groups.items()},
        )

    def parts(self) -> Iterator[Self]:
        """All recordings, as many at a time as `PART_BYTES` hold."""
        size = max(1, PART_BYTES // max(1, math.prod(self.held.shape[1:])))
        return (self.part(slice(first, first + size)) for first in range(0, len(self), size))

    def changed(self, steps: int, change: Change, lengths: IntArray | None) -> Self:
        """The same recordings with other events, of so many steps, and lengths."""
        events = self.held
        if isinstance(events, Stored):
            return replace(self, held=events.changed(steps, change), lengths=lengths)
        return replace(self, held=change(events, range(len(self))), lengths=lengths)

    def identity(self) -> dict[str, Any]:
        """Arrays that tell these recordings from others, whatever their names."""
        arrays: dict[str, Any] = {"events": self.held, "labels": self.labels}
        return arrays if self.lengths is None else arrays | {"lengths": self.lengths}

    @property
    def sha256(self) -> str:
        """Hash over them, whatever their names."""
        return arrays_digest(self.identity())

    @property
    def events_sha256(self) -> str:
        """Hash over their events, whatever their labels and names."""
        return arrays_digest({name: each for name, each in self.identity().items() if name != "labels"})


@contextmanager
def opened(path: Path) -> Iterator[Members]:
    """What opens each file of recordings in a folder or zip, by its name with slashes; folders two levels deep.

    DataError if there is no such folder or zip, or the zip announces more than `MAX_TOTAL_BYTES`.
    """
    if path.is_dir():
        files = [file for depth in ("*", "*/*", "*/*/*") for file in path.glob(depth) if file.is_file()]
        names = {
            file.relative_to(path).as_posix(): file for file in files if file.suffix.lower() in SUFFIXES
        }
        yield {name: partial(file.open, "rb") for name, file in names.items()}
        return
    if not path.is_file():
        raise DataError(f"{path}: no such folder or file; {_GIVE}")
    with path.open("rb") as file:
        yield unzipped(path.name, file)


def unzipped(name: str, file: IO[bytes]) -> Members:
    """What opens each file of recordings in an open zip of that name; DataError as of :func:`opened`."""
    with reading(name, DataError, f"{_GIVE}, or copy it again"):
        archive = opened_zip(file)
        infos = [info for info in archive.infolist() if Path(info.filename).suffix.lower() in SUFFIXES]
    # no more than that is ever decompressed
    require_memory(name, sum(info.file_size for info in infos))
    return {info.filename: partial(archive.open, info) for info in infos}


def splits_of(source: str, members: Members, splits: set[str]) -> dict[str, dict[str, str]]:
    """Map split to file name to member name, for the one data set among `members`; DataError if there are several."""
    by_split: dict[str, dict[str, str]] = {}
    roots: set[str] = set()
    for member in members:
        *top, split, name = ("", *member.split("/"))
        if len(top) > 2 or split not in splits or "__MACOSX" in top or name.startswith("."):
            continue
        roots.add("/".join(filter(None, top)) or ".")
        by_split.setdefault(split, {})[name] = member
    if len(roots) > 1:
        raise DataError(f"{source}: several data sets ({', '.join(sorted(roots))}); give one of them")
    return by_split


def read_limited(where: str, opener: Callable[[], IO[Any]], limit: int) -> bytes:
    """Content of a file of at most `limit` bytes; DataError if it has more, or cannot be read."""
    with reading(where, DataError, "copy or download it again"):
        with opener() as file:
            data: bytes = file.read(limit + 1)
        if len(data) > limit:
            raise DataError(f"more than {limit} bytes, the limit of a recording; split it")
    return data


def parse_npy(where: str, opener: Callable[[], IO[Any]], kinds: str = "biuf") -> AnyArray:
    """Numbers or truth values of an npy file of at most `MAX_FILE_BYTES`; DataError if it is none."""
    data = read_limited(where, opener, MAX_FILE_BYTES)
    with reading(where, DataError, "copy or download it again"):
        values: AnyArray = read_npy(data)
    if values.dtype.kind not in kinds:
        raise DataError(f"{where}: dtype {values.dtype.str!r}, allowed are numbers; convert it")
    return values


def parse_width(source: str, members: Members, recording: str) -> float | None:
    """Seconds of a bin that stand beside a `recording`, or beside its split, if any do; DataError if they are none."""
    folder = PurePosixPath(recording).parent
    where = next(
        (name for each in (folder, folder.parent) if (name := (each / WIDTH).as_posix()) in members), None
    )
    return None if where is None else seconds_in(f"{source}: {where}", members[where])


def seconds_in(where: str, opener: Callable[[], IO[Any]]) -> float:
    """Seconds of a bin in an npy file; DataError if they are none."""
    seconds = parse_npy(where, opener).ravel()
    if len(seconds) != 1 or not (math.isfinite(seconds[0]) and seconds[0] > 0):
        raise DataError(f"{where}: allowed is one number, seconds of a bin; convert the events again")
    return float(seconds[0])


def other_taxels(found: int, wanted: int) -> str:
    """Message about recordings of another sensor."""
    remedy = "use recordings of its sensor, or train on these with --taxels"
    return f"has {found} taxels, the network has {wanted}; {remedy}"


def require_bins(where: str, values: AnyArray, taxels: int | None) -> EventArray:
    """An array as events (taxels, polarities, steps); DataError if it is anything else, or not of the `taxels`."""
    shape = values.shape
    if len(shape) != 3 or 0 in shape[:2] or shape[1] > MAX_POLARITIES:
        raise DataError(
            f"{where}: shape {shape}, allowed is (taxels, polarities, steps); one recording per file"
        )
    if taxels is not None and shape[0] != taxels:
        raise DataError(f"{where}: {other_taxels(shape[0], taxels)}")
    values = values.view(np.uint8) if values.dtype == np.bool_ else values  # a byte of 2 is no truth value
    events: BoolArray = values != 0  # NaN becomes an event here and differs from 1 below
    wrong = values != events
    if wrong.any():
        taxel, polarity, step = (int(index) for index in np.argwhere(wrong)[0])
        raise DataError(
            f"{where}: value {values[taxel, polarity, step]:g} at taxel {taxel}, polarity {polarity}, step {step}, "
            "allowed are 0 and 1; recordings are events, not pressures"
        )
    return events.view(np.uint8)


def require_memory(source: str, size: int, limit: int | None = None) -> None:
    """Refuse a data set that would fill the memory, or a recording of more than its own `limit`."""
    if size > (limit or MAX_TOTAL_BYTES):
        what, remedy = (
            ("recordings", "the data set") if limit is None else ("a recording", "it, or use wider bins")
        )
        raise DataError(
            f"{source}: {what} of {size} bytes, limit {limit or MAX_TOTAL_BYTES}; split {remedy}"
        )


def require_lively(source: str, size: int, events: int) -> None:
    """Refuse recordings of so many bytes that hardly hold events: a DataError."""
    if size > MAX_SILENT_BYTES + EVENT_BYTES * events:
        raise DataError(
            f"{source}: {number(events, 'event')} in {size} bytes of bins, limit {MAX_SILENT_BYTES} and {EVENT_BYTES} "
            "for each; leave out silent recordings, or use wider bins"
        )


def require_class(where: str, label: int, classes: int | None) -> None:
    """Refuse a label that the network has no class for."""
    if classes is not None and label >= classes:
        raise DataError(
            f"{where}: label {label}, the network has {classes} classes (0..{classes - 1}); "
            "use the network that was trained on these objects"
        )


def require_polarities(recordings: Recordings) -> None:
    """Refuse events that are neither falling nor rising: of another number of polarities than two; a DataError."""
    if recordings.held.shape[2] != 2:
        polarities = recordings.held.shape[2]
        raise DataError(
            f"{recordings.source}: has {polarities} polarities, allowed are falling and rising; choose another"
        )


def data_digest(training: Recordings, test: Recordings) -> str:
    """Hash over both splits, whatever their names."""
    splits = {"train": training, "test": test}
    names = {"events": "", "labels": "_labels", "lengths": "_lengths"}
    return arrays_digest(
        {
            f"{split}{names[key]}": array
            for split, data in splits.items()
            for key, array in data.identity().items()
        }
    )


WHOLE = 100
"""A whole recording, in per cent."""


def parse_window(words: str) -> int:
    """Per cent of each recording, a whole number from 1 to 100, from the words of ``--window``.

    Examples
    --------
    >>> parse_window("25%"), parse_window("100")
    (25, 100)
    """
    match = re.fullmatch(r"([0-9]{1,3})%?", words.strip(), re.ASCII)
    if match is None or not 1 <= int(match[1]) <= WHOLE:
        raise OptionError(
            f"--window {words}: not a part of a recording; give whole per cent from 1% to 100%"
        )
    return int(match[1])


def steps_of(lengths: IntArray, percent: int) -> IntArray:
    """Whole steps of a part of each recording, one at least.

    Examples
    --------
    >>> steps_of(np.array([325, 3, 1]), 50).tolist()
    [162, 1, 1]
    """
    return np.maximum(lengths * percent // WHOLE, 1)


def first_part(recordings: Recordings, percent: int) -> Recordings:
    """The first steps of every recording, so many per cent of its own length; labels, names and order stay."""
    if percent == WHOLE:
        return recordings
    lengths = recordings.step_counts
    kept = steps_of(lengths, percent)
    longest = int(kept.max(initial=0))
    if recordings.lengths is None:
        return recordings.changed(longest, lambda events, _: events[..., :longest], None)

    def cut(events: EventArray, rows: range) -> EventArray:
        # what is joined to a later step, or run on, must not bring back what was cut off
        inside = np.arange(longest) < kept[np.array(rows), None, None, None]
        return events[..., :longest] * inside

    return recordings.changed(longest, cut, kept)
