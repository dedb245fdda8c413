"""Small tables of numbers in CSV files: with or without a header, every fault named by its line.

A line holds numbers between commas. The first line may name the columns, in any order; without names they
stand in the order that the reader asks for. Blank lines, and what follows a ``#``, do not count.

A table of recordings, ``recordings.csv`` or ``labels.csv`` beside them, has columns ``file`` and ``label``; others are
groups, such as the speed and the force of a touch.
"""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.files import plain, read_whole, reading
from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.counts import number

MAX_TABLE_BYTES = 256 << 20  # some 15 million events

TABLES = ("recordings.csv", "labels.csv")

_FILE = ("file", "filename", "name", "recording")
_LABEL = ("label", "class")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Columns of numbers and where they stood."""

    where: str  # The file, for messages
    columns: Mapping[str, FloatArray]  # Optional columns that the file does not have are absent
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
    empty: bool = False,
) -> Table:
    """Read a CSV file with these columns, whose order counts where the file does not name them; `where` names the file.

    The table has at least one row, unless it may be `empty` below its header; values may be infinite or NaN.

    DataError if the file cannot be read or is not such a table; the message names the line.
    """
    where = where or Path(path).name
    known = (*required, *optional)
    expected = ", ".join(required) + "".join(f"[, {name}]" for name in optional)
    lines, rows = _rows(read_text(Path(path), where), known)
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
        raise _fault(where, lines, rows, names) from None
    if values.shape[1] != len(names):
        raise _fault(where, lines, rows, names)
    columns = {name: np.ascontiguousarray(values[:, index]) for index, name in enumerate(names)}
    return Table(where=where, columns=columns, lines=lines)


def read_text(path: Path, where: str) -> str:
    """A file of at most `MAX_TABLE_BYTES` as text, without a byte order mark; DataError if it cannot be read."""
    with reading(where, DataError, "save it as CSV in UTF-8"):
        return read_whole(path, "table", MAX_TABLE_BYTES).decode("utf-8-sig")


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


def is_table(file: Path) -> bool:
    """Whether a file is such a table, by its name."""
    return file.name.lower() in TABLES


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What a table says of a recording: its class, if it says so, and its groups."""

    label: int | None
    groups: dict[str, str]


NOTHING = Row(label=None, groups={})


def _read_rows(path: Path, where: str) -> dict[str, Row] | None:
    """Rows by name of file of a table of recordings; None if it is another kind of table.

    Classes that are no numbers are numbered in the order of their names.
    """
    rows = list(csv.reader(io.StringIO(read_text(path, where), newline="")))
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    files = [index for index, name in enumerate(header) if name in _FILE]
    classes = [index for index, name in enumerate(header) if name in _LABEL]
    if len(files) != 1 or len(classes) > 1:
        return None
    known: dict[str, dict[str, str]] = {}
    for line, cells in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        row = dict(zip(header, (cell.strip() for cell in cells), strict=False))
        name = row.pop(header[files[0]])
        if not name or len(cells) < len(header):
            raise DataError(f"{where}: row {line}: {cells[:4]}; give a file, and a value in each column")
        if known.setdefault(name, row) != row:
            raise DataError(f"{where}: row {line}: {name} stands there twice; keep one of the rows")
    number_of = _numbers([row[header[classes[0]]] for row in known.values()], where) if classes else {}
    labels = {name: number_of[row.pop(header[classes[0]])] for name, row in known.items()} if classes else {}
    return {name: Row(label=labels.get(name), groups=row) for name, row in known.items()}


def _numbers(classes: Sequence[str], where: str) -> dict[str, int]:
    """Number of each class: what it is written as, or its place among the names."""
    names = sorted(set(classes))
    if all(name.isascii() and name.isdigit() and len(name) <= 6 for name in names):
        return {name: int(name) for name in names}
    if mixed := [name for name in names if not name or name.lstrip("-").replace(".", "").isdigit()]:
        raise DataError(f"{where}: label {mixed[0]!r}; give numbers from 0, or names, in all rows")
    return {name: index for index, name in enumerate(names)}


def rows_beside(path: Path, files: list[Path], source: str) -> tuple[dict[Path, Row], list[str]]:
    """Rows by file of tables in the folder `path` or beside `files`, and a note on each table."""
    known: dict[Path, Row] = {}
    notes = []
    folders = {} if path.is_file() else dict.fromkeys([path, *(file.parent for file in files)])
    for folder in folders:
        for table in sorted(file for file in folder.iterdir() if is_table(file) and file.is_file()):
            where = f"{source}: {table.relative_to(path).as_posix()}"
            rows = _read_rows(table, where)
            if rows is None:
                notes.append(f"{where}: is not read; a table of recordings has columns file and label")
                continue
            inside = [file for file in files if file.is_relative_to(folder)]
            names = {file: {file.name, file.relative_to(folder).as_posix()} & rows.keys() for file in inside}
            known |= {file: rows[name] for file, same in names.items() for name in same}
            notes.append(f"{where}: describes {sum(map(bool, names.values()))} of {len(files)} recordings")
    return known, notes
