"""A table of labels beside recordings: ``labels.csv`` with lines ``file,label``."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from spikeloom.compiler.errors import DataError
from spikeloom.models.recordings.csvtable import read_text

NAME = "labels.csv"

_FILE = ("file", "filename", "name", "recording")
_LABEL = ("label", "class")


def is_table(file: Path) -> bool:
    """Whether a file is such a table, by its name."""
    return file.name.lower() == NAME


def _read_labels(path: Path, where: str) -> Mapping[str, int] | None:
    """Class by name of file in a table of labels; None if the file is another kind of table.

    Columns beside that of the file and that of the class are passed over; DataError if a row lacks a class, or a file
    stands in it twice with different ones.
    """
    rows = list(csv.reader(io.StringIO(read_text(path, where), newline="")))
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    files = [index for index, name in enumerate(header) if name in _FILE]
    classes = [index for index, name in enumerate(header) if name in _LABEL]
    if len(files) != 1 or len(classes) != 1:
        return None
    labels: dict[str, int] = {}
    for line, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        name, label = (row[index].strip() if index < len(row) else "" for index in (files[0], classes[0]))
        if not (name and label.isascii() and label.isdigit() and len(label) <= 6):
            raise DataError(f"{where}: row {line}: {name!r}, label {label!r}; give a file and a number from 0")
        if labels.setdefault(name, int(label)) != int(label):
            raise DataError(f"{where}: row {line}: {name} has labels {labels[name]} and {label}; keep one")
    return labels


def labels_beside(path: Path, files: list[Path], source: str) -> tuple[dict[Path, int], list[str]]:
    """Classes by file that tables in the folder `path` or beside `files` give, and a note on each table."""
    labels: dict[Path, int] = {}
    notes = []
    folders = {} if path.is_file() else dict.fromkeys([path, *(file.parent for file in files)])
    for folder in folders:
        for table in sorted(file for file in folder.iterdir() if is_table(file) and file.is_file()):
            where = f"{source}: {table.relative_to(path).as_posix()}"
            rows = _read_labels(table, where)
            if rows is None:
                notes.append(f"{where}: is not read; a table of labels has columns file and label")
                continue
            inside = [file for file in files if file.is_relative_to(folder)]
            names = {file: {file.name, file.relative_to(folder).as_posix()} & rows.keys() for file in inside}
            labels |= {file: rows[name] for file, known in names.items() for name in known}
            notes.append(f"{where}: gives the labels of {sum(map(bool, names.values()))} of {len(files)} recordings")
    return labels, notes
