"""Netlist to one file and back: an uncompressed ``.npz`` that numpy alone can read, without pickle.

Members, format version 2
-------------------------
``manifest``
    JSON text (0-d string): ``format`` ("spikeloom-netlist"), ``version``, ``target``, ``taxels``, ``polarities``,
    ``classes``, ``layers`` (one object per :class:`netlist.Layer`) and ``provenance``.
``sha256``
    Hex digest (0-d string) over all other members in the order below: name, dtype, shape and bytes of each.
Version 3 is for networks with currents that outlast their step, or with clocks: each layer has ``alpha``, and the
manifest ``clocks`` (``channels`` and ``steps``), see :mod:`compiler.dynamics`. Version 4 is for networks whose steps
join bins of the recordings: as version 3, and ``bins``.

every array field of :class:`netlist.Netlist`
    Under its own name and meaning, in the narrowest little-endian signed type that holds it; ``scale`` as float64.

Equal netlists give equal bytes: members are stored, not compressed, in a fixed order and with a fixed date.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import Array, archive_bytes, read_archive, write_archive
from spikeloom.compiler.dynamics import MOST_CLOCKS, MOST_STEPS, NO_CLOCKS, Clocks
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import frozen, read_only, read_only_float
from spikeloom.compiler.targets.base import COMPARTMENTS, known_targets
from spikeloom.compiler.targets.loihi1.netlist import Layer, Netlist

FORMAT = "spikeloom-netlist"
VERSIONS = (2, 3, 4)
"""Of a usual netlist, of one with current decay or clocks, and of one whose steps join bins."""

LARGE = frozenset({"synapse_target", "synapse_weight"})
"""Arrays that stay in the type that they are stored in."""

FLOATS = frozenset({"scale"})
"""Array members of real numbers."""

_SCALARS = ("target", "taxels", "polarities", "classes", "layers", "provenance", "clocks", "bins")
ARRAYS = tuple(field.name for field in fields(Netlist) if field.name not in _SCALARS)
"""Array members in file order."""


def manifest_of(netlist: Netlist) -> dict[str, Any]:
    """What a netlist says beside its arrays, as JSON values."""
    timed = bool(netlist.clocks.channels or any(layer.alpha for layer in netlist.layers))
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSIONS[2] if netlist.bins > 1 else VERSIONS[timed],
        "target": netlist.target,
        "taxels": netlist.taxels,
        "polarities": netlist.polarities,
        "classes": netlist.classes,
        "layers": [asdict(layer) for layer in netlist.layers],
        "provenance": dict(netlist.provenance),
    }
    if netlist.bins > 1:
        manifest["bins"] = netlist.bins
    if timed or netlist.bins > 1:
        manifest["clocks"] = asdict(netlist.clocks)
    else:
        for layer in manifest["layers"]:
            del layer["alpha"]
    return manifest


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
        If it is missing, truncated, altered, from a newer version or inconsistent.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    return netlist_of(path, *read_archive(path, FORMAT, VERSIONS, ARRAYS))


def netlist_of(path: Path, manifest: dict[str, Any], members: Mapping[str, Array]) -> Netlist:
    """Put a netlist together from what a file holds, and check it.

    Parameters
    ----------
    path : Path
        For messages.
    manifest : JSON object
        As :func:`manifest_of` gives it; format and version are known to be ours.
    members : mapping of str to array
        Every one of ``ARRAYS``.

    Raises
    ------
    FormatError
        If it is inconsistent.
    """
    if manifest["version"] == VERSIONS[0]:
        manifest = _widened(manifest)
    if manifest["version"] < VERSIONS[2]:
        manifest = manifest | {"bins": 1}
    faults = _type_faults(manifest, members)
    if faults:
        raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
    if manifest["target"] not in known_targets(COMPARTMENTS):
        known = ", ".join(known_targets(COMPARTMENTS))
        raise FormatError(f"{path}: is for {manifest['target']!r}, this program knows {known}; update spikeloom")
    netlist = Netlist(
        target=manifest["target"],
        taxels=manifest["taxels"],
        polarities=manifest["polarities"],
        classes=manifest["classes"],
        layers=tuple(Layer(**(layer | {"unheard": tuple(layer["unheard"])})) for layer in manifest["layers"]),
        provenance=manifest["provenance"],
        clocks=Clocks(**manifest["clocks"]),
        bins=manifest["bins"],
        scale=read_only_float(members["scale"]),
        **{name: (frozen if name in LARGE else read_only)(members[name]) for name in ARRAYS if name not in FLOATS},
    )
    faults = inconsistencies(netlist)
    if faults:
        raise FormatError(f"{path}: {'; '.join(faults)}; compile it again")
    return netlist


def _widened(manifest: dict[str, Any]) -> dict[str, Any]:
    """A manifest of the first version with what the second adds."""
    layers = manifest.get("layers")
    if isinstance(layers, list):
        layers = [layer | {"alpha": 0.0} if isinstance(layer, dict) else layer for layer in layers]
    return manifest | {"clocks": asdict(NO_CLOCKS), "layers": layers}


def _type_faults(manifest: dict[str, Any], members: Mapping[str, Array]) -> list[str]:
    """Say which entries of the manifest or which arrays are missing or of another kind than :class:`Netlist` asks."""
    layers = manifest.get("layers")
    entries = {
        "target": isinstance(manifest.get("target"), str),
        "provenance": isinstance(manifest.get("provenance"), dict),
        "layers": isinstance(layers, list) and bool(layers) and all(map(_is_layer, layers)),
        "clocks": _are_clocks(manifest.get("clocks")),
        "bins": _is(manifest.get("bins"), "int", 1) and manifest["bins"] <= MOST_STEPS,
    }
    entries |= {name: _is(manifest.get(name), "int", 1) for name in ("taxels", "polarities", "classes")}
    faults = [f"the manifest has no usable {name}" for name, good in entries.items() if not good]
    return faults + [
        f"{name} is no list of {'numbers' if name in FLOATS else 'integers'}"
        for name in ARRAYS
        if members[name].ndim != 1 or members[name].dtype.kind != ("f" if name in FLOATS else "i")
    ]


def _is(value: Any, kind: str, least: float = -math.inf) -> bool:
    """Whether a JSON value is of a kind (a number where a float is asked for may be whole) and finite."""
    if kind == "str":
        return isinstance(value, str)
    numbers = (int, float) if kind == "float" else (int,)
    return isinstance(value, numbers) and not isinstance(value, bool) and least <= value < math.inf


def _are_clocks(entry: Any) -> bool:
    if not isinstance(entry, dict) or set(entry) != {"channels", "steps"}:
        return False
    channels, steps = entry["channels"], entry["steps"]
    return _is(channels, "int", 0) and _is(steps, "int", 1) and channels <= MOST_CLOCKS and steps <= MOST_STEPS


def _is_layer(entry: Any) -> bool:
    wanted = {field.name: str(field.type) for field in fields(Layer)}
    if not isinstance(entry, dict) or set(entry) != set(wanted):
        return False
    listed = entry["unheard"]
    if not isinstance(listed, list) or not all(_is(neuron, "int", 0) for neuron in listed):
        return False
    return all(_is(entry[name], kind, 0) for name, kind in wanted.items() if name != "unheard")


def _bounds_fault(name: str, bounds: Array, parts: int, total: int) -> str | None:
    good = len(bounds) == parts + 1 and bounds[0] == 0 and bounds[-1] == total and np.all(np.diff(bounds) >= 0)
    return None if good else f"{name} does not divide {total} entries in {parts} parts"


def inconsistencies(netlist: Netlist) -> list[str]:
    """Say what in a netlist points nowhere: a file can match its hash and still be nonsense."""
    compartments, axons, synapses = netlist.n_compartments, netlist.n_axons, netlist.n_synapses
    found: list[str | None] = [
        _bounds_fault("core_compartments", netlist.core_compartments, netlist.n_cores, compartments),
        _bounds_fault("core_axons", netlist.core_axons, netlist.n_cores, axons),
        _bounds_fault("axon_synapses", netlist.axon_synapses, axons, synapses),
    ]
    per_compartment = ("neuron", "decay_u", "decay_v", "threshold", "bias_mantissa", "bias_exponent", "scale")
    for name in (*per_compartment, "readout_class"):
        if len(getattr(netlist, name)) != compartments:
            found.append(f"{name} has {len(getattr(netlist, name))} entries for {compartments} compartments")
    if len(netlist.axon_format) != axons or len(netlist.synapse_target) != synapses:
        found.append("axon_format or synapse_target has the wrong length")
    if not len(netlist.format_exponent) == len(netlist.format_weight_bits) == len(netlist.format_index_bits):
        found.append("the format arrays have different lengths")
    if any(found):
        return [fault for fault in found if fault]

    def outside(array: Array, low: int, high: int) -> bool:
        return bool(array.size and (array.min() < low or array.max() >= high))

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
    found += [
        f"{name} has values outside {low} … {high - 1}"
        for name, (a, low, high) in ranges.items()
        if outside(a, low, high)
    ]
    if not np.all(np.isfinite(netlist.scale) & (netlist.scale > 0)):
        found.append("scale has values that are not positive numbers")
    on_core = np.diff(netlist.core_compartments)[netlist.core_of_axon()][netlist.axon_of_synapse()]
    if outside(netlist.synapse_target, 0, 2**31) or np.any(netlist.synapse_target >= on_core):
        found.append("synapse_target points beyond its core")
    for index, layer in enumerate(netlist.layers):
        neurons = np.sort(netlist.neuron[netlist.layer == index])
        if np.intersect1d(neurons, layer.unheard).size or max(layer.unheard, default=0) >= layer.neurons:
            found.append(f"layer {layer.name} holds neurons that it leaves out, or leaves out some that are not there")
        if outside(neurons, 0, layer.neurons) or len(np.unique(neurons)) != len(neurons) or not len(neurons):
            found.append(
                f"layer {layer.name} holds none of its {layer.neurons} neurons, one twice or one that is not there"
            )
    return [fault for fault in found if fault]
