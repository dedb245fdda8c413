"""Netlist to one file and back, whatever its chip: an uncompressed ``.npz`` that numpy alone can read, without pickle.

``manifest``
    JSON text (0-d string): ``format``, ``version``, and every field of the netlist that is no array.
every array field
    Under its own name and meaning, in the narrowest little-endian signed type that holds it; real numbers as float64.
``sha256``
    Hex digest (0-d string) over all other members in this order: name, dtype, shape and bytes of each.

Equal netlists give equal bytes: members are stored, not compressed, in a fixed order and with a fixed date.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from spikeloom.compiler.archive import CLOCKS, Array, Kind, archive_bytes, entry_faults, read_archive, write_archive
from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import frozen, read_only, read_only_float
from spikeloom.compiler.targets.base import known_targets
from spikeloom.compiler.types import IntArray

N = TypeVar("N")

COMMON: dict[str, Kind] = {
    "target": str,
    "provenance": dict,
    "clocks": CLOCKS,
    **dict.fromkeys(("taxels", "polarities", "classes"), (1, 2**31)),
}
"""Entries of every manifest."""


class Netlist(Protocol):
    """A placed network, whatever its chip."""

    @property
    def target(self) -> str:
        """Name of the chip."""

    @property
    def taxels(self) -> int:
        """Of the sensor."""

    @property
    def polarities(self) -> int:
        """Input channels of a taxel."""

    @property
    def bins(self) -> int:
        """Bins of the recordings that make a data step."""

    @property
    def classes(self) -> int:
        """What it tells apart."""

    @property
    def readout_class(self) -> IntArray:
        """Class that each neuron of the chip votes for, -1 for none."""

    @property
    def clocks(self) -> Clocks:
        """Channels after those of the sensor."""

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What it was compiled from."""


@dataclass(frozen=True, kw_only=True)
class NetlistFile(Generic[N]):
    """The file format of one kind of cores."""

    format: str
    version: int
    cores: str  # Kind that the target must have
    netlist: type[N]  # A dataclass of arrays and of the entries
    entries: dict[str, Kind]  # Of the manifest, beside the common ones; ``layers`` among them
    layer: Callable[[Any], Any]  # Makes a layer of its entry
    inconsistencies: Callable[[N], list[str]]  # What in a netlist points nowhere
    floats: frozenset[str] = frozenset()  # Arrays of real numbers
    tables: frozenset[str] = frozenset()  # Arrays of two axes
    as_stored: frozenset[str] = frozenset()  # Large arrays that stay in the type that they are stored in

    @property
    def arrays(self) -> tuple[str, ...]:
        """Array members in file order."""
        kind: Any = self.netlist
        return tuple(field.name for field in fields(kind) if field.name not in COMMON | self.entries)

    def content(self, netlist: N) -> bytes:
        """File content of a netlist; equal netlists give equal bytes."""
        manifest = {name: getattr(netlist, name) for name in COMMON | self.entries}
        manifest |= {
            "format": self.format,
            "version": self.version,
            "layers": [layer if isinstance(layer, str) else asdict(layer) for layer in manifest["layers"]],
            "clocks": asdict(manifest["clocks"]),
            "provenance": dict(manifest["provenance"]),
        }
        return archive_bytes(manifest, {name: getattr(netlist, name) for name in self.arrays})

    def write(self, netlist: N, path: str | os.PathLike[str]) -> str:
        """Write a netlist, whole or not at all; return the sha256 of the file.

        OSError if the file cannot be written; an older file is left as it was.
        """
        return write_archive(self.content(netlist), path)

    def read(self, path: str | os.PathLike[str]) -> N:
        """Read and check a netlist file.

        FormatError if it is missing, truncated, altered, of another version or inconsistent; OSError if it cannot be
        read.
        """
        path = Path(path)
        manifest, members = read_archive(path, self.format, self.version, lambda _: self.arrays)
        faults = entry_faults(manifest, COMMON | self.entries)
        faults += [fault for name in self.arrays if (fault := self._array_fault(name, members[name]))]
        if faults:
            raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
        if manifest["target"] not in (known := known_targets(self.cores)):
            raise FormatError(
                f"{path}: is for {manifest['target']!r}, this program knows {', '.join(known)}; update spikeloom"
            )
        values = {name: manifest[name] for name in COMMON | self.entries}
        values |= {"clocks": Clocks(**values["clocks"]), "layers": tuple(map(self.layer, values["layers"]))}
        netlist = self.netlist(**values, **{name: self._held(name, members[name]) for name in self.arrays})
        if faults := self.inconsistencies(netlist):
            raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
        return netlist

    def _array_fault(self, name: str, array: Array) -> str | None:
        axes, kind = 1 + (name in self.tables), "f" if name in self.floats else "i"
        if (array.ndim, array.dtype.kind) == (axes, kind):
            return None
        return f"{name} is no {('list', 'table')[axes - 1]} of {'numbers' if kind == 'f' else 'integers'}"

    def _held(self, name: str, array: Array) -> Array:
        if name in self.as_stored:
            return frozen(array)
        return read_only_float(array) if name in self.floats else read_only(array)


def bounds_faults(netlist: Any, bounds: Mapping[str, tuple[int, int]]) -> list[str]:
    """Arrays of range bounds that do not divide all entries; by name, with the numbers of parts and of entries."""
    found = []
    for name, (parts, total) in bounds.items():
        ends = getattr(netlist, name)
        if len(ends) != parts + 1 or ends[0] != 0 or ends[-1] != total or np.any(np.diff(ends) < 0):
            found.append(f"{name} does not divide {total} entries in {parts} parts")
    return found


def length_faults(netlist: Any, lengths: Mapping[str, int]) -> list[str]:
    """Arrays, by name with their lengths, that have another one."""
    return [
        f"{name} has {len(getattr(netlist, name))} entries, {length} are needed"
        for name, length in lengths.items()
        if len(getattr(netlist, name)) != length
    ]


def range_faults(netlist: Any, ranges: Mapping[str, tuple[int, int]]) -> list[str]:
    """Arrays, by name with their ranges (the upper end is not in it), that have values outside."""
    return [
        f"{name} has values outside {low} … {high - 1}"
        for name, (low, high) in ranges.items()
        if is_outside(getattr(netlist, name), low, high)
    ]


def is_outside(array: Array, low: int, high: int) -> bool:
    """Whether an array has values below `low`, or `high` and above."""
    return bool(array.size and (array.min() < low or array.max() >= high))
