"""The EvTouch recordings: read a folder or a zip in the released layout, check everything, return one array.

The layout is ``train/`` and ``test/`` with files ``sample_N_label_L.npy``, possibly inside one top folder. A
recording is (taxels, 2, steps), values 0 and 1; polarity 1 is the rising one (it leads at first contact).

Nothing is unpacked to disk and nothing is unpickled. Sizes are checked where they are announced (zip directory,
npy header) and again where they arrive, before memory is taken for them.
"""

from __future__ import annotations

import ast
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.errors import DataError

MAX_HEADER_BYTES = 4096  # numpy writes 118
MAX_FILE_BYTES = 64 << 20  # the released recordings have 0.1 MB
MAX_TOTAL_BYTES = 4 << 30
MAX_RATIO = 1032  # what deflate can reach; past it, entries share their bytes or lie about their size

_DTYPES = {"<f4": np.float32, "<f8": np.float64, "|u1": np.uint8, "|b1": np.uint8}
_LABEL = re.compile(r"_label_([0-9]{1,6})\.npy$")
_UNSAFE = re.compile(r"^[/\\]|^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)")
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError)
_COPY_AGAIN = "truncated or damaged; copy or download it again"
_GIVE = "give the folder or zip that holds train/ and test/"

Read = Callable[[str], bytes]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recordings:
    """Event recordings of one split, in one array: shorter ones are filled up with silence that does not count.

    Parameters
    ----------
    events : (samples, taxels, 2, steps) uint8
        1 where a taxel sent an event of that polarity in that step; C-contiguous, read-only.
    labels : (samples,) int64
        Class of each recording; read-only.
    files : tuple of str
        File name of each recording.
    split : str
        For example ``test``.
    source : str
        Name of the folder, zip or generator.
    lengths : (samples,) int64, or None
        Steps of each recording; read-only. None where all have as many as the array, as in the released layout.
    """

    events: NDArray[np.uint8]
    labels: NDArray[np.int64]
    files: tuple[str, ...]
    split: str
    source: str
    lengths: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        for name in ("events", "labels", "lengths"):
            array = getattr(self, name)
            if array is not None:
                view = np.ascontiguousarray(array).view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self.files)

    @property
    def taxels(self) -> int:
        """Taxels of each recording."""
        return int(self.events.shape[1])

    @property
    def steps(self) -> int:
        """Time steps of the longest recording."""
        return int(self.events.shape[3])

    def steps_of(self, index: int) -> int:
        """Time steps of one recording."""
        return self.steps if self.lengths is None else int(self.lengths[index])

    def identity(self) -> dict[str, NDArray[Any]]:
        """Arrays that tell these recordings from others, whatever their names."""
        arrays: dict[str, NDArray[Any]] = {"events": self.events, "labels": self.labels}
        return arrays if self.lengths is None else arrays | {"lengths": self.lengths}


def load_recordings(
    path: str | os.PathLike[str],
    split: str = "test",
    *,
    limit: int | None = None,
    classes: int | None = None,
    taxels: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Recordings:
    """Read one split of a data set, files in plain string order.

    Parameters
    ----------
    path : path
        A folder or a zip in the released layout.
    split : str
        The folder that holds the recordings, ``train`` or ``test``.
    limit : int, optional
        Read only the first so many.
    classes, taxels : int, optional
        What the network expects; labels and shapes are held against it.
    progress : callable, optional
        Called with (recordings read, recordings to read) after each.

    Raises
    ------
    DataError
        If the data set or any recording in it cannot be used; the message names the file.
    """
    if limit is not None and limit < 1:
        raise DataError(f"limit: {limit} recordings, allowed are 1 or more; leave it out to read all")
    path = Path(path)
    source = path.name or str(path)
    with _opened(path, {"train", "test", split}) as (names, read):
        found = _splits(source, names, {"train", "test", split})
        if split not in found:
            present = ", ".join(sorted(found))
            raise DataError(f"{source}: split {split!r} is missing or empty; splits with recordings: {present}")
        members = sorted(found[split].items())[:limit]
        labels = [_label(f"{source}: {split}/{name}", name, classes) for name, _ in members]
        events: NDArray[np.uint8] | None = None
        for index, (name, member) in enumerate(members):
            where = f"{source}: {split}/{name}"
            recording = _parse(where, _bounded(where, read, member), taxels)
            if events is None:
                _check_total(source, len(members) * recording.size)
                events = np.empty((len(members), *recording.shape), dtype=np.uint8)
            if recording.shape != events.shape[1:]:
                raise DataError(
                    f"{where}: shape {recording.shape}, the recordings before it have {events.shape[1:]}; "
                    "all of a split must agree"
                )
            events[index] = recording
            if progress is not None:
                progress(index + 1, len(members))
    assert events is not None  # a split that was found has a file
    return Recordings(
        events=events,
        labels=np.array(labels, dtype=np.int64),
        files=tuple(name for name, _ in members),
        split=split,
        source=source,
    )


@contextmanager
def _opened(path: Path, splits: set[str]) -> Iterator[tuple[list[str], Read]]:
    """File names relative to `path`, with slashes, and a function that reads one of them."""
    if path.is_dir():
        yield _list_folder(path, splits), lambda name: _read_file(path / name)
        return
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; {_GIVE}")
    if not path.is_file():
        raise DataError(f"{path}: neither a folder nor a zip; {_GIVE}")
    try:
        with path.open("rb") as file:
            magic = file.read(2)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); check the disk") from error
    try:
        archive = zipfile.ZipFile(path)
    except _ZIP_ERRORS as error:
        if magic == b"PK":
            raise DataError(f"{path}: zip {_COPY_AGAIN}") from error
        raise DataError(f"{path}: neither a folder nor a zip; {_GIVE}") from error
    with archive:
        for info in archive.infolist():
            name = info.orig_filename
            if not info.filename or _UNSAFE.search(name) or not name.isprintable():  # what a zero byte cuts to nothing
                raise DataError(f"{path.name}: unsafe name {name!r} in the zip; do not trust this file")
        infos = [info for info in archive.infolist() if not info.is_dir()]
        wanted = [info for info in infos if info.filename.endswith(".npy")]
        for info in wanted:
            # Other methods cannot be decompressed in bounded steps.
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DataError(f"{path.name}: {info.filename} is encrypted or not deflated; zip it again plainly")
        announced = sum(info.file_size for info in wanted)
        _check_total(path.name, announced)
        if announced > MAX_RATIO * path.stat().st_size:
            raise DataError(
                f"{path.name}: {path.stat().st_size} bytes claim to hold {announced}, "
                f"limit {MAX_RATIO} to 1; do not trust this file"
            )
        by_name = {info.filename: info for info in infos}
        yield [info.filename for info in infos], lambda name: _read_member(archive, by_name[name])


def _list_folder(path: Path, splits: set[str]) -> list[str]:
    """Names ``split/file`` and ``top/split/file`` under `path`."""
    try:
        folders = [entry for entry in path.iterdir() if entry.is_dir()]
        folders += [entry for top in folders if top.name not in splits for entry in top.iterdir() if entry.is_dir()]
        files = [file for folder in folders if folder.name in splits for file in folder.iterdir() if file.is_file()]
    except OSError as error:
        raise DataError(f"{error.filename}: cannot be read ({error.strerror or error}); check the disk") from error
    return [file.relative_to(path).as_posix() for file in files]


def _splits(source: str, names: Iterable[str], splits: set[str]) -> dict[str, dict[str, str]]:
    """Map split to file name to member name, for the one data set among `names`."""
    found: dict[str, dict[str, str]] = {}
    roots: set[str] = set()
    for member in names:
        *top, split, name = member.split("/") if "/" in member else ("", member)
        if len(top) > 1 or split not in splits or "__MACOSX" in top:
            continue
        if not name.endswith(".npy") or name.startswith("."):
            continue
        roots.add("/".join(top) or ".")
        if found.setdefault(split, {}).get(name) == member:
            raise DataError(f"{source}: {split}/{name} is listed twice; do not trust this file")
        found[split][name] = member
    if len(roots) > 1:
        shown = ", ".join(sorted(roots))
        raise DataError(f"{source}: several data sets ({shown}); give one of them")
    if not found:
        raise DataError(f"{source}: no recordings (train/ or test/ with sample_N_label_L.npy); {_GIVE}")
    return found


def _label(where: str, name: str, classes: int | None) -> int:
    """Class in a file name."""
    match = _LABEL.search(name)
    if match is None:
        raise DataError(f"{where}: no label in the name, allowed is sample_N_label_L.npy; rename or remove the file")
    label = int(match[1])
    if classes is not None and label >= classes:
        raise DataError(
            f"{where}: label {label}, the network has {classes} classes (0..{classes - 1}); "
            "use the network that was trained on these objects"
        )
    return label


def _read_file(path: Path) -> bytes:
    """At most one byte more than a recording may have."""
    with path.open("rb") as file:
        return file.read(MAX_FILE_BYTES + 1)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """At most one byte more than a recording may have; zipfile checks the sum when it reaches the end."""
    with archive.open(info) as file:
        return file.read(MAX_FILE_BYTES + 1)


def _bounded(where: str, read: Read, member: str) -> bytes:
    """Content of a member, or one clear error."""
    try:
        data = read(member)
    except OSError as error:
        raise DataError(f"{where}: cannot be read ({error.strerror or error}); check the disk") from error
    except _ZIP_ERRORS as error:
        raise DataError(f"{where}: {_COPY_AGAIN}") from error
    if len(data) > MAX_FILE_BYTES:
        raise DataError(f"{where}: more than {MAX_FILE_BYTES} bytes, the limit of a recording; split it")
    return data


def _check_total(source: str, size: int) -> None:
    """Refuse a data set that would fill the memory."""
    if size > MAX_TOTAL_BYTES:
        raise DataError(f"{source}: recordings of {size} bytes, limit {MAX_TOTAL_BYTES}; split the data set")


def _parse(where: str, data: bytes, taxels: int | None) -> NDArray[np.uint8]:
    """Return the (taxels, 2, steps) uint8 of an npy file that holds zeros and ones."""
    descr, fortran, shape, start = _header(where, data)
    if descr not in _DTYPES:
        raise DataError(f"{where}: dtype {descr!r}, allowed are float32, float64, uint8 and bool; convert it")
    if len(shape) != 3 or 0 in shape:
        raise DataError(f"{where}: shape {shape}, allowed is (taxels, 2, steps); one recording per file")
    if shape[1] != 2:
        raise DataError(f"{where}: shape {shape} has {shape[1]} polarities, allowed are 2; use (taxels, 2, steps)")
    if taxels is not None and shape[0] != taxels:
        raise DataError(f"{where}: has {shape[0]} taxels, the network has {taxels}; use recordings of its sensor")
    dtype = np.dtype(_DTYPES[descr])
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise DataError(
            f"{where}: {len(data) - start} bytes of data, its header announces {math.prod(shape) * dtype.itemsize}; "
            f"{_COPY_AGAIN}"
        )
    values = np.frombuffer(data, dtype=dtype, offset=start).reshape(shape, order="F" if fortran else "C")
    events: NDArray[np.bool_] = values != 0  # NaN becomes an event here and differs from 1 below
    wrong = values != events
    if wrong.any():
        taxel, polarity, step = (int(index) for index in np.argwhere(wrong)[0])
        raise DataError(
            f"{where}: value {values[taxel, polarity, step]:g} at taxel {taxel}, polarity {polarity}, step {step}, "
            "allowed are 0 and 1; recordings are events, not pressures"
        )
    return events.view(np.uint8)


def _header(where: str, data: bytes) -> tuple[object, bool, tuple[int, ...], int]:
    """Read descr, Fortran order and shape of an npy file, and find where its data starts.

    References
    ----------
    numpy.lib.format: six magic bytes, two of version, header length in two bytes (version 1) or four, a literal.
    """
    if data[:6] != b"\x93NUMPY" or data[6:7] not in (b"\x01", b"\x02", b"\x03"):
        raise DataError(f"{where}: not an npy file of version 1 to 3; save it with numpy.save")
    body = 10 if data[6] == 1 else 12
    start = body + int.from_bytes(data[8:body], "little")
    if start - body > MAX_HEADER_BYTES:
        raise DataError(
            f"{where}: npy header of {start - body} bytes, limit {MAX_HEADER_BYTES}; save it with numpy.save"
        )
    try:
        if start > len(data):
            raise ValueError("the header is cut off")
        header = ast.literal_eval(data[body:start].decode("utf-8").strip())
        descr, fortran, shape = header.pop("descr"), header.pop("fortran_order"), header.pop("shape")
        if header or type(fortran) is not bool or type(shape) is not tuple:
            raise ValueError("the header has other fields")
        if not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError("the shape holds no sizes")
    except (ValueError, SyntaxError, TypeError, AttributeError, KeyError, RecursionError, MemoryError) as error:
        raise DataError(f"{where}: npy header {_COPY_AGAIN}") from error
    return (descr if isinstance(descr, str) else "structured"), fortran, shape, start
