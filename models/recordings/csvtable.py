"""Small tables of numbers in CSV files: with or without a header, every fault named by its line.

A line holds numbers between commas. The first line may name the columns, in any order; without names they
stand in the order that the reader asks for. Blank lines, and what follows a ``#``, do not count.

A table of recordings, ``recordings.csv`` or ``labels.csv`` beside them, has columns ``file``, ``label`` and
``duration_s``; others are groups, such as the speed and the force of a touch.
"""

import csv
import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.files import plain, read_whole, reading, require_size
from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.classes import class_of
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.evtouch import Members

MAX_TABLE_BYTES = 256 << 20  # some 15 million events

TABLES = ("recordings.csv", "labels.csv")

_FILE = ("file", "filename", "name", "recording")
_LABEL = ("label", "class")
DURATION = "duration_s"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Columns of numbers and where they stood."""

    where: str  # The file, for messages
    columns: Mapping[str, FloatArray]  # Optional columns that the file does not have are absent
    words: Sequence[str] = ()  # Cells of a column that may hold words, and does
    lines: Sequence[int]  # Line of each row

    def at(self, row: int) -> str:
        """Place of a row, for messages: ``events.csv: line 7``."""
        return f"{self.where}: line {self.lines[row]}"


def read_table(
    path: str | os.PathLike[str],
    required: tuple[str, ...],
    optional: tuple[str, ...] = (),
    *,
    where: str | None = None,
    opener: Callable[[], IO[Any]] | None = None,
    empty: bool = False,
    words: str = "",
) -> Table:
    """Read a CSV file with these columns, whose order counts where the file does not name them; `where` names the file.

    What the `opener` opens is read in its place. The table has at least one row, unless it may be `empty` below its
    header; values may be infinite or NaN. The column `words` may hold words.

    DataError if the file cannot be read or is not such a table; the message names the line.
    """
    where = where or Path(path).name
    known = (*required, *optional)
    expected = ", ".join(required) + "".join(f"[, {name}]" for name in optional)
    lines, rows = _rows(read_text(opener or partial(_opened, Path(path)), where), known)
    names = tuple(_cells(rows[0].lower())) if rows else ()
    if names and not any(map(_is_number, names)):
        if not (set(required) <= set(names) <= set(known) and len(set(names)) == len(names)):
            raise DataError(
                f"{where}: line {lines[0]}: columns {plain(', '.join(names)[:99])}, expected are {expected}; "
                "name them so, separated by commas"
            )
        del lines[0], rows[0]
    elif rows and not len(required) <= len(names) <= len(known):
        raise DataError(
            f"{where}: {number(len(names), 'column')} in its first row, expected are {expected}; separate by commas"
        )
    else:
        names = known[: len(names)]
    if names and empty and not rows:
        return Table(where=where, columns={name: np.zeros(0) for name in names}, lines=[])
    if not rows:
        raise DataError(
            f"{where}: no rows, expected are lines of {expected}; check how the file was written"
        )
    try:
        values = np.loadtxt(rows, delimiter=",", ndmin=2)
    except ValueError:
        if words not in names:
            raise _fault(where, lines, rows, names) from None
        return _with_words(where, lines, rows, names, words)
    if values.shape[1] != len(names):
        raise _fault(where, lines, rows, names)
    columns = {name: np.ascontiguousarray(values[:, index]) for index, name in enumerate(names)}
    return Table(where=where, columns=columns, lines=lines)


def _with_words(
    where: str, lines: Sequence[int], rows: Sequence[str], names: tuple[str, ...], words: str
) -> Table:
    """A table of which one column holds words."""
    place = names.index(words)
    cells = [_cells(row) for row in rows]
    for line, row in zip(lines, cells, strict=True):
        if len(row) != len(names):
            raise _fault(where, [line], [",".join(row)], names)
    taken = [row.pop(place) for row in cells]
    others = names[:place] + names[place + 1 :]
    numbers = [",".join(row) for row in cells]
    try:
        values = np.loadtxt(numbers, delimiter=",", ndmin=2)
    except ValueError:
        raise _fault(where, lines, numbers, others) from None
    columns = {name: np.ascontiguousarray(values[:, index]) for index, name in enumerate(others)}
    return Table(where=where, columns=columns, lines=lines, words=taken)


def _opened(path: Path) -> IO[Any]:
    """A file, which is no pipe: these would be waited for."""
    return io.BytesIO(read_whole(path, "table", MAX_TABLE_BYTES))


def read_text(opener: Callable[[], IO[Any]], where: str) -> str:
    """A file of at most `MAX_TABLE_BYTES` as text, without a byte order mark; DataError if it cannot be read."""
    with reading(where, DataError, "save it as CSV in UTF-8"):
        with opener() as file:
            content: bytes = file.read(MAX_TABLE_BYTES + 1)
        require_size(len(content), "table", MAX_TABLE_BYTES)
        return content.decode("utf-8-sig")


def _rows(text: str, known: tuple[str, ...]) -> tuple[list[int], list[str]]:
    """Number and content of every line that counts; the names may stand in a comment, as numpy.savetxt writes them."""
    lines = list[int]()
    rows = list[str]()
    for at, line in enumerate(io.StringIO(text, newline=None), 1):
        content = line.partition("#")[0].strip()
        if not (content or rows):
            named = line.strip().lstrip("# \t")
            content = named if set(_cells(named.lower())) <= set(known) else ""
        if content:
            lines.append(at)
            rows.append(content)
    return lines, rows


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.split(",")]


def _fault(where: str, lines: Sequence[int], rows: Sequence[str], names: tuple[str, ...]) -> DataError:
    """Name the first line that is not a row of numbers."""
    for line, cells in zip(lines, map(_cells, rows), strict=True):
        if len(cells) != len(names):
            return DataError(
                f"{where}: line {line}: {number(len(cells), 'column')}, expected are {len(names)} "
                f"({', '.join(names)}); separate by commas"
            )
        for name, cell in zip(names, cells, strict=True):
            if not _is_number(cell):
                return DataError(
                    f"{where}: line {line}: {name} is {cell[:40]!r}, not a number; write plain numbers"
                )
    raise AssertionError("rows of numbers are a table")


def _is_number(cell: str) -> bool:
    """Whether numpy reads it: Python's float also takes underscores and foreign digits."""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def is_table(name: str) -> bool:
    """Whether a file is such a table, by its name."""
    return PurePosixPath(name).name.lower() in TABLES


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What a table says of a recording: its class and its length in seconds, if it says so, and its groups."""

    label: str | None
    duration_s: float | None
    groups: dict[str, str]


NOTHING = Row(label=None, duration_s=None, groups={})


def _read_rows(opener: Callable[[], IO[Any]], where: str) -> dict[str, Row] | None:
    """Rows by name of file of a table of recordings; None if it is another kind of table."""
    text = read_text(opener, where)
    with reading(where, DataError, "save it as CSV in UTF-8"):
        rows = list(csv.reader(io.StringIO(text, newline="")))
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    files = [index for index, name in enumerate(header) if name in _FILE]
    classes = [name for name in header if name in _LABEL]
    if len(files) != 1 or len(classes) > 1:
        return None
    known: dict[str, Row] = {}
    for line, cells in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        here = f"{where}: row {line}"
        groups = dict(zip(header, (cell.strip() for cell in cells), strict=False))
        name = groups.pop(header[files[0]])
        if not name or len(cells) < len(header) or any(cell.strip() for cell in cells[len(header) :]):
            raise DataError(f"{here}: {cells[:4]}; give a file, and one value in each column")
        row = Row(
            label=_class(groups.pop(classes[0]), here) if classes else None,
            duration_s=_seconds(groups.pop(DURATION, ""), here),
            groups=groups,
        )
        if known.setdefault(name, row) != row:
            raise DataError(f"{here}: {name} stands there twice; keep one of the rows")
    return known


def _class(text: str, where: str) -> str:
    """A class; DataError if it is none."""
    name = class_of(text)
    if name is None:
        raise DataError(f"{where}: label {text[:40]!r}; give numbers from 0, or names, in all rows")
    return name


def _seconds(text: str, where: str) -> float | None:
    """Length of a recording, if there is one; DataError if it is no length."""
    if not text:
        return None
    seconds = float(text) if _is_number(text) else math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise DataError(f"{where}: {DURATION} is {text[:40]!r}; give seconds above 0, or nothing")
    return seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """What tables say: rows by recording, all classes that they know, and a note on each table."""

    rows: Mapping[str, Row]
    classes: frozenset[str]
    notes: list[str]


def rows_beside(members: Members, files: Sequence[str], source: str) -> Listed:
    """Rows of tables at the top of a data set, beside its splits or its `files`, which are named as `members` are."""
    known: dict[str, Row] = {}
    classes: set[str] = set()
    notes = []
    parents = {PurePosixPath(file).parent: None for file in files}
    folders = dict.fromkeys([PurePosixPath(), *(folder.parent for folder in parents), *parents])
    for folder in folders:
        here: dict[str, Row] = {}
        for table in sorted(
            name for name in members if is_table(name) and PurePosixPath(name).parent == folder
        ):
            where = f"{source}: {table}"
            rows = _read_rows(members[table], where)
            if rows is None:
                notes.append(f"{where}: is not read; a table of recordings has columns file and label")
                continue
            inside = [file for file in files if PurePosixPath(file).is_relative_to(folder)]
            found = {file: row for file in inside for row in _rows_of(rows, PurePosixPath(file), folder)}
            for file, row in found.items():
                _require_alike(here.get(file, NOTHING), row, f"{where}: {file}")
                here[file] = _with(here.get(file, NOTHING), row)
            classes |= {row.label for row in rows.values() if row.label is not None}
            if len(found) < len(files):
                notes.append(f"{where}: describes {len(found)} of {len(files)} recordings")
        known |= {file: _with(known.get(file, NOTHING), row) for file, row in here.items()}
    return Listed(rows=known, classes=frozenset(classes), notes=notes)


def _with(known: Row, row: Row) -> Row:
    """What two tables say of a recording: where both do, the second, which is nearer to it."""
    return Row(
        label=known.label if row.label is None else row.label,
        duration_s=known.duration_s if row.duration_s is None else row.duration_s,
        groups=row.groups | known.groups | {name: value for name, value in row.groups.items() if value},
    )


def _require_alike(known: Row, row: Row, where: str) -> None:
    """Refuse two tables side by side that contradict each other: DataError."""
    first, second = (
        {"label": each.label, DURATION: each.duration_s, **each.groups} for each in (known, row)
    )
    for name in first.keys() & second.keys():
        if first[name] != second[name] and not {None, ""} & {first[name], second[name]}:
            words = f"{name} is {second[name]!r} here and {first[name]!r} in the table beside it"
            raise DataError(f"{where}: {words}; keep one of them")


def _rows_of(rows: Mapping[str, Row], file: PurePosixPath, folder: PurePosixPath) -> list[Row]:
    """The row of a recording, by its path from the table or else its name, if there is one."""
    names = (file.relative_to(folder).as_posix(), file.name)
    return [rows[name] for name in names if name in rows][:1]
