"""Stable printed form of netlists and layouts, see :mod:`compiler.text`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout.choose import Layout
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.text import digest, sensor, span

_COMPARTMENT_FIELDS = (
    "layer",
    "neuron",
    "decay_u",
    "decay_v",
    "threshold",
    "bias_mantissa",
    "bias_exponent",
    "scale",
    "readout_class",
)


def netlist_text(netlist: Netlist) -> str:
    """Print a netlist without its provenance; equal text means equal content (arrays appear as ranges and hashes)."""
    return "\n".join(_netlist_lines(netlist)) + "\n"


def layout_text(layout: Layout, network: IntegerNetwork) -> str:
    """Print which neurons of a network each core holds."""
    lines = []
    for core, (chunks, tile) in enumerate(zip(layout.parts.cores, layout.placement.tiles, strict=True)):
        names = (f"{network.populations[chunk.population].name} {chunk.first}…{chunk.last - 1}" for chunk in chunks)
        lines.append(f"(core {core} (tile {tile}) (neurons {', '.join(names)}))\n")
    return "".join(lines)


def _netlist_lines(netlist: Netlist) -> Iterator[str]:
    given = sensor(netlist.taxels, netlist.polarities, netlist.clocks)
    yield f"(netlist {netlist.target} (input {given}) (classes {netlist.classes})"
    for layer in netlist.layers:
        alpha = f"(alpha {layer.alpha!r}) " if layer.alpha else ""
        yield (
            f"  (layer {layer.name} (neurons {layer.neurons}) (depth {layer.depth}) (beta {layer.beta!r}) "
            f"(theta {layer.theta!r}) {alpha}(bits {layer.weight_bits}) "
            f"(synapses {layer.synapses}) (fan_in {layer.max_fan_in}))"
        )
    formats = zip(netlist.format_weight_bits, netlist.format_exponent, netlist.format_index_bits, strict=True)
    for i, (bits, exponent, index_bits) in enumerate(formats):
        yield f"  (format {i} (bits {bits}) (exponent {exponent}) (index_bits {index_bits}))"
    for core in range(netlist.n_cores):
        first, last = netlist.core_compartments[core : core + 2]
        axons = slice(*netlist.core_axons[core : core + 2])
        synapses = slice(*netlist.axon_synapses[list(netlist.core_axons[core : core + 2])])
        held = [
            f"{netlist.layers[i].name} {span(netlist.neuron[first:last][netlist.layer[first:last] == i])}"
            for i in np.unique(netlist.layer[first:last])
        ]
        inside = [getattr(netlist, name)[first:last] for name in _COMPARTMENT_FIELDS]
        ends = netlist.axon_synapses[axons.start : axons.stop + 1]
        yield (
            f"  (core {core} (tile {netlist.core_tile[core]}) "
            f"(compartments {last - first}: {', '.join(held)} #{digest(*inside)}) "
            f"(axons {axons.stop - axons.start} "
            f"#{digest(netlist.axon_source[axons], netlist.axon_format[axons], ends)}) "
            f"(synapses {synapses.stop - synapses.start} "
            f"#{digest(netlist.synapse_target[synapses], netlist.synapse_weight[synapses])}))"
        )
    yield ")"
