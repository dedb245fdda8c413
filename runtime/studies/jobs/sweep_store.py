"""Results of a sweep on disk: one line each, appended whole, so that a kill costs nothing that was finished."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError
from spikeloom.runtime.studies.jobs.locks import lock

Json = dict[str, Any]

FORMAT = 1
"""Of the file itself; the version of what is measured is its owner's."""

REMEDY = "delete it or give --fresh to measure anew"


class Store:
    """Results by key in an append-only file, open while a sweep writes to it; see :func:`opened`.

    The first line says what the file is, every other one is ``{"key": …, "result": …}``. A line that has no end was
    cut by a kill: it is taken off when the file is opened next.

    Parameters
    ----------
    path : Path
        Where.
    file : binary file
        Unbuffered, at its end.
    results : dict
        What it held, by key.
    """

    def __init__(self, path: Path, file: FileIO, results: dict[str, Json]) -> None:
        self.path = path
        self.results = results
        self._file = file

    def add(self, key: str, result: Mapping[str, Any]) -> Json:
        """Keep a result, on disk when this returns; return it as it will be read again.

        Raises
        ------
        OSError
            If the disk is full; ``filename`` is the file.
        """
        line = json.dumps({"key": key, "result": result}, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        _append(self.path, self._file, line)
        self.results[key] = json.loads(line)["result"]
        return self.results[key]


@contextmanager
def opened(path: Path, *, kind: str, version: int, fresh: bool = False) -> Iterator[Store]:
    """Open a store to add to it; make it where there is none.

    Parameters
    ----------
    path : Path
        Where it is; its folder exists.
    kind, version : str, int
        What is measured; a store of another one is refused.
    fresh : bool
        Forget the results that it holds, of whichever version.

    Raises
    ------
    DataError
        If it is no store, one of something else or of another version, or damaged before its last line.
    OptionError
        If another sweep is writing to it.
    OSError
        If it cannot be read or written.
    """
    header = {"spikeloom": "sweep", "format": FORMAT, "kind": kind, "version": version}
    path.touch()
    with path.open("r+b", buffering=0) as file:
        lock(file, f"{path}: another sweep is writing to it; wait for that one, or give another output")
        results, whole = _read(path, file.readall(), header, fresh=fresh)
        file.seek(whole)
        file.truncate()
        if whole == 0:
            _append(path, file, _header_line(header))
        yield Store(path, file, results)


def _header_line(header: Json) -> bytes:
    return json.dumps(header).encode() + b"\n"


def _append(path: Path, file: FileIO, line: bytes) -> None:
    """Write a line to the disk; one that fills up keeps nothing of it."""
    before = file.tell()
    try:
        left = memoryview(line)
        while left:
            left = left[file.write(left) :]
        os.fsync(file.fileno())
    except OSError as error:
        with suppress(OSError):
            file.seek(before)
            file.truncate()
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def _read(path: Path, content: bytes, wanted: Json, *, fresh: bool) -> tuple[dict[str, Json], int]:
    """Results of a store, and how many of its bytes to keep."""
    lines = content.splitlines(keepends=True)
    torn = lines.pop() if lines and not lines[-1].endswith(b"\n") else b""
    if not lines and _header_line(wanted).startswith(torn):
        return {}, 0
    head = _line(lines[0]) if lines else None
    if not isinstance(head, dict) or head.get("spikeloom") != "sweep":
        raise DataError(f"{path}: is no store of results; give another output, or delete it")
    if fresh:
        return {}, 0
    for name in ("kind", "format", "version"):
        if head.get(name) != wanted[name]:
            raise DataError(f"{path}: holds results of {name} {head.get(name)}, this is {wanted[name]}; {REMEDY}")
    results: dict[str, Json] = {}
    for number, line in enumerate(lines[1:], start=2):
        entry = _line(line)
        if not isinstance(entry, dict) or not isinstance(entry.get("result"), dict) or "key" not in entry:
            raise DataError(f"{path}: line {number}: is no result; {REMEDY}")
        results[str(entry["key"])] = entry["result"]
    return results, len(content) - len(torn)


def _line(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
