"""Take an HDF5 file apart in a process of its own: on damaged files the library behind h5py can hang or crash.

Standard input holds the file; standard output gets a line of JSON, and the numbers of all its arrays in turn. This
file is started by its path and imports nothing of ours.
"""

from __future__ import annotations

import io
import json
import sys
from typing import Any

SIZE_LIMIT = 2**28
"""Bytes that all arrays of a file may have together."""

ITEM_LIMIT = 100_000
"""Groups and arrays of a file."""

NESTING = 64
"""Groups within groups; a nested graph takes two."""

DIMENSIONS = 8

CPU_SECONDS = 30
MEMORY = 4 * 2**30

NUMBERS = "biuf"
FILTERS = frozenset({1, 2, 3, 32000})
"""Deflate, shuffle, Fletcher-32 and LZF: what h5py itself brings. Others would load code from elsewhere."""


class RefusedError(Exception):
    """What is wrong about a file, for people."""


def take_apart(content: bytes) -> tuple[list[dict[str, Any]], list[Any]]:
    """Groups and arrays of a file.

    Returns
    -------
    entries : list of dict
        ``path`` and ``kind``: a ``group``; an ``array`` with ``dtype`` and ``shape``; ``text`` with a ``value``, a
        string or lists of them; or ``other``, which no format here has.
    arrays : list of ndarray
        Numbers of the arrays, in their order.

    Raises
    ------
    RefusedError
        If it is no file that may be read.
    Exception
        Whatever h5py raises on damaged ones.
    """
    import h5py

    entries: list[dict[str, Any]] = []
    arrays: list[Any] = []
    left = [SIZE_LIMIT]

    def visit(group: Any, above: list[str]) -> None:
        if len(above) > NESTING:
            raise RefusedError(f"has groups nested deeper than {NESTING}")
        for key in group:
            path = [*above, str(key)]
            if len(entries) >= ITEM_LIMIT:
                raise RefusedError(f"has more than {ITEM_LIMIT} groups and arrays")
            if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                raise RefusedError(f"{'/'.join(path)} is a link to elsewhere, allowed are arrays in the file itself")
            item = group[key]
            if isinstance(item, h5py.Group):
                entries.append({"path": path, "kind": "group"})
                visit(item, path)
            elif isinstance(item, h5py.Dataset):
                entries.append({"path": path} | _array(item, "/".join(path), arrays, left))
            else:
                entries.append({"path": path, "kind": "other"})

    with h5py.File(io.BytesIO(content), "r") as file:
        visit(file, [])
    return entries, arrays


def _array(item: Any, path: str, arrays: list[Any], left: list[int]) -> dict[str, Any]:
    import h5py
    import numpy as np

    if item.external or item.is_virtual:
        raise RefusedError(f"{path} keeps its numbers in another file, allowed is this file alone")
    filters = item.id.get_create_plist()
    if any(filters.get_filter(place)[0] not in FILTERS for place in range(filters.get_nfilters())):
        raise RefusedError(f"{path} is compressed in a way that is not known, allowed are gzip, LZF and shuffle")
    if item.shape is None or len(item.shape) > DIMENSIONS:
        return {"kind": "other"}
    chunk = item.dtype.itemsize
    for size in item.chunks or ():
        chunk *= size
    left[0] -= max(item.size * item.dtype.itemsize, chunk)
    if left[0] < 0:
        raise RefusedError(f"announces more than {SIZE_LIMIT} bytes of numbers")
    if item.dtype.kind == "S" or h5py.check_string_dtype(item.dtype) is not None:
        values = item[()]
        if isinstance(values, np.ndarray):
            return {"kind": "text", "value": _decoded(values.tolist())}
        return {"kind": "text", "value": _decoded(values)}
    if item.dtype.kind not in NUMBERS or item.dtype.itemsize > 8:
        return {"kind": "other"}
    values = np.asarray(item[()])
    arrays.append(np.ascontiguousarray(values, values.dtype.newbyteorder("<")))
    return {"kind": "array", "dtype": arrays[-1].dtype.str, "shape": list(values.shape)}


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(one) for one in value]
    return value.decode("utf-8", "backslashreplace") if isinstance(value, bytes) else str(value)


def limit_resources() -> None:
    """Give up on what takes too long or too much memory, where the system can do so."""
    try:
        import resource
    except ImportError:
        return  # not on this system; the parent's clock remains
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def main() -> None:
    """Answer for the file on standard input."""
    limit_resources()
    out = sys.stdout.buffer
    try:
        entries, arrays = take_apart(sys.stdin.buffer.read())
        head: dict[str, Any] = {"entries": entries}
    except RefusedError as error:
        head, arrays = {"refused": str(error)}, []
    except Exception as error:
        head, arrays = {"damaged": type(error).__name__}, []
    out.write(json.dumps(head).encode() + b"\n")
    for array in arrays:
        out.write(array.tobytes())
    out.flush()


if __name__ == "__main__":
    main()
