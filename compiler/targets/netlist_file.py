"""Netlist to one file and back, whatever its chip: an uncompressed ``.npz`` that numpy alone can read, without pickle.

``manifest``
    JSON text (0-d string): ``format``, ``version``, and every field of the netlist that is no array.
every array field
    Under its own name and meaning, in the narrowest little-endian signed type that holds it; real numbers as
    float64.
``sha256``
    Hex digest (0-d string) over all other members in this order: name, dtype, shape and bytes of each.

Equal netlists give equal bytes: members are stored, not compressed, in a fixed order and with a fixed date.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from spikeloom.compiler import archive, invariants
from spikeloom.compiler.arrays import frozen, read_only, read_only_float
from spikeloom.compiler.dynamics import MOST_STEPS, Clocks
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.files import FileFault, reading
from spikeloom.compiler.types import IntArray, JsonObject

N = TypeVar("N")

MOST = 2**20
"""Input channels, classes, neurons of a layer: hundreds of times what a chip holds."""

COMMON: dict[str, archive.Kind] = {
    "target": str,
    "provenance": dict,
    "clocks": archive.CLOCKS,
    **dict.fromkeys(("taxels", "polarities", "classes"), (1, MOST)),
}
"""Entries of every manifest."""


ORIGIN = ("data", "train_sha256", "calibrated_sha256", "bin_s", "window", "steps")
"""What a netlist remembers of the recordings behind a network, beside names and places."""


def names_of(training: Mapping[str, Any] | None, classes: int) -> list[str] | None:
    """Names of the classes of a network, if it knows one for each."""
    names: list[str] | None = origin_of(training).get("class_names")
    return names if names is None or len(names) == classes else None


def origin_of(training: Mapping[str, Any] | None) -> JsonObject:
    """What a netlist remembers of the recordings behind a network.

    Their name and hash, the hash of others that chose its storage, their bins if they were events, per cent of each or
    steps that trained it if not all did, where the taxels were and how classes are called, if that was said; no value
    that a netlist may not have.
    """
    said = training or {}
    usable = [name for name in ORIGIN if not archive.entry_faults(said, {name: PROVENANCE[name]})]
    origin = {name: said[name] for name in usable}
    places = said.get("positions_mm")
    if isinstance(places, list) and all(
        isinstance(each, list) and {*map(type, each)} <= {int, float} for each in places
    ):
        origin["positions_mm"] = places
    names = said.get("class_names")
    if isinstance(names, list | tuple) and names and all(isinstance(name, str) for name in names):
        origin["class_names"] = list(names)
    return origin


PROVENANCE: dict[str, archive.Kind] = {
    **dict.fromkeys(
        (
            "spikeloom",
            "checkpoint_sha256",
            "train_sha256",
            "calibrated_sha256",
            "format",
            "graph",
            "weights",
            "convention",
            "data",
        ),
        str,
    ),
    **dict.fromkeys(("run", "towers", "chips"), (0, MOST)),
    **dict.fromkeys(("dt", "bin_s"), float),
    **dict.fromkeys(("keep_all", "prune_unused", "spike_exact", "calibrated"), bool),
    "window": (1, 100),
    "steps": (1, MOST_STEPS),
    "compensated": [str],
}
"""What else is read of a provenance, where it says so; ``digests`` are those of each layer by what they are of."""


def provenance_faults(provenance: Mapping[str, Any]) -> list[str]:
    """Entries of a provenance that are of another kind."""
    said = {name: kind for name, kind in PROVENANCE.items() if provenance.get(name) is not None}
    digests = provenance.get("digests") or {}
    layers = digests.values() if isinstance(digests, dict) else [None]
    texts = all(
        isinstance(each, dict) and all(isinstance(one, str) for one in each.values()) for each in layers
    )
    return [
        *archive.entry_faults(provenance, said),
        *([] if texts else ["the provenance has no usable digests"]),
    ]


class Netlist:
    """A placed network, whatever its chip: what all have."""

    __slots__ = ()

    target: str  # Name of the chip
    taxels: int  # Sensor size, and number of classes
    polarities: int
    classes: int
    readout_class: IntArray  # (neurons,) int64; class that a spike votes for, -1 for none
    provenance: Mapping[str, Any]  # JSON values only: what it was compiled from
    clocks: (
        Clocks  # Input channels that tell the time, after those of the sensor, see :mod:`compiler.dynamics`
    )
    bins: int = 1  # Bins of the recordings that make a data step

    @property
    def n_inputs(self) -> int:
        """Number of input channels."""
        return self.taxels * self.polarities + self.clocks.channels

    @property
    def voters(self) -> IntArray:
        """Neurons that vote, as they are counted in ``readout_class``; shape (voters,)."""
        return np.flatnonzero(self.readout_class >= 0)


class AxonNetlist(Netlist):
    """One whose cores have input axons, and these a list of synapses each."""

    __slots__ = ()

    core_axons: IntArray  # (cores + 1,) int64; range bounds into the axons
    axon_synapses: IntArray  # (axons + 1,) int64; range bounds into the synapses

    def core_of_axon(self) -> IntArray:
        """Core of each axon; shape (axons,)."""
        return part_of(self.core_axons)

    def axon_of_synapse(self) -> IntArray:
        """Axon of each synapse; shape (synapses,)."""
        return part_of(self.axon_synapses)


def part_of(bounds: IntArray) -> IntArray:
    """Part of each entry, of range bounds (parts + 1,).

    >>> part_of(np.array([0, 2, 2, 3])).tolist()
    [0, 0, 2]
    """
    return np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))


@dataclass(frozen=True, kw_only=True)
class NetlistFile(Generic[N]):
    """The file format of one kind of cores."""

    format: str
    version: int
    targets: tuple[str, ...]  # Chips whose netlists it holds
    netlist: type[N]  # A dataclass of arrays and of the entries
    entries: dict[str, archive.Kind]  # Of the manifest, beside the common ones; ``layers`` among them
    layer: Callable[[Any], Any]  # Makes a layer of its entry
    inconsistencies: Callable[[N], list[str]]  # What in a netlist points nowhere
    optional: dict[str, archive.Kind] = field(
        default_factory=dict
    )  # Entries that are left out where they are zero
    floats: frozenset[str] = frozenset()  # Arrays of real numbers
    tables: frozenset[str] = frozenset()  # Arrays of two axes
    as_stored: frozenset[str] = frozenset()  # Large arrays that stay in the type that they are stored in

    @property
    def arrays(self) -> tuple[str, ...]:
        """Array members in file order."""
        kind: Any = self.netlist
        return tuple(
            each.name for each in fields(kind) if each.name not in COMMON | self.entries | self.optional
        )

    def verify(self, netlist: N) -> None:
        """Check every rule of a netlist that a pass made; VerifyError names all that are broken."""
        invariants.require_none(self.inconsistencies(netlist))

    def content(self, netlist: N) -> bytes:
        """File content of a netlist; equal netlists give equal bytes."""
        manifest = {name: getattr(netlist, name) for name in COMMON | self.entries}
        manifest |= {name: value for name in self.optional if (value := getattr(netlist, name))}
        manifest |= {
            "format": self.format,
            "version": self.version,
            "layers": [layer if isinstance(layer, str) else asdict(layer) for layer in manifest["layers"]],
            "clocks": manifest["clocks"].to_json(),
            "provenance": dict(manifest["provenance"]),
        }
        return archive.archive_bytes(manifest, {name: getattr(netlist, name) for name in self.arrays})

    def write(self, netlist: N, path: str | os.PathLike[str]) -> str:
        """Write a netlist, whole or not at all; return the sha256 of the file.

        OSError if the file cannot be written; an older file is left as it was.
        """
        return archive.write_archive(self.content(netlist), path)

    def read(self, path: str | os.PathLike[str]) -> N:
        """Read and check a netlist file.

        FormatError if it is missing, unreadable, damaged, altered, of another version or inconsistent.
        """
        path = Path(path)
        with reading(path, FormatError, "write it with spikeloom compile"):
            kinds = COMMON | self.entries
            manifest, members = archive.read_archive(
                path, self.format, self.version, kinds, lambda _: self.arrays
            )
            further = {name: kind for name, kind in self.optional.items() if name in manifest}
            archive.require_none(archive.entry_faults(manifest, further))
            archive.require_none(provenance_faults(manifest["provenance"]))
            if manifest["taxels"] * manifest["polarities"] > MOST:
                raise FileFault(f"has more than {MOST} input channels")
            archive.require_none(archive.array_faults(members, dict.fromkeys(self.tables, 2), self.floats))
            if manifest["target"] not in self.targets:
                raise FileFault(
                    f"is for {manifest['target'][:40]!r}, this program knows {', '.join(self.targets)}"
                )
            values = {name: manifest[name] for name in kinds | further}
            values |= {
                "clocks": Clocks(**values["clocks"]),
                "layers": tuple(map(self.layer, values["layers"])),
            }
            netlist = self.netlist(
                **values, **{name: self._held(name, members[name]) for name in self.arrays}
            )
            archive.require_none(self.inconsistencies(netlist))
        return netlist

    def _held(self, name: str, array: archive.Array) -> archive.Array:
        if name in self.as_stored:
            return frozen(array)
        return read_only_float(array) if name in self.floats else read_only(array)


def column_faults(
    netlist: Any,
    bounds: Mapping[str, tuple[int, int]],
    lengths: Mapping[str, int],
    ranges: Mapping[str, tuple[int, int]],
) -> list[str]:
    """What is wrong about single arrays of a netlist, by their names; values are looked at where all sizes are right.

    Range `bounds` must divide so many entries in so many parts (parts, entries); `lengths` are those of the
    other arrays; `ranges` of values do not hold their upper end.
    """
    wrong = []
    for name, (parts, total) in bounds.items():
        ends = getattr(netlist, name)
        if len(ends) != parts + 1 or ends[0] != 0 or ends[-1] != total or np.any(np.diff(ends) < 0):
            wrong.append(f"{name} does not divide {total} entries in {parts} parts")
    for name, length in lengths.items():
        if (held := len(getattr(netlist, name))) != length:
            wrong.append(f"{name} has {held} entries, {length} are needed")
    outside = (
        f"{name} has values outside {low} … {high - 1}"
        for name, (low, high) in ranges.items()
        if is_outside(getattr(netlist, name), low, high)
    )
    return wrong or list(outside)


def is_outside(array: archive.Array, low: int, high: int) -> bool:
    """Whether an array has values below `low`, or `high` and above."""
    return bool(array.size and (array.min() < low or array.max() >= high))
