"""Netlist to one file and back: an uncompressed ``.npz`` that numpy alone can read, without pickle.

Members, format version 5
-------------------------
``manifest``
    JSON text (0-d string): ``format`` ("spikeloom-netlist"), ``version``, ``target``, ``taxels``, ``polarities``,
    ``classes``, ``layers`` (one object per :class:`netlist.Layer`), ``clocks`` (``channels`` and ``steps``, see
    :mod:`compiler.dynamics`), ``bins`` (of the recordings, to a step) and ``provenance``.
``sha256``
    Hex digest (0-d string) over all other members in the order below: name, dtype, shape and bytes of each.

every array field of :class:`netlist.Netlist`
    Under its own name and meaning, in the narrowest little-endian signed type that holds it; ``scale`` as float64.

Equal netlists give equal bytes: members are stored, not compressed, in a fixed order and with a fixed date.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import (
    CLOCKS,
    Array,
    Kind,
    archive_bytes,
    bounds_faults,
    entry_faults,
    is_outside,
    range_faults,
    read_archive,
    write_archive,
)
from spikeloom.compiler.dynamics import MOST_STEPS, Clocks
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import frozen, read_only, read_only_float
from spikeloom.compiler.targets.base import COMPARTMENTS, known_targets
from spikeloom.compiler.targets.loihi1.netlist import Layer, Netlist
from spikeloom.compiler.types import JsonObject

FORMAT, VERSION = "spikeloom-netlist", 5

LARGE = frozenset({"synapse_target", "synapse_weight"})
"""Arrays that stay in the type that they are stored in."""

FLOATS = frozenset({"scale"})
"""Array members of real numbers."""

LAYER: Kind = {
    "name": str,
    "unreceived": [(0, 2**31)],
    **dict.fromkeys(("neurons", "depth", "weight_bits", "synapses", "max_fan_in"), (0, 2**62)),
    **dict.fromkeys(("beta", "theta", "alpha"), float),
}
"""Entries of :class:`netlist.Layer`."""

_SCALARS = ("target", "taxels", "polarities", "classes", "layers", "provenance", "clocks", "bins")
ARRAYS = tuple(field.name for field in fields(Netlist) if field.name not in _SCALARS)
"""Array members in file order."""


def manifest_of(netlist: Netlist) -> JsonObject:
    """What a netlist says beside its arrays, as JSON values."""
    values = {name: getattr(netlist, name) for name in ("target", "taxels", "polarities", "classes", "bins")}
    return values | {
        "format": FORMAT,
        "version": VERSION,
        "layers": [asdict(layer) for layer in netlist.layers],
        "clocks": asdict(netlist.clocks),
        "provenance": dict(netlist.provenance),
    }


def netlist_bytes(netlist: Netlist) -> bytes:
    """File content of a netlist; equal netlists give equal bytes."""
    return archive_bytes(manifest_of(netlist), {name: getattr(netlist, name) for name in ARRAYS})


def write_netlist(netlist: Netlist, path: str | os.PathLike[str]) -> str:
    """Write a netlist, whole or not at all; return the sha256 of the file.

    Raises
    ------
    OSError
        If the file cannot be written; an older file is left as it was.
    """
    return write_archive(netlist_bytes(netlist), path)


def read_netlist(path: str | os.PathLike[str]) -> Netlist:
    """Read and check a netlist file.

    Raises
    ------
    FormatError
        If it is missing, truncated, altered, of another version or inconsistent.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    manifest, members = read_archive(path, FORMAT, (VERSION,), lambda _: ARRAYS)
    if faults := _type_faults(manifest, members):
        raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
    if manifest["target"] not in known_targets(COMPARTMENTS):
        known = ", ".join(known_targets(COMPARTMENTS))
        raise FormatError(f"{path}: is for {manifest['target']!r}, this program knows {known}; update spikeloom")
    stated = {name: manifest[name] for name in ("target", "taxels", "polarities", "classes", "bins", "provenance")}
    arrays: dict[str, Any] = {
        name: (frozen if name in LARGE else read_only)(members[name]) for name in ARRAYS if name not in FLOATS
    }
    netlist = Netlist(
        **stated,
        layers=tuple(Layer(**(layer | {"unreceived": tuple(layer["unreceived"])})) for layer in manifest["layers"]),
        clocks=Clocks(**manifest["clocks"]),
        scale=read_only_float(members["scale"]),
        **arrays,
    )
    if faults := inconsistencies(netlist):
        raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
    return netlist


def _type_faults(manifest: Mapping[str, Any], members: Mapping[str, Array]) -> list[str]:
    """Entries of the manifest or arrays that are missing or of another kind than :class:`Netlist` has."""
    counts = dict.fromkeys(("taxels", "polarities", "classes"), (1, 2**31))
    faults = entry_faults(
        manifest,
        {
            "target": str,
            "provenance": dict,
            "layers": [LAYER, ...],
            "clocks": CLOCKS,
            "bins": (1, MOST_STEPS),
            **counts,
        },
    )
    return faults + [
        f"{name} is no list of {'numbers' if name in FLOATS else 'integers'}"
        for name in ARRAYS
        if members[name].ndim != 1 or members[name].dtype.kind != ("f" if name in FLOATS else "i")
    ]


def inconsistencies(netlist: Netlist) -> list[str]:
    """Say what in a netlist points nowhere: a file can match its hash and still be nonsense."""
    compartments, axons, synapses = netlist.n_compartments, netlist.n_axons, netlist.n_synapses
    found = bounds_faults(
        {
            "core_compartments": (netlist.core_compartments, netlist.n_cores, compartments),
            "core_axons": (netlist.core_axons, netlist.n_cores, axons),
            "axon_synapses": (netlist.axon_synapses, axons, synapses),
        }
    )
    per_compartment = ("neuron", "decay_u", "decay_v", "threshold", "bias_mantissa", "bias_exponent", "scale")
    for name in (*per_compartment, "readout_class"):
        if len(getattr(netlist, name)) != compartments:
            found.append(f"{name} has {len(getattr(netlist, name))} entries for {compartments} compartments")
    if len(netlist.axon_format) != axons or len(netlist.synapse_target) != synapses:
        found.append("axon_format or synapse_target has the wrong length")
    if not len(netlist.format_exponent) == len(netlist.format_weight_bits) == len(netlist.format_index_bits):
        found.append("the format arrays have different lengths")
    if found:
        return found
    ranges = {
        "layer": (netlist.layer, 0, len(netlist.layers)),
        "axon_source": (netlist.axon_source, 0, netlist.n_inputs + compartments),
        "axon_format": (netlist.axon_format, 0, len(netlist.format_exponent)),
        "readout_class": (netlist.readout_class, -1, netlist.classes),
        "decay_u": (netlist.decay_u, 0, 4096),
        "decay_v": (netlist.decay_v, 0, 4096),
        "threshold": (netlist.threshold, 0, 2**17),
        "bias_mantissa": (netlist.bias_mantissa, -4096, 4096),
        "bias_exponent": (netlist.bias_exponent, 0, 8),
        "synapse_weight": (netlist.synapse_weight, -256, 256),
        "format_weight_bits": (netlist.format_weight_bits, 1, 9),
        "format_exponent": (netlist.format_exponent, -1, 8),
        "format_index_bits": (netlist.format_index_bits, 0, 13),
        "core_tile": (netlist.core_tile, 0, 2**31),
    }
    found += range_faults(ranges)
    if not np.all(np.isfinite(netlist.scale) & (netlist.scale > 0)):
        found.append("scale has values that are not positive numbers")
    on_core = np.diff(netlist.core_compartments)[netlist.core_of_axon()][netlist.axon_of_synapse()]
    if is_outside(netlist.synapse_target, 0, 2**31) or np.any(netlist.synapse_target >= on_core):
        found.append("synapse_target points beyond its core")
    for index, layer in enumerate(netlist.layers):
        neurons = np.sort(netlist.neuron[netlist.layer == index])
        if np.intersect1d(neurons, layer.unreceived).size or max(layer.unreceived, default=0) >= layer.neurons:
            found.append(f"layer {layer.name} holds neurons that it leaves out, or leaves out some that are not there")
        if is_outside(neurons, 0, layer.neurons) or len(np.unique(neurons)) != len(neurons) or not len(neurons):
            found.append(
                f"layer {layer.name} holds none of its {layer.neurons} neurons, one twice or one that is not there"
            )
    return found
