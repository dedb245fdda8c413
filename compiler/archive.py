"""Archives of arrays: an uncompressed ``.npz`` with a JSON manifest and a hash, which numpy alone can read.

What all netlist files share, whatever chip they are for. Equal members give equal bytes: they are stored, not
compressed, in the order given and with a fixed date. Nothing is ever pickled.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import MOST_CLOCKS, MOST_STEPS
from spikeloom.compiler.errors import FormatError, ModelError
from spikeloom.compiler.files import write_atomically

Array = np.ndarray[Any, Any]

TRAINED = "spikeloom-native"
"""Trained in the whole numbers of a chip."""

COUNTERS = "spikeloom-counters"
"""A counting network."""

FORMATS = {
    "spikeloom-netlist": "cores of compartments (Loihi)",
    "spikeloom-crossbars": "crossbar cores (TrueNorth)",
    TRAINED: "a network trained for TrueNorth, not yet compiled",
    COUNTERS: "a counting network, not yet compiled",
}
"""What a manifest may say that an archive is."""

AGAIN = "copy or train it again"

SIZE_LIMIT = 2**32
"""Bytes that a netlist file may have, 4 GiB: some hundred times the synapses of a whole chip."""

ZIP_DATE = (1980, 1, 1, 0, 0, 0)
"""Of every member of a zip, so that equal content gives equal bytes."""


def narrow(array: Array) -> Array:
    """The same numbers in the narrowest little-endian signed type that holds them; real numbers as float64."""
    if array.dtype.kind == "f":
        return array.astype("<f8")
    for dtype in ("<i1", "<i2", "<i4"):
        info = np.iinfo(dtype)
        if not array.size or (info.min <= array.min() and array.max() <= info.max):
            return array.astype(dtype)
    return array.astype("<i8")


def digest(members: Mapping[str, Array]) -> str:
    """Hex sha256 over name, dtype, shape and bytes of each member, in their order."""
    found = hashlib.sha256()
    for name, array in members.items():
        found.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def arrays_digest(arrays: Mapping[str, Array]) -> str:
    """The same in the order of their names."""
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
    """Content of a file: the manifest, the arrays in their order, and the hash over all of them."""
    members: dict[str, Array] = {"manifest": np.array(json.dumps(manifest, sort_keys=True))}
    members |= {name: narrow(array) for name, array in arrays.items()}
    members["sha256"] = np.array(digest(members))
    return zip_bytes({f"{name}.npy": npy_bytes(array) for name, array in members.items()})


def write_archive(content: bytes, path: str | os.PathLike[str]) -> str:
    """Write a file, whole or not at all; return its sha256."""
    with write_atomically(path) as file:
        file.write(content)
    return hashlib.sha256(content).hexdigest()


def stored_members(content: bytes) -> dict[str, bytes]:
    """Members of a zip that stores them plainly and claims no more bytes than it has, else ValueError."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            declared = sum(info.file_size for info in infos)
            if declared > len(content) or any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise ValueError(f"has compressed members, {len(content)} bytes claim to hold {declared}")
            return {info.filename: archive.read(info) for info in infos}
    except Exception as error:
        raise ValueError(str(error)) from error


def read_npy(content: bytes) -> Array:
    """An array of plain numbers or text from an npy file, whose size is checked against its header, else ValueError."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # numpy parses the header as Python and raises whatever that does
        raise ValueError(f"no array: {error}") from error
    held, wanted = len(content) - file.tell(), math.prod(shape) * dtype.itemsize
    if version != (1, 0) or dtype.hasobject or fortran or min(shape, default=1) < 0 or held != wanted:
        raise ValueError(f"an array of objects, not in C order, or of {wanted} bytes in {held}")
    return np.frombuffer(content, dtype, offset=file.tell()).reshape(shape) if wanted else np.zeros(shape, dtype)


def read_members(path: Path) -> dict[str, Array]:
    """All members of an archive by name; FormatError if it is too large, truncated, compressed or no such archive."""
    if path.stat().st_size > SIZE_LIMIT:
        raise FormatError(f"{path}: {path.stat().st_size} bytes, {SIZE_LIMIT} allowed; this is no netlist of one chip")
    try:
        members = stored_members(path.read_bytes())
        return {name.removesuffix(".npy"): read_npy(content) for name, content in members.items()}
    except ValueError as error:
        raise FormatError(f"{path}: is truncated or not a netlist ({error}); compile it again") from error


def stated(path: Path, name: str) -> str | None:
    """What the manifest of an archive says of `name`, None where there is no such thing; nothing else is read."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("manifest.npy") as member:
            manifest = json.loads(str(np.lib.format.read_array(member, allow_pickle=False)))
    except Exception:  # zipfile and numpy raise whatever they meet; a header may announce more than the memory holds
        return None
    found = manifest.get(name) if isinstance(manifest, dict) else None
    return found if isinstance(found, str) else None


def is_netlist(path: str | os.PathLike[str]) -> bool:
    """Whether a file claims to be a netlist: an archive with a manifest, or a name that ends in ``.loom``."""
    return str(path).endswith(".loom") or stated(Path(path), "format") not in (None, COUNTERS)


Kind = type | tuple[int, int] | frozenset[str] | dict[str, Any] | list[Any]
"""What an entry of a manifest must be: of a type (``float``: from 0, finite), a whole number within bounds (both
allowed), one of some words, an object of exactly these entries (``NAME?`` may be missing), or a list of such things,
``[kind, ...]`` of at least one, ``[kind, 2]`` of two."""

GRAPH: Kind = {"name": str, "edges": [[(0, 2**31), 2]]}

CLOCKS: Kind = {"channels": (0, MOST_CLOCKS), "steps": (1, MOST_STEPS), "length?": (1, MOST_STEPS)}


def entry_faults(manifest: Mapping[str, Any], kinds: Mapping[str, Kind]) -> list[str]:
    """Entries of a manifest that are missing or of another kind.

    Examples
    --------
    >>> entry_faults({"taxels": 0, "layers": ["fc1"]}, {"taxels": (1, 9), "layers": [str], "target": str})
    ['the manifest has no usable taxels', 'the manifest has no usable target']
    """
    return [f"the manifest has no usable {name}" for name, kind in kinds.items() if not _is(manifest.get(name), kind)]


def array_faults(arrays: Mapping[str, Array], axes: Mapping[str, int], floats: Iterable[str] = ()) -> list[str]:
    """Arrays with other axes than one, or than `axes` says, and those that are no integers, or `floats` no reals."""
    found = []
    for name, array in arrays.items():
        due, kind = axes.get(name, 1), "f" if name in floats else "i"
        if (array.ndim, array.dtype.kind) != (due, kind):
            shape = ("list", "table", "block")[due - 1]
            found.append(f"{name} is no {shape} of {'numbers' if kind == 'f' else 'integers'}")
    return found


def _is(value: Any, kind: Kind) -> bool:
    match kind:
        case type():
            return (
                isinstance(value, kind) if kind is not float else type(value) in (int, float) and 0 <= value < math.inf
            )
        case tuple():
            return type(value) is int and kind[0] <= value <= kind[1]
        case frozenset():
            return isinstance(value, str) and value in kind
        case dict():
            known = {name.removesuffix("?"): name for name in kind}
            if not isinstance(value, dict) or not {name for name in kind if name in known} <= set(value) <= set(known):
                return False
            return all(_is(each, kind[known[name]]) for name, each in value.items())
    size = len(value) if isinstance(value, list) else -1
    fits = size == kind[1] if kind[1:] == [2] else size >= len(kind) - 1
    return fits and all(_is(one, kind[0]) for one in value)


def read_archive(
    path: Path, wanted: str, version: int, names: Callable[[Mapping[str, Any]], Iterable[str]]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Manifest and arrays of a file of a format, one of ``FORMATS``, that matches its hash.

    `names` gives from the manifest the names of all arrays, in their order. FormatError if the file is missing,
    truncated, altered, or of another format or version.
    """
    if not path.is_file():
        found = "is not a file" if path.exists() else "no such file"
        raise FormatError(f"{path}: {found}; write one with spikeloom compile")
    members = read_members(path)
    if missing := sorted({"manifest", "sha256"} - set(members)):
        raise FormatError(f"{path}: is not a netlist (no {' and no '.join(missing)}); write one with spikeloom compile")
    text, written = members.pop("manifest"), str(members.pop("sha256"))
    try:
        manifest = json.loads(str(text))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: has an unreadable manifest; compile it again") from error
    kind = manifest.get("format") if isinstance(manifest, dict) else None
    if isinstance(kind, str) and kind in FORMATS and kind != wanted:
        raise FormatError(f"{path}: holds {FORMATS[kind]}, this is for {FORMATS[wanted]}; give such a file")
    if kind != wanted:
        raise FormatError(f"{path}: is not a netlist; write one with spikeloom compile")
    if manifest.get("version") != version:
        raise FormatError(
            f"{path}: has format version {manifest.get('version')}, this program reads {version}; compile it again or "
            "update spikeloom"
        )
    expected = tuple(names(manifest))
    if odd := sorted(set(expected) ^ set(members)):
        raise FormatError(f"{path}: has missing or unknown members ({', '.join(odd)}); compile it again")
    if digest({"manifest": text, **{name: members[name] for name in expected}}) != written:
        raise FormatError(f"{path}: its content does not match its hash, so it was altered; compile it again")
    return manifest, members


def read_trained_archive(
    path: Path,
    wanted: str,
    version: int,
    kinds: Mapping[str, Kind],
    names: Callable[[Mapping[str, Any]], Iterable[str]],
) -> tuple[dict[str, Any], dict[str, Array]]:
    """The same of a network that is not compiled, whose entries are of these kinds; ModelError instead."""

    def checked(manifest: Mapping[str, Any]) -> Iterable[str]:
        require_none(path, entry_faults(manifest, kinds))
        return names(manifest)

    try:
        return read_archive(path, wanted, version, checked)
    except FormatError as error:
        said = str(error).rpartition("; ")[0].replace("netlist", "network")  # without the remedy, which is a netlist's
        raise ModelError(f"{said}; {AGAIN}") from error


def require_none(path: Path, faults: Iterable[str]) -> None:
    """Refuse a network that is not compiled for what is wrong in its file."""
    if faults := list(faults):
        raise ModelError(f"{path}: {'; '.join(faults)}; {AGAIN}")
