"""File of a netlist, version 5: its layers are objects with the fields of :class:`netlist.Layer`."""

from __future__ import annotations

from typing import Any

import numpy as np

from spikeloom.compiler.archive import Kind
from spikeloom.compiler.dynamics import MOST_STEPS
from spikeloom.compiler.targets.base import COMPARTMENTS
from spikeloom.compiler.targets.loihi1.netlist import PER_COMPARTMENT, Layer, Netlist
from spikeloom.compiler.targets.netlist_file import NetlistFile, bounds_faults, is_outside, length_faults, range_faults

LAYER: Kind = {
    "name": str,
    "unread": [(0, 2**31)],
    **dict.fromkeys(("neurons", "depth", "weight_bits", "synapses", "max_fan_in"), (0, 2**62)),
    **dict.fromkeys(("beta", "theta", "alpha"), float),
}
"""Entries of :class:`netlist.Layer`."""


def inconsistencies(netlist: Netlist) -> list[str]:
    """Say what in a netlist points nowhere: a file can match its hash and still be nonsense."""
    compartments, axons, synapses = netlist.n_compartments, netlist.n_axons, netlist.n_synapses
    formats = len(netlist.format_exponent)
    bounds = {
        "core_compartments": (netlist.n_cores, compartments),
        "core_axons": (netlist.n_cores, axons),
        "axon_synapses": (axons, synapses),
    }
    lengths = dict.fromkeys(PER_COMPARTMENT, compartments) | {"axon_format": axons, "synapse_target": synapses}
    lengths |= {"format_weight_bits": formats, "format_index_bits": formats}
    found = bounds_faults(netlist, bounds) + length_faults(netlist, lengths)
    if found:
        return found
    ranges = {
        "layer": (0, len(netlist.layers)),
        "axon_source": (0, netlist.n_inputs + compartments),
        "axon_format": (0, formats),
        "readout_class": (-1, netlist.classes),
        "decay_u": (0, 4096),
        "decay_v": (0, 4096),
        "threshold": (0, 2**17),
        "bias_mantissa": (-4096, 4096),
        "bias_exponent": (0, 8),
        "synapse_weight": (-256, 256),
        "format_weight_bits": (1, 9),
        "format_exponent": (-1, 8),
        "format_index_bits": (0, 13),
        "core_tile": (0, 2**31),
    }
    found = range_faults(netlist, ranges)
    if not np.all(np.isfinite(netlist.scale) & (netlist.scale > 0)):
        found.append("scale has values that are not positive numbers")
    on_core = np.diff(netlist.core_compartments)[netlist.core_of_axon()][netlist.axon_of_synapse()]
    if is_outside(netlist.synapse_target, 0, 2**31) or np.any(netlist.synapse_target >= on_core):
        found.append("synapse_target points beyond its core")
    for index, layer in enumerate(netlist.layers):
        neurons = np.sort(netlist.neuron[netlist.layer == index])
        if np.intersect1d(neurons, layer.unread).size or max(layer.unread, default=0) >= layer.neurons:
            found.append(f"layer {layer.name} holds neurons that it leaves out, or leaves out some that are not there")
        if is_outside(neurons, 0, layer.neurons) or len(np.unique(neurons)) != len(neurons) or not len(neurons):
            found.append(
                f"layer {layer.name} holds none of its {layer.neurons} neurons, one twice or one that is not there"
            )
    return found


def _layer(entry: dict[str, Any]) -> Layer:
    return Layer(**(entry | {"unread": tuple(entry["unread"])}))


FILE = NetlistFile(
    format="spikeloom-netlist",
    version=5,
    cores=COMPARTMENTS,
    netlist=Netlist,
    entries={"layers": [LAYER, ...], "bins": (1, MOST_STEPS)},
    layer=_layer,
    inconsistencies=inconsistencies,
    floats=frozenset({"scale"}),
    as_stored=frozenset({"synapse_target", "synapse_weight"}),
)

netlist_bytes, write_netlist, read_netlist = FILE.content, FILE.write, FILE.read
