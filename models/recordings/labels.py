"""A table of labels beside recordings: ``labels.csv`` with lines ``file,label``."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from spikeloom.compiler.errors import DataError

NAME = "labels.csv"
MAX_BYTES = 16 << 20

_FILE = ("file", "filename", "name", "recording")
_LABEL = ("label", "class")


def is_table(file: Path) -> bool:
    """Whether a file is such a table, by its name."""
    return file.name.lower() == NAME


def read_labels(path: Path, where: str) -> Mapping[str, int] | None:
    """Class by name of file in a table of labels; None if the file is another kind of table.

    Its header names one of the columns ``file``, ``filename``, ``name`` and ``recording``, and one of ``label`` and
    ``class``; others are passed over.

    Raises
    ------
    DataError
        If a row of the table lacks a class, or a file stands in it twice with different ones.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror or error}); check the disk") from error
    if len(content) > MAX_BYTES:
        return None
    try:
        rows = list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline="")))
    except (UnicodeDecodeError, csv.Error):
        return None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    files = [index for index, name in enumerate(header) if name in _FILE]
    classes = [index for index, name in enumerate(header) if name in _LABEL]
    if len(files) != 1 or len(classes) != 1:
        return None
    labels: dict[str, int] = {}
    for line, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        cells = [row[index].strip() if index < len(row) else "" for index in (files[0], classes[0])]
        name, label = cells
        if not (name and label.isascii() and label.isdigit() and len(label) <= 6):
            raise DataError(f"{where}: row {line}: {name!r}, label {label!r}; give a file and a number from 0")
        if labels.setdefault(name, int(label)) != int(label):
            raise DataError(f"{where}: row {line}: {name} has labels {labels[name]} and {label}; keep one")
    return labels


def labels_beside(path: Path, files: list[Path], source: str) -> tuple[dict[Path, int], list[str]]:
    """Classes that tables beside recordings give, by file, and a note on each table.

    `path` is the folder that was asked for, or one recording; `files` are the recordings in it.

    Raises
    ------
    DataError
        As `read_labels`.
    """
    labels: dict[Path, int] = {}
    notes = []
    folders = {} if path.is_file() else dict.fromkeys([path, *(file.parent for file in files)])
    for folder in folders:
        for table in sorted(file for file in folder.iterdir() if is_table(file) and file.is_file()):
            where = f"{source}: {table.relative_to(path).as_posix()}"
            rows = read_labels(table, where)
            if rows is None:
                notes.append(f"{where}: is not read; a table of labels has columns file and label")
                continue
            inside = [file for file in files if file.is_relative_to(folder)]
            names = {file: {file.name, file.relative_to(folder).as_posix()} & rows.keys() for file in inside}
            labels |= {file: rows[name] for file, known in names.items() for name in known}
            notes.append(f"{where}: gives the labels of {sum(map(bool, names.values()))} of {len(files)} recordings")
    return labels, notes
