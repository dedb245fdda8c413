"""Files of single events: CSV or npz with ``time_s``, ``taxel``, ``polarity`` and perhaps ``label``.

Times are seconds from the start of the recording, in any order. Polarity is 1 for rising and 0 or -1 for
falling, one code per file. The label is the class of the whole recording: one constant, or part of a file
name such as ``grasp_7_label_3.csv``.
"""

import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.files import plain
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.models.graphs import MAX_TAXELS
from spikeloom.models.recordings.classes import class_in_name, class_of
from spikeloom.models.recordings.csvtable import read_table
from spikeloom.models.recordings.evtouch import MAX_FILE_BYTES, Members, parse_npy, read_limited, unzipped

MAX_LABEL = 999_999

MAX_NPZ_BYTES = 4 * MAX_FILE_BYTES
"""Of its file; each array is limited by itself."""

Opener = Callable[[], IO[Any]]

_REQUIRED = ("time_s", "taxel", "polarity")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EventStream:
    """The events of one recording, as they came."""

    name: str  # Of the file
    time_s: FloatArray  # (events,) float64; seconds from the start of the recording, 0 or more, in any order
    taxel: IntArray  # (events,) int64; below `MAX_TAXELS`
    polarity: EventArray  # (events,) uint8; 1 for rising, 0 for falling
    label: str | None  # Class of the recording, None where nothing says it
    at: Callable[[int], str]  # Place of an event by its index, for messages


def read_stream(
    path: str | os.PathLike[str],
    *,
    taxels: int | None = None,
    where: str | None = None,
    opener: Opener | None = None,
) -> EventStream:
    """Read a ``.csv`` or a ``.npz`` of one-dimensional arrays, whose ``label`` may be one number or name.

    The `opener` opens what the path names, where that is in a zip.

    DataError if the file cannot be read, or holds an event that a sensor of so many `taxels` does not
    send; the message names the event.
    """
    path = Path(path)
    where = where or path.name
    opener = opener or partial(path.open, "rb")
    label: FloatArray | Sequence[str]
    if path.suffix.lower() == ".csv":
        table = read_table(
            path, _REQUIRED, ("label",), where=where, opener=opener, empty=True, words="label"
        )
        columns: Mapping[str, FloatArray] = table.columns
        label = table.words or columns.get("label", NOTHING)
        at: Callable[[int], str] = table.at
    else:
        arrays = unzipped(where, npz_file(where, opener))
        columns = _columns(arrays, where)
        label = label_array(arrays, where)

        def at(row: int) -> str:
            return f"{where}: event {row}"

    time_s = columns["time_s"]
    taxel = columns["taxel"]
    wrong = ~(np.isfinite(time_s) & (time_s >= 0))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"{at(row)}: time {time_s[row]:g} s, allowed are finite times from 0; count from the start of the recording"
        )
    most = MAX_TAXELS if taxels is None else taxels
    wrong = ~((taxel >= 0) & (taxel < most) & (taxel == np.floor(taxel)))  # true for NaN too
    if wrong.any():
        row = int(np.argmax(wrong))
        from_one = taxel.min(initial=MAX_TAXELS) == 1 and taxel.max() == taxels  # false for NaN
        remedy = ", they seem to count from 1" if from_one else " and use recordings of this sensor"
        raise DataError(
            f"{at(row)}: taxel {taxel[row]:g}, allowed are whole numbers 0..{most - 1}; count from 0{remedy}"
        )
    return EventStream(
        name=path.name,
        time_s=time_s,
        taxel=taxel.astype(np.int64),
        polarity=_polarity(where, columns["polarity"], at),
        label=class_in(where, path.name, label),
        at=at,
    )


def _polarity(where: str, values: FloatArray, at: Callable[[int], str]) -> EventArray:
    """1 for rising, 0 for falling, from either code."""
    low = values == -1
    zero = values == 0
    high = values == 1
    wrong = ~(low | zero | high)
    codes = "allowed are 0 and 1, or -1 and 1"
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(f"{at(row)}: polarity {values[row]:g}, {codes}; 1 is rising")
    if low.any() and zero.any():
        raise DataError(f"{where}: polarities -1 and 0 in one file, {codes}; write one code")
    return np.asarray(high.astype(np.uint8))


NOTHING: FloatArray = np.zeros(0)
"""No label."""


def class_in(where: str, name: str, found: FloatArray | Sequence[str]) -> str | None:
    """Class of the recording, from its column or its name."""
    named = class_in_name(name)
    if not len(found):
        return named
    words = list(dict.fromkeys(each if isinstance(each, str) else f"{each:g}" for each in found))
    if len(words) > 1:
        raise DataError(
            f"{where}: labels {plain(words[0][:60])} and {plain(words[1][:60])} in one file, allowed is one; "
            "write one file for each recording"
        )
    label = class_of(words[0])
    if label is None:
        raise DataError(
            f"{where}: label {words[0]}, allowed are whole numbers 0..{MAX_LABEL}; number the classes, or name them"
        )
    if named not in (None, label):
        raise DataError(f"{where}: label {label} in the file and {named} in its name; fix one of them")
    return label


def npz_file(where: str, opener: Opener) -> IO[bytes]:
    """An npz in memory; DataError if it has more than `MAX_NPZ_BYTES`, or cannot be read."""
    return io.BytesIO(read_limited(where, opener, MAX_NPZ_BYTES))


def label_array(arrays: Members, where: str) -> FloatArray | Sequence[str]:
    """The array ``label`` of an npz, of numbers or of words; empty where there is none."""
    member = arrays.get("label.npy")
    if member is None:
        return NOTHING
    values = parse_npy(f"{where}: label", member, "biufU").reshape(-1)
    return [str(each) for each in values] if values.dtype.kind == "U" else values.astype(np.float64)


def _columns(arrays: Members, where: str) -> dict[str, FloatArray]:
    """Columns of an npz of events."""
    columns: dict[str, FloatArray] = {}
    for name in _REQUIRED:
        if member := arrays.get(f"{name}.npy"):
            columns[name] = parse_npy(f"{where}: {name}", member).astype(np.float64)
    if missing := [name for name in _REQUIRED if name not in columns]:
        names = ", ".join(sorted(name.removesuffix(".npy") for name in arrays)) or "nothing"
        raise DataError(
            f"{where}: holds {names}, without {', '.join(missing)}; name the arrays {', '.join(_REQUIRED)}[, label], "
            "or save one array (steps, taxels[, polarities])"
        )
    shapes = {name: columns[name].shape for name in _REQUIRED}
    if len(set(shapes.values())) > 1 or columns["time_s"].ndim != 1:
        shown = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(
            f"{where}: shapes {shown}, allowed is one number per event in each; save flat arrays"
        )
    return columns


def is_events(arrays: Members) -> bool:
    """Whether an npz holds events, or what was meant to be some: not one array beside label and width of a bin."""
    names = {name.removesuffix(".npy") for name in arrays}
    return bool(names & set(_REQUIRED)) or len(names - {"label", "bin_s"}) != 1
