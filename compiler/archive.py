"""Archives of arrays: an uncompressed ``.npz`` with a JSON manifest and a hash, which numpy alone can read.

What all netlist files share, whatever chip they are for. Equal members give equal bytes: they are stored,
not compressed, in the order given and with a fixed date. Nothing is ever pickled.
"""

import hashlib
import io
import json
import math
import os
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from spikeloom.compiler.dynamics import MOST_CLOCKS, MOST_STEPS
from spikeloom.compiler.files import FileFault, read_whole, write_atomically

Array = np.ndarray[Any, Any]

TRAINED = "spikeloom-native"
"""Trained in the whole numbers of a chip."""

COUNTERS = "spikeloom-counters"
"""A counting network."""

FORMATS = {
    "spikeloom-netlist": "cores of compartments (--target loihi1)",
    "spikeloom-crossbars": "crossbar cores (--target truenorth)",
    TRAINED: "a network trained for TrueNorth, not yet compiled",
    COUNTERS: "a counting network, not yet compiled",
}
"""What a manifest may say that an archive is."""

AGAIN = "copy or train it again"
"""Remedy for a damaged file of a network that is not compiled yet."""

SIZE_LIMIT = 2**32
"""Bytes that a netlist file may have, 4 GiB: some hundred times the synapses of a whole chip."""

HASHED = 1 << 24
"""Bytes of an array that are hashed together."""

ZIP_DATE = (1980, 1, 1, 0, 0, 0)
"""Date of every member of a zip, fixed so that equal content gives equal bytes."""

END_COUNT = -12
"""Where a zip without a comment states the number of its members, counted from its end."""

ZIP64 = 0xFFFF
"""What stands there for more members than two bytes count."""


def narrow(array: Array) -> Array:
    """The same numbers in the narrowest little-endian signed type that holds them; real numbers as float64."""
    if array.dtype.kind == "f":
        return array.astype("<f8")
    for dtype in ("<i1", "<i2", "<i4"):
        info = np.iinfo(dtype)
        if not array.size or (info.min <= array.min() and array.max() <= info.max):
            return array.astype(dtype)
    return array.astype("<i8")


def _blocks(array: Array) -> Iterator[Array]:
    """An array, some rows at a time."""
    rows = max(1, HASHED // max(1, math.prod(array.shape[1:]) * array.dtype.itemsize))
    return (array[first : first + rows] for first in range(0, array.shape[0], rows))


def digest(members: Mapping[str, Array]) -> str:
    """Hex sha256 over name, dtype, shape and bytes of each member, in their order."""
    running = hashlib.sha256()
    for name, array in members.items():
        running.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        for block in _blocks(array) if array.shape else [array]:
            running.update(np.ascontiguousarray(block).tobytes())
    return running.hexdigest()


def arrays_digest(arrays: Mapping[str, Array]) -> str:
    """Hex sha256 over arrays in the order of their names, as :func:`digest`."""
    return digest(dict(sorted(arrays.items())))


def npy_bytes(array: Array) -> bytes:
    """Content of an npy file."""
    content = io.BytesIO()
    np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
    return content.getvalue()


def zip_bytes(members: Mapping[str, bytes | str]) -> bytes:
    """A zip that stores its members plainly, in their order."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, date_time=ZIP_DATE), content)
    return file.getvalue()


def archive_bytes(manifest: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """Content of an archive: the manifest, the arrays in their order, and the hash over all of them."""
    members: dict[str, Array] = {"manifest": np.array(json.dumps(manifest, sort_keys=True))}
    members |= {name: narrow(array) for name, array in arrays.items()}
    members["sha256"] = np.array(digest(members))
    return zip_bytes({f"{name}.npy": npy_bytes(array) for name, array in members.items()})


def write_archive(content: bytes, path: str | os.PathLike[str]) -> str:
    """Write a file, whole or not at all; return its sha256."""
    with write_atomically(path) as file:
        file.write(content)
    return hashlib.sha256(content).hexdigest()


def opened_zip(file: IO[bytes]) -> zipfile.ZipFile:
    """A zip that checks CRCs as it is read.

    FileFault, or an error of zipfile, where its directory has lost a member or the name of one.
    """
    opened = zipfile.ZipFile(file)
    members = opened.infolist()
    file.seek(END_COUNT - len(opened.comment), os.SEEK_END)
    if int.from_bytes(file.read(2), "little") != min(len(members), ZIP64):
        raise FileFault("holds members that its directory does not list")
    for info in members:
        opened.open(info).close()  # compares the names
    return opened


def stored_members(content: bytes) -> dict[str, bytes]:
    """Members of a zip that stores them plainly and claims no more bytes than it has, else FileFault or of zipfile."""
    with opened_zip(io.BytesIO(content)) as opened:
        infos = opened.infolist()
        if any("/code/__torch__" in info.filename for info in infos):
            raise FileFault("is a TorchScript program, which tells what it does only when it runs")
        declared = sum(info.file_size for info in infos)
        if declared > len(content) or any(info.compress_type != zipfile.ZIP_STORED for info in infos):
            raise FileFault(f"has compressed members, {len(content)} bytes claim to hold {declared}")
        return {info.filename: opened.read(info) for info in infos}


def read_npy(content: bytes) -> Array:
    """An array of plain numbers or text from an npy file, whose size is checked against its header.

    FileFault, or what numpy raises, which parses the header as Python, if it is none.
    """
    file = io.BytesIO(content)
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    read_header = headers[np.lib.format.read_magic(file)]
    try:
        shape, fortran, dtype = read_header(file)
    except MemoryError:  # what Python's parser raises of a header that nests too deeply
        raise FileFault("has a damaged header") from None
    size = len(content) - file.tell()
    wanted = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=1) < 0 or size != wanted:
        raise FileFault(f"holds an array of objects, or one of {wanted} bytes in {size}")
    values = np.frombuffer(content, dtype, offset=file.tell()) if wanted else np.zeros(0, dtype)
    return values.reshape(shape, order="F" if fortran else "C")


def read_members(path: Path) -> dict[str, Array]:
    """All members of an archive by name; raises as what it calls."""
    members = stored_members(read_whole(path, "netlist of one chip", SIZE_LIMIT))
    return {name.removesuffix(".npy"): read_npy(content) for name, content in members.items()}


def stated(path: Path, name: str) -> str | None:
    """What the manifest of an archive says of `name`, None where there is no such thing; nothing else is read."""
    try:
        if not path.is_file():  # a pipe would wait for ever
            return None
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo("manifest.npy")
            if info.compress_type != zipfile.ZIP_STORED or info.file_size > path.stat().st_size:
                return None  # no archive of ours, and more than the memory may hold
            manifest = json.loads(str(read_npy(archive.read(info))))
    except Exception:  # zipfile and numpy raise whatever they meet
        return None
    value = manifest.get(name) if isinstance(manifest, dict) else None
    return value if isinstance(value, str) else None


def is_netlist(path: str | os.PathLike[str]) -> bool:
    """Whether a file claims to be a netlist: an archive with a manifest, or a name that ends in ``.loom``."""
    return str(path).endswith(".loom") or stated(Path(path), "format") not in (None, COUNTERS)


DEPTH = 16
"""How deep lists and objects of a manifest may nest."""

LETTERS = 1000
"""Maximum length of a text in a manifest, such as the name of a layer."""

Kind = type | tuple[int, int] | frozenset[str] | dict[str, Any] | list[Any]
"""What an entry of a manifest must be: of a type (``float``: from 0, finite), a whole number within bounds
(both allowed), one of some words, an object of exactly these entries (``NAME?`` may be missing), or a list
of such things, ``[kind, ...]`` of at least one, ``[kind, 2]`` of two."""

GRAPH: Kind = {"name": str, "edges": [[(0, 2**31), 2]]}

CLOCKS: Kind = {"channels": (0, MOST_CLOCKS), "steps": (1, MOST_STEPS), "length?": (1, MOST_STEPS)}


def entry_faults(manifest: Mapping[str, Any], kinds: Mapping[str, Kind]) -> list[str]:
    """Entries of a manifest that are missing or of another kind.

    >>> entry_faults({"taxels": 0, "layers": ["fc1"]}, {"taxels": (1, 9), "layers": [str], "target": str})
    ['the manifest has no usable taxels, target']
    """
    odd = [name for name, kind in kinds.items() if not _is(manifest.get(name), kind)]
    return [f"the manifest has no usable {', '.join(odd)}"] if odd else []


def array_faults(
    arrays: Mapping[str, Array], axes: Mapping[str, int], floats: Iterable[str] = ()
) -> list[str]:
    """Arrays that have not as many axes as `axes` says, by default one, or no integers (`floats`: no real numbers)."""
    faults = []
    for name, array in arrays.items():
        due = axes.get(name, 1)
        kind = "f" if name in floats else "i"
        if (array.ndim, array.dtype.kind) != (due, kind):
            shape = ("list", "table", "block")[due - 1]
            faults.append(f"{name} is no {shape} of {'numbers' if kind == 'f' else 'integers'}")
    return faults


def _is_shallow(value: Any, depth: int) -> bool:
    """Whether lists and objects nest no deeper."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return depth > 0 and all(_is_shallow(each, depth - 1) for each in inside)


def _is(value: Any, kind: Kind) -> bool:  # noqa: PLR0911 - one for each kind
    match kind:
        case type() if kind is float:
            return type(value) in (int, float) and 0 <= value <= sys.float_info.max
        case type():
            return isinstance(value, kind) and not (isinstance(value, str) and len(value) > LETTERS)
        case tuple():
            return type(value) is int and kind[0] <= value <= kind[1]
        case frozenset():
            return isinstance(value, str) and value in kind
        case dict():
            known = {name.removesuffix("?"): name for name in kind}
            if not isinstance(value, dict) or not {name for name in kind if name in known} <= set(
                value
            ) <= set(known):
                return False
            return all(_is(each, kind[known[name]]) for name, each in value.items())
    size = len(value) if isinstance(value, list) else -1
    fits = size == kind[1] if kind[1:] == [2] else size >= len(kind) - 1
    return fits and all(_is(one, kind[0]) for one in value)


def read_archive(
    path: Path,
    wanted: str,
    version: int,
    kinds: Mapping[str, Kind],
    names: Callable[[Mapping[str, Any]], Iterable[str]],
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Manifest and arrays of a file of a format that matches its hash.

    Entries of the manifest are of these `kinds`; `names` gives from it the names of all arrays, in their
    order. FileFault, or what parsing raises, if the file is missing, damaged, altered, or of another format
    or version.
    """
    members = read_members(path)
    what = "network" if wanted in (TRAINED, COUNTERS) else "netlist"
    if missing := sorted({"manifest", "sha256"} - set(members)):
        raise FileFault(f"is not a {what} (no {' and no '.join(missing)})")
    text = members.pop("manifest")
    written = str(members.pop("sha256"))
    manifest = json.loads(str(text))
    kind = manifest.get("format") if isinstance(manifest, dict) else None
    if not _is_shallow(manifest, DEPTH):
        raise FileFault(f"has a manifest of lists more than {DEPTH} deep")
    if isinstance(kind, str) and kind in FORMATS and kind != wanted:
        raise FileFault(f"holds {FORMATS[kind]}, this is for {FORMATS.get(wanted, wanted)}")
    if kind != wanted:
        raise FileFault(f"is not a {what}")
    if (found := manifest.get("version")) != version:
        raise FileFault(
            f"has format version {found!r:.40}, this program reads {version}: another spikeloom wrote it"
        )
    require_none(entry_faults(manifest, kinds))
    expected = tuple(names(manifest))
    if odd := sorted(set(expected) ^ set(members)):
        raise FileFault(f"has missing or unknown members ({', '.join(odd)})")
    if digest({"manifest": text, **{name: members[name] for name in expected}}) != written:
        raise FileFault("its content does not match its hash, so it was altered")
    return manifest, members


def require_none(faults: Iterable[str]) -> None:
    """Refuse a file for what is wrong in it: FileFault."""
    if faults := list(faults):
        raise FileFault("; ".join(faults))
