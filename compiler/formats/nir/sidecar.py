"""The side-car of a NIR file: what NIR cannot say about a netlist, as JSON beside it, and the netlist back from it.

``x.nir.json`` beside ``x.nir`` has

``format``, ``version``
    "spikeloom-nir-sidecar", 1.
``nir_sha256``, ``loom_sha256``
    Of the NIR file that it belongs to, and of the netlist file that it restores.
``dt``, ``convention``
    Time step in seconds that the NIR file is to be read in, and how its time constants become decays.
``units``
    What the numbers of the NIR file count in, for people.
``manifest``, ``arrays``
    The netlist, as :mod:`loihi1.netlist_file` names its parts: arrays are lists of numbers.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.formats.archive import require_manifest
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import (
    ARRAYS,
    FLOATS,
    VERSIONS,
    manifest_of,
    netlist_bytes,
    netlist_of,
)
from spikeloom.compiler.targets.loihi1.netlist_file import FORMAT as NETLIST

FORMAT = "spikeloom-nir-sidecar"
VERSION = 1

SIZE_LIMIT = 2**29
"""Bytes of a side-car that are read."""

UNITS = (
    "weights and thresholds of the NIR file are in weight units, biases in 64ths of them; divide by scale for the "
    "units of the trained model"
)

_REMEDY = "remove it to read the NIR file alone, or export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Said:
    """What a side-car says about how its NIR file is to be read."""

    dt: float
    convention: str


def sidecar_of(path: str | os.PathLike[str]) -> Path:
    """Where the side-car of a NIR file is.

    Examples
    --------
    >>> sidecar_of("nets/a.nir").name
    'a.nir.json'
    """
    return Path(f"{os.fspath(path)}.json")


def sidecar_bytes(netlist: Netlist, nir: bytes, *, dt: float, convention: str) -> bytes:
    """Content of the side-car of a NIR file that was made of a netlist."""
    values = {
        "format": FORMAT,
        "version": VERSION,
        "nir_sha256": hashlib.sha256(nir).hexdigest(),
        "loom_sha256": hashlib.sha256(netlist_bytes(netlist)).hexdigest(),
        "dt": dt,
        "convention": convention,
        "units": UNITS,
        "manifest": manifest_of(netlist),
        "arrays": {name: getattr(netlist, name).tolist() for name in ARRAYS},
    }
    return (json.dumps(values, sort_keys=True, allow_nan=False) + "\n").encode()


def _read(path: Path, conventions: tuple[str, ...]) -> dict[str, Any]:
    size = path.stat().st_size
    if size > SIZE_LIMIT:
        raise FormatError(f"{path}: has {size} bytes, {SIZE_LIMIT} are allowed; {_REMEDY}")
    try:
        values = json.loads(path.read_bytes())
    except (ValueError, RecursionError, MemoryError) as error:
        raise FormatError(f"{path}: is truncated or no JSON; {_REMEDY}") from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise FormatError(f"{path}: is no side-car of a NIR file; {_REMEDY}")
    if values.get("version") != VERSION:
        raise FormatError(
            f"{path}: has version {str(values.get('version'))[:20]}, this program reads {VERSION}; update spikeloom"
        )
    dt, hashes = values.get("dt"), (values.get("nir_sha256"), values.get("loom_sha256"))
    usable = isinstance(dt, float | int) and not isinstance(dt, bool) and 0 < dt < math.inf
    if not usable or values.get("convention") not in conventions or not all(isinstance(h, str) for h in hashes):
        raise FormatError(f"{path}: has no usable time step, convention or hash; {_REMEDY}")
    return values


def read_said(nir: str | os.PathLike[str], conventions: tuple[str, ...]) -> Said | None:
    """What the side-car of a NIR file says, or None where there is none.

    Raises
    ------
    FormatError
        If it is damaged, or belongs to another file.
    """
    path = sidecar_of(nir)
    if not path.is_file() or not Path(nir).is_file():
        return None
    values = _checked(path, Path(nir), conventions)
    return Said(dt=float(values["dt"]), convention=values["convention"])


def _checked(path: Path, nir: Path, conventions: tuple[str, ...]) -> dict[str, Any]:
    values = _read(path, conventions)
    with nir.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != values["nir_sha256"]:
        raise FormatError(f"{path}: belongs to another {nir.name} (its hash differs, so it was changed); {_REMEDY}")
    return values


def restore(nir: str | os.PathLike[str], conventions: tuple[str, ...]) -> Netlist:
    """The netlist that a NIR file was made of, from its side-car: the same to the last byte of its file.

    Raises
    ------
    FormatError
        If the side-car is damaged or belongs to another file.
    """
    path = sidecar_of(nir)
    values = _checked(path, Path(nir), conventions)
    arrays = values.get("arrays")
    if not isinstance(arrays, dict) or set(arrays) != set(ARRAYS):
        raise FormatError(f"{path}: has missing or unknown arrays; {_REMEDY}")
    members = {name: _array(path, name, arrays[name]) for name in ARRAYS}
    netlist = netlist_of(path, require_manifest(path, values.get("manifest"), NETLIST, VERSIONS), members)
    if hashlib.sha256(netlist_bytes(netlist)).hexdigest() != values["loom_sha256"]:
        raise FormatError(f"{path}: its content does not match its hash, so it was altered; {_REMEDY}")
    return netlist


def _array(path: Path, name: str, entry: Any) -> np.ndarray[Any, Any]:
    kinds = (int, float) if name in FLOATS else (int,)
    if not isinstance(entry, list) or any(type(value) not in kinds for value in entry):
        raise FormatError(f"{path}: {name} is no list of numbers; {_REMEDY}")
    try:
        return np.array(entry, np.float64 if name in FLOATS else np.int64)
    except OverflowError as error:
        raise FormatError(f"{path}: {name} has numbers that no register holds; {_REMEDY}") from error
