"""Read an HDF5 file as plain data, trusting nothing in it: no size, no link to elsewhere."""

import contextlib
import hashlib
import io
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from spikeloom.compiler import files
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import FileFault, read_whole
from spikeloom.compiler.types import FloatArray, IntArray

Tree = dict[str, Any]
"""By name a further Tree, an array of numbers or truth values, a string, lists of strings, or None for other things."""

E = TypeVar("E")

AGAIN = "export it again"

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""What such a file begins with."""

MOST_SECONDS = 3
"""CPU time that reading a file may take; 256 MiB of numbers take one second."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A part of a file; printed, it says which."""

    values: Tree  # Its entries

    def fail(self, problem: str) -> ModelError:
        """An error about this part, to be raised."""
        return ModelError(f"{self}: {problem}")

    def has(self, key: str) -> bool:
        """Whether there is such an entry."""
        return self.values.get(key) is not None

    def numbers(self, key: str) -> FloatArray:
        """An entry as float64, of its own shape; ModelError if there is none, or it is no finite numbers."""
        if not self.has(key):
            raise self.fail(f"has no {key}; {AGAIN}")
        values = self.values[key]
        if not isinstance(values, np.ndarray):
            raise self.fail(f"{key} is no array of numbers; {AGAIN}")
        array = values.astype(np.float64)
        if bad := int(np.count_nonzero(~np.isfinite(array))):
            raise self.fail(f"{key} has {bad} of {array.size} values NaN or infinite; train it again")
        return array

    def integers(self, key: str) -> IntArray:
        """An entry as int64, of its own shape; ModelError if it holds anything but whole numbers of 32 bits."""
        array = self.numbers(key)
        wrong = array[(array != np.rint(array)) | (np.abs(array) >= 2**31)]
        if wrong.size:
            raise self.fail(
                f"{key} holds {wrong[0]:g}, allowed are whole numbers of 32 bits; export it quantised"
            )
        return array.astype(np.int64)

    def few(self, key: str, count: int = 1) -> tuple[int, ...]:
        """An entry of so many whole numbers, or of one for all."""
        values = self.integers(key).ravel().tolist()
        if len(values) not in (1, count):
            raise self.fail(f"{key} has {len(values)} values, wanted {count}; {AGAIN}")
        return tuple(values * count if len(values) == 1 else values)


def entry_of(group: Tree, key: str, kind: type[E]) -> E:
    """An entry of a group that is of a kind, else an empty one of that kind."""
    entry = group.get(key)
    return entry if isinstance(entry, kind) else kind()


def is_hdf5(path: str) -> bool:
    """Whether there is a file of this format, by its first bytes."""
    if not Path(path).is_file():  # a pipe would wait for ever
        return False
    with contextlib.suppress(OSError), Path(path).open("rb") as file:
        return file.read(len(SIGNATURE)) == SIGNATURE
    return False


def read_hdf5(path: Path, what: str) -> tuple[Tree, str]:
    """Content of a whole file, and its sha256; messages say `what` it should be.

    FileFault, ModelError, or what h5py raises, if it is missing, too large, damaged, or holds what may not
    be read.
    """
    content = read_whole(path, what)
    return tree_of(content), hashlib.sha256(content).hexdigest()


def tree_of(content: bytes) -> Tree:
    """Content of a file as a tree; raises as :func:`read_hdf5`."""
    import h5py  # slow to load, so only where it is used

    _require_end(content)
    with h5py.File(io.BytesIO(content), "r") as file:
        return _group(file, [files.SIZE_LIMIT])


def _require_end(content: bytes) -> None:
    """Refuse a file on which the HDF5 library spins or dies: another process tries first, with so much time."""
    if not (_ends_in_fork if hasattr(os, "fork") else _ends_elsewhere)(content):
        raise FileFault(
            f"the HDF5 library dies on it, or takes more than {MOST_SECONDS} s, so it is damaged"
        )


def _ends_in_fork(content: bytes) -> bool:
    import resource

    import h5py  # noqa: F401 - loaded once, not by each child

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # threads, say of torch: the child uses nothing of theirs
        child = os.fork()
    if child == 0:
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            try_to_read(content)
        finally:
            os._exit(0)
    return not os.WIFSIGNALED(os.waitpid(child, 0)[1])


def _ends_elsewhere(content: bytes) -> bool:
    """The same where nothing forks (Windows); the time of a new Python counts."""
    code = f"import sys; from {__name__} import try_to_read; try_to_read(sys.stdin.buffer.read())"
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(  # noqa: S603 - the code above
            [sys.executable, "-c", code],
            input=content,
            stderr=subprocess.DEVNULL,
            env=env,
            timeout=10 * MOST_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def try_to_read(content: bytes) -> None:
    """Read all of a file, which may kill this process; what is wrong in it is said by the process that asked."""
    import h5py

    with contextlib.suppress(Exception), h5py.File(io.BytesIO(content), "r") as file:
        _group(file, [files.SIZE_LIMIT])


def _group(group: Any, room: list[int]) -> Tree:
    """Content of a group; the only element of `room` is the bytes of numbers that may still come."""
    return {str(key): _entry(group, key, room) for key in group}


def _entry(group: Any, key: str, room: list[int]) -> Any:
    """A further group, or numbers or words of an array, whose declared size is checked before it is read; else None."""
    import h5py

    if not isinstance(group.get(key, getlink=True), h5py.HardLink):
        raise ModelError(f"{key} is a link to elsewhere, allowed are arrays in the file itself; {AGAIN}")
    item = group[key]
    if isinstance(item, h5py.Group):
        return _group(item, room)
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        return None
    if item.external or item.is_virtual:
        raise ModelError(f"{key} keeps its numbers in another file, allowed is this file alone; {AGAIN}")
    room[0] -= item.dtype.itemsize * max(item.size, int(np.prod(item.chunks or (0,), dtype=object)))
    if room[0] < 0:
        raise ModelError(f"announces more than {files.SIZE_LIMIT} bytes of numbers; {AGAIN}")
    if item.dtype.kind == "O" and h5py.check_string_dtype(item.dtype) is not None:
        return _words(item, room)
    if item.dtype.kind == "S":
        values = item[()]
        return _decoded(values.tolist() if isinstance(values, np.ndarray) else values)
    if item.dtype.kind not in "biuf" or item.dtype.itemsize > 8:
        return None
    values = np.asarray(item[()])
    return np.ascontiguousarray(values, values.dtype.newbyteorder("<")).reshape(values.shape)


def _words(item: Any, room: list[int]) -> Any:
    """Words of any length, one by one: many entries may point at one long word."""
    words = np.empty(item.shape, object)
    for index in np.ndindex(item.shape):
        words[index] = word = _decoded(item[index])
        room[0] -= len(word)
        if room[0] < 0:
            raise ModelError(f"announces more than {files.SIZE_LIMIT} bytes of numbers; {AGAIN}")
    return words.tolist()


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(one) for one in value]
    return value.decode("utf-8", "backslashreplace") if isinstance(value, bytes) else str(value)


def hdf5_bytes(tree: Tree) -> bytes:
    """An HDF5 file of groups, texts (pairs of texts in a list) and arrays; equal trees give equal bytes."""
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        _fill(file, tree)
    return content.getvalue()


def _fill(group: Any, tree: Tree) -> None:
    import h5py

    for name, value in tree.items():
        if isinstance(value, dict):
            _fill(group.create_group(name), value)
        elif isinstance(value, str | list):
            group.create_dataset(name, data=np.array(value, dtype=object), dtype=h5py.string_dtype())
        else:
            group.create_dataset(name, data=value, compression="gzip" if value.size > 1024 else None)
