"""Small tables of numbers in CSV files: with or without a header, every fault named by its line.

A line holds numbers between commas. The first line may name the columns, in any order; without names they stand in
the order that the reader asks for. Blank lines, and what follows a ``#``, do not count.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.errors import DataError

FloatArray = NDArray[np.float64]

MAX_TABLE_BYTES = 256 << 20  # some 15 million events

_LINE = re.compile(r"[^\r\n]+")
_LINE_END = re.compile(r"\r\n|\r|\n")
_BLANKS = re.compile(r"^[ \t]+(?=[#\r\n]|\Z)", re.MULTILINE)  # numpy takes a line of blanks for a row
_NAMES_IN_COMMENT = re.compile(r"#[# \t]*(?=[A-Za-z_]\w*[ \t]*(,[ \t]*[A-Za-z_]\w*[ \t]*)+$)")  # numpy.savetxt does so


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Columns of numbers and where they stood.

    Parameters
    ----------
    where : str
        The file, for messages.
    columns : mapping of str to (rows,) float64
        Optional columns that the file does not have are absent.
    text : str
        The file, to find lines again.
    header : bool
        Whether the first line names the columns.
    """

    where: str
    columns: Mapping[str, FloatArray]
    text: str
    header: bool

    def at(self, row: int) -> str:
        """Place of a row, for messages: ``events.csv: line 7``."""
        rows = _rows(self.text)
        if self.header:
            next(rows)
        return f"{self.where}: line {next(line for index, (line, _) in enumerate(rows) if index == row)}"


def read_table(
    path: str | os.PathLike[str], required: tuple[str, ...], optional: tuple[str, ...] = (), *, where: str | None = None
) -> Table:
    """Read a CSV file.

    Parameters
    ----------
    path : path
        UTF-8 text of at most `MAX_TABLE_BYTES`.
    required, optional : tuple of str
        Names of the columns; the order counts where the file does not name them.
    where : str, optional
        What messages call the file; its name if left out.

    Returns
    -------
    Table
        At least one row; values may be infinite or NaN.

    Raises
    ------
    DataError
        If the file cannot be read or is not such a table; the message names the line.
    """
    path = Path(path)
    where = where or path.name
    text = _text(path, where)
    known = (*required, *optional)
    expected = ", ".join(required) + "".join(f"[, {name}]" for name in optional)
    rows = _rows(text)
    _, first = next(rows, (0, ""))
    names = tuple(cell.strip().lower() for cell in first.split(","))
    header = bool(first) and not any(_is_number(cell) for cell in names)
    if header:
        if not (set(required) <= set(names) <= set(known) and len(set(names)) == len(names)):
            raise DataError(f"{where}: line 1: columns {', '.join(names)}, expected are {expected}; name them so")
        _, first = next(rows, (0, ""))
    if not first:
        raise DataError(f"{where}: no rows, expected are lines of {expected}; check how the file was written")
    if not header:
        count = len(names)
        if not len(required) <= count <= len(known):
            raise DataError(f"{where}: {_columns(count)} in its first row, expected are {expected}; separate by commas")
        names = known[:count]
    try:
        values = np.loadtxt(_body(text, header=header), delimiter=",", ndmin=2)
        if values.shape[1] != len(names):
            raise ValueError("all rows lack or exceed what the header names")
    except ValueError as error:
        raise _fault(where, text, names, header=header) from error
    columns = {name: np.ascontiguousarray(values[:, index]) for index, name in enumerate(names)}
    return Table(where=where, columns=columns, text=text, header=header)


def _text(path: Path, where: str) -> str:
    """The file as text, without a byte order mark."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TABLE_BYTES + 1)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); check the path and the disk") from error
    if len(data) > MAX_TABLE_BYTES:
        raise DataError(f"{where}: more than {MAX_TABLE_BYTES} bytes, the limit of a table; split it")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not text in UTF-8 (byte {error.start}); save it as CSV") from error
    if "\0" in text:
        raise DataError(f"{where}: not text (a zero byte); save it as CSV")
    return _BLANKS.sub("", text)


def _rows(text: str) -> Iterator[tuple[int, str]]:
    """Number and content of every line that counts; the names may stand in a comment."""
    line, position, first = 1, 0, True
    for match in _LINE.finditer(text):
        line += sum(1 for _ in _LINE_END.finditer(text, position, match.start()))
        position = match.start()
        content = match[0].strip()
        if first:
            content = _NAMES_IN_COMMENT.sub("", content)
        content = content.partition("#")[0].strip()
        if content:
            first = False
            yield line, content


def _body(text: str, *, header: bool) -> io.StringIO:
    """The lines after the header."""
    start = 0
    if header:
        line, _ = next(_rows(text))
        ends = _LINE_END.finditer(text)
        for _ in range(line):
            start = next(ends).end()
    return io.StringIO(text[start:], newline=None)


def _fault(where: str, text: str, names: tuple[str, ...], *, header: bool) -> DataError:
    """Name the first line that is not a row of numbers."""
    rows = _rows(text)
    if header:
        next(rows)
    for line, content in rows:
        cells = [cell.strip() for cell in content.split(",")]
        if len(cells) != len(names):
            return DataError(
                f"{where}: line {line}: {_columns(len(cells))}, expected are {len(names)} ({', '.join(names)}); "
                "separate by commas"
            )
        for name, cell in zip(names, cells, strict=True):
            if not _is_number(cell):
                return DataError(f"{where}: line {line}: {name} is {cell[:40]!r}, not a number; write plain numbers")
    return DataError(f"{where}: cannot be read as numbers; write plain numbers between commas")


def _is_number(cell: str) -> bool:
    """Whether numpy reads it: Python's float also takes underscores and foreign digits."""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def _columns(count: int) -> str:
    return f"{count} column" if count == 1 else f"{count} columns"
