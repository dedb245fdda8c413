"""Network of crossbar cores to one file and back; the archive of :mod:`compiler.archive`.

Members, format version 1: the ``manifest`` (``format`` "spikeloom-crossbars", ``version``, ``target``, ``taxels``,
``polarities``, ``classes``, ``bin_ticks``, ``layers``, ``clocks``, ``provenance``), every array field of
:class:`netlist.CrossbarNetlist` under its own name, and the ``sha256``. A file may break the rules
of its chip, which :mod:`truenorth.legalize` lists; what is refused here is what means nothing at all.
"""

from __future__ import annotations

import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import (
    CLOCKS,
    Array,
    archive_bytes,
    bounds_faults,
    entry_faults,
    range_faults,
    read_archive,
    write_archive,
)
from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.errors import FormatError
from spikeloom.compiler.fixedpoint import read_only
from spikeloom.compiler.targets.base import CROSSBARS, known_targets
from spikeloom.compiler.targets.truenorth.netlist import AXON_TYPES, PER_NEURON, CrossbarNetlist

FORMAT = "spikeloom-crossbars"
VERSIONS = (1,)

_SCALARS = ("target", "taxels", "polarities", "classes", "bin_ticks", "layers", "provenance", "clocks")
ARRAYS = tuple(field.name for field in fields(CrossbarNetlist) if field.name not in _SCALARS)
"""Array members in file order."""

MOST_TICKS = 2**20
"""Ticks that a data step may take, or that a feed or a vote may come late."""

TABLES = {
    "wire": ("wire_neuron", "wire_x", "wire_y", "wire_line", "wire_delay"),
    "feed": ("feed_channel", "feed_core", "feed_line", "feed_tick"),
    "clock": ("clock_core", "clock_line", "clock_period", "clock_phase"),
}
"""Columns of each table of rows."""


def crossbar_bytes(netlist: CrossbarNetlist) -> bytes:
    """File content of a network; equal networks give equal bytes."""
    manifest = {
        "format": FORMAT,
        "version": VERSIONS[0],
        **{name: getattr(netlist, name) for name in ("target", "taxels", "polarities", "classes", "bin_ticks")},
        "layers": list(netlist.layers),
        "clocks": asdict(netlist.clocks),
        "provenance": dict(netlist.provenance),
    }
    return archive_bytes(manifest, {name: getattr(netlist, name) for name in ARRAYS})


def write_crossbars(netlist: CrossbarNetlist, path: str | os.PathLike[str]) -> str:
    """Write a network, whole or not at all; return the sha256 of the file.

    Raises
    ------
    OSError
        If the file cannot be written; an older file is left as it was.
    """
    return write_archive(crossbar_bytes(netlist), path)


def read_crossbars(path: str | os.PathLike[str]) -> CrossbarNetlist:
    """Read and check a file of crossbar cores.

    Raises
    ------
    FormatError
        If it is missing, truncated, altered, from a newer version or inconsistent.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    manifest, members = read_archive(path, FORMAT, VERSIONS, lambda _: ARRAYS)
    wrong = _kind_faults(manifest, members)
    if not wrong and manifest["target"] not in known_targets(CROSSBARS):
        wrong = [f"it is for {manifest['target']!r}, known are {', '.join(known_targets(CROSSBARS))}"]
    if wrong:
        raise FormatError(f"{path}: {'; '.join(wrong)}; compile it again")
    arrays: dict[str, Any] = {name: read_only(members[name]) for name in ARRAYS}
    netlist = CrossbarNetlist(
        **{name: manifest[name] for name in ("target", "taxels", "polarities", "classes", "bin_ticks", "provenance")},
        layers=tuple(manifest["layers"]),
        clocks=Clocks(**manifest["clocks"]),
        **arrays,
    )
    wrong = inconsistencies(netlist)
    if wrong:
        raise FormatError(f"{path}: {'; '.join(wrong)}; compile it again")
    return netlist


def _kind_faults(manifest: dict[str, Any], members: dict[str, Array]) -> list[str]:
    """What in the manifest or among the arrays is missing or of another kind."""
    counts = dict.fromkeys(("taxels", "polarities", "classes"), (1, 2**31))
    kinds = {
        "target": str,
        "provenance": dict,
        "layers": [str],
        "clocks": CLOCKS,
        "bin_ticks": (1, MOST_TICKS),
        **counts,
    }
    return entry_faults(manifest, kinds) + [
        f"{name} is no {'table' if name == 'weight' else 'list'} of integers"
        for name in ARRAYS
        if members[name].ndim != 1 + (name == "weight") or members[name].dtype.kind != "i"
    ]


def inconsistencies(netlist: CrossbarNetlist) -> list[str]:
    """Say what in a network points nowhere, so that nothing could be made of it."""
    cores, neurons, axons = netlist.n_cores, netlist.n_neurons, netlist.n_axons
    bounds = {
        "core_neurons": (netlist.core_neurons, cores, neurons),
        "core_axons": (netlist.core_axons, cores, axons),
        "axon_synapses": (netlist.axon_synapses, axons, netlist.n_synapses),
    }
    found = bounds_faults(bounds)
    lengths = {"core_y": cores, "axon_type": axons, **dict.fromkeys(PER_NEURON, neurons)}
    lengths |= {name: len(getattr(netlist, columns[0])) for columns in TABLES.values() for name in columns}
    for name, length in lengths.items():
        if len(getattr(netlist, name)) != length:
            found.append(f"{name} has {len(getattr(netlist, name))} entries, {length} are needed")
    if netlist.weight.shape != (neurons, AXON_TYPES):
        found.append(f"weight is {' by '.join(map(str, netlist.weight.shape))}, not {neurons} by {AXON_TYPES}")
    if found:
        return found
    ranges = {
        "layer": (0, len(netlist.layers)),
        "neuron": (0, 2**31),
        "readout_class": (-1, netlist.classes),
        "readout_first": (0, MOST_TICKS),
        "wire_neuron": (0, neurons),
        "feed_channel": (0, netlist.n_inputs),
        "feed_tick": (-MOST_TICKS, MOST_TICKS),
    }
    registers = [name for name in ARRAYS if name not in ranges and name not in bounds]
    ranges |= dict.fromkeys(registers, (-(2**31), 2**31))
    found += range_faults({name: (getattr(netlist, name), *ends) for name, ends in ranges.items()})
    on_core = np.diff(netlist.core_neurons)[netlist.core_of_axon()][netlist.axon_of_synapse()]
    if netlist.n_synapses and (netlist.synapse_neuron.min() < 0 or np.any(netlist.synapse_neuron >= on_core)):
        found.append("synapse_neuron points beyond its core")
    step = np.diff(netlist.synapse_neuron)
    inner = np.ones(len(step), np.bool_)
    starts = netlist.axon_synapses[1:-1]
    inner[starts[(starts > 0) & (starts < netlist.n_synapses)] - 1] = False
    if np.any(step[inner] <= 0):
        found.append("synapse_neuron does not rise along an axon")
    return found
