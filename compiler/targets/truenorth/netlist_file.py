"""File of a network of crossbar cores, version 1; it may break rules of its chip, which ``legalize`` lists."""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.targets.base import CROSSBARS
from spikeloom.compiler.targets.netlist_file import NetlistFile, bounds_faults, length_faults, range_faults
from spikeloom.compiler.targets.truenorth.netlist import AXON_TYPES, PER_NEURON, CrossbarNetlist

MOST_TICKS = 2**20
"""Ticks that a data step may take, or that a feed or a vote may come late."""

TABLES = {
    "wire": ("wire_neuron", "wire_x", "wire_y", "wire_line", "wire_delay"),
    "feed": ("feed_channel", "feed_core", "feed_line", "feed_tick"),
    "clock": ("clock_core", "clock_line", "clock_period", "clock_phase"),
}
"""Columns of each table of rows."""


def inconsistencies(netlist: CrossbarNetlist) -> list[str]:
    """Say what in a network points nowhere, so that nothing could be made of it."""
    cores, neurons, axons = netlist.n_cores, netlist.n_neurons, netlist.n_axons
    bounds = {
        "core_neurons": (cores, neurons),
        "core_axons": (cores, axons),
        "axon_synapses": (axons, netlist.n_synapses),
    }
    lengths = {"core_y": cores, "axon_type": axons, **dict.fromkeys(PER_NEURON, neurons)}
    lengths |= {name: len(getattr(netlist, columns[0])) for columns in TABLES.values() for name in columns}
    found = bounds_faults(netlist, bounds) + length_faults(netlist, lengths)
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
    registers = [name for name in FILE.arrays if name not in ranges and name not in bounds]
    ranges |= dict.fromkeys(registers, (-(2**31), 2**31))
    found = range_faults(netlist, ranges)
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


FILE = NetlistFile(
    format="spikeloom-crossbars",
    version=1,
    cores=CROSSBARS,
    netlist=CrossbarNetlist,
    entries={"layers": [str], "bin_ticks": (1, MOST_TICKS)},
    layer=str,
    inconsistencies=inconsistencies,
    tables=frozenset({"weight"}),
)

crossbar_bytes, write_crossbars, read_crossbars = FILE.content, FILE.write, FILE.read
