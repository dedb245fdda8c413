"""Files of single events: CSV or npz with ``time_s``, ``taxel``, ``polarity`` and perhaps ``label``.

Times are seconds from the start of the recording, in any order. Polarity is 1 for rising and 0 or -1 for
falling, one code per file. The label is the class of the whole recording: one constant, or part of a file
name such as ``grasp_7_label_3.csv``.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.models.graphs import MAX_TAXELS
from spikeloom.models.recordings.csvtable import read_table
from spikeloom.models.recordings.evtouch import UNLABELLED, label_in_name, opened, parse_npy

MAX_LABEL = 999_999

_REQUIRED = ("time_s", "taxel", "polarity")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EventStream:
    """The events of one recording, as they came."""

    name: str  # Of the file
    time_s: FloatArray  # (events,) float64; seconds from the start of the recording, 0 or more, in any order
    taxel: IntArray  # (events,) int64; below `MAX_TAXELS`
    polarity: EventArray  # (events,) uint8; 1 for rising, 0 for falling
    label: int  # Class of the recording, `UNLABELLED` where nothing says it
    at: Callable[[int], str]  # Place of an event by its index, for messages


def read_stream(
    path: str | os.PathLike[str], *, taxels: int | None = None, where: str | None = None
) -> EventStream:
    """Read a ``.csv`` or a ``.npz`` of one-dimensional arrays, whose ``label`` may be one number.

    DataError if the file cannot be read, or holds an event that a sensor of so many `taxels` does not
    send; the message names the event.
    """
    path = Path(path)
    where = where or path.name
    if path.suffix.lower() == ".csv":
        table = read_table(path, _REQUIRED, ("label",), where=where, empty=True)
        columns: Mapping[str, FloatArray] = table.columns
        at: Callable[[int], str] = table.at
    else:
        columns, at = _read_npz(path, where)
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
        label=_label(where, path.name, columns.get("label")),
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


def _label(where: str, name: str, column: FloatArray | None) -> int:
    """Class of the recording, from its column or its name."""
    named = label_in_name(name)
    if column is None or not column.size:
        return named
    first = float(column[0])
    if not (0 <= first <= MAX_LABEL and first.is_integer()):
        raise DataError(
            f"{where}: label {first:g}, allowed are whole numbers 0..{MAX_LABEL}; number the classes"
        )
    other = column != first
    if other.any():
        raise DataError(
            f"{where}: labels {first:g} and {column[other][0]:g} in one file, allowed is one; "
            "write one file for each recording"
        )
    if named not in (UNLABELLED, first):
        raise DataError(f"{where}: label {first:g} in the file and {named} in its name; fix one of them")
    return int(first)


def _read_npz(path: Path, where: str) -> tuple[Mapping[str, FloatArray], Callable[[int], str]]:
    """Columns of an npz."""
    columns: dict[str, FloatArray] = {}
    with opened(path) as members:
        for name in (*_REQUIRED, "label"):
            if member := members.get(f"{name}.npy"):
                columns[name] = parse_npy(f"{where}: {name}", member).astype(np.float64)
        if missing := [name for name in _REQUIRED if name not in columns]:
            names = ", ".join(sorted(member.removesuffix(".npy") for member in members)) or "nothing"
            raise DataError(
                f"{where}: holds {names}, without {', '.join(missing)}; name the arrays {', '.join(_REQUIRED)}[, label]"
            )
    shapes = {name: columns[name].shape for name in _REQUIRED}
    if len(set(shapes.values())) > 1 or columns["time_s"].ndim != 1:
        shown = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(
            f"{where}: shapes {shown}, allowed is one number per event in each; save flat arrays"
        )
    if "label" in columns:
        columns["label"] = columns["label"].reshape(-1)
    return columns, lambda row: f"{where}: event {row}"
