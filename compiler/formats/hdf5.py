"""Read an HDF5 file as plain data, trusting nothing in it: no size, no link, not even that it can be read.

The library is run in a process of its own, :mod:`formats.hdf5_child`; one that hangs or crashes is a file
that is damaged.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import ModelError

Array = npt.NDArray[Any]

Tree = dict[str, Any]
"""By name a further Tree, an Array of numbers or truth values, a string, lists of strings, or None for other things."""

SIZE_LIMIT = 2**28
"""Bytes that a file may have: 256 MiB, as of a checkpoint."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"
SECONDS = 60.0

CHILD = Path(__file__).with_name("hdf5_child.py")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class File:
    """Content of a file, and its hash."""

    tree: Tree
    sha256: str


def read_hdf5(path: Path, what: str, remedy: str) -> File:
    """Read a whole file.

    Parameters
    ----------
    path : Path
        File.
    what, remedy : str
        For messages: what it should be (``NIR file``), and what to do about a damaged one.

    Raises
    ------
    ModelError
        If it is missing, too large, no HDF5 file or damaged.
    OSError
        If it cannot be read.
    """
    if not path.is_file():
        found = "is not a file" if path.exists() else "no such file"
        raise ModelError(f"{found}; give a {what}")
    size = path.stat().st_size
    if size > SIZE_LIMIT:
        raise ModelError(f"has {size} bytes, {SIZE_LIMIT} are allowed; a {what} of one chip is smaller")
    content = path.read_bytes()
    if not content.startswith(SIGNATURE):
        raise ModelError(f"is no HDF5 file, as a {what} is; {remedy}")
    return File(tree=tree_of(content, remedy), sha256=hashlib.sha256(content).hexdigest())


def tree_of(content: bytes, remedy: str) -> Tree:
    """Content of a file as a tree.

    Raises
    ------
    ModelError
        If it is damaged, or holds what may not be read.
    """
    command = [sys.executable, "-P", str(CHILD)]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=SECONDS, check=False)  # noqa: S603
    except subprocess.TimeoutExpired:
        raise ModelError(f"cannot be read within {SECONDS:g} s; {remedy}") from None
    line, _, numbers = done.stdout.partition(b"\n")
    if done.returncode or not line:
        # the library ran out of its memory or its time, or crashed
        raise ModelError(f"is truncated or damaged (the HDF5 library gave up); {remedy}")
    head = json.loads(line)
    if "refused" in head:
        raise ModelError(f"{head['refused']}; {remedy}")
    if "damaged" in head:
        raise ModelError(f"is truncated or damaged ({head['damaged']}); {remedy}")
    return assembled(head["entries"], numbers)


def assembled(entries: list[dict[str, Any]], numbers: bytes) -> Tree:
    """Tree of what the other process found.

    Examples
    --------
    >>> entries = [
    ...     {"path": ["a"], "kind": "group"},
    ...     {"path": ["a", "b"], "kind": "array", "dtype": "<i2", "shape": [2]},
    ... ]
    >>> assembled(entries, bytes([1, 0, 2, 0]))
    {'a': {'b': array([1, 2], dtype=int16)}}
    """
    root: Tree = {}
    place = 0
    for entry in entries:
        *above, name = entry["path"]
        group = root
        for step in above:
            group = group[step]
        match entry["kind"]:
            case "group":
                group[name] = {}
            case "text":
                group[name] = entry["value"]
            case "array":
                kind, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
                count = math.prod(shape)
                group[name] = np.frombuffer(numbers, kind, count, place).reshape(shape)
                place += count * kind.itemsize
            case _:
                group[name] = None
    return root
