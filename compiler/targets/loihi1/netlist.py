"""The netlist: cores, compartments, axons and synapses as flat integer arrays, and its file.

Ids
---
*Compartments* are numbered ``0 … n_compartments-1``, core after core; those of core ``k`` are
``core_compartments[k] … core_compartments[k+1]-1``. *Axons* (input axons, one synapse list each) are numbered the
same way through ``core_axons``; the synapses of axon ``a`` are ``axon_synapses[a] … axon_synapses[a+1]-1``.

An axon listens to one *source*, a single integer: ``0 … n_inputs-1`` is an input channel (channel ``taxel *
polarities + polarity``, then the clocks), ``n_inputs + c`` is compartment ``c``. The output axons of a
compartment are the axons that name it as source; they are not stored a second time.

A synapse targets compartment ``synapse_target`` *of its core* (0-based within the core) with the signed
mantissa ``synapse_weight``; it adds ``mantissa * 2**exponent`` of its list's format, shifted left by six, to
the target's synaptic sum. A list whose format has ``index_bits == 0`` is dense: it stores one weight for
every compartment from its first target to its last, zeros included. Lists are written out for every axon;
those of a core that differ by a shift alone are one in its memory, which :func:`legalize.stored_once` finds
again.

Time
----
At chip step ``t`` an axon carries a spike if its input channel has an event in data step ``t``, or if its source
compartment spiked in chip step ``t - 1``. A compartment of a layer of depth ``d`` integrates in the steps
``d … d + T - 1`` of a recording of ``T`` steps and is held at zero, silent, outside them. Where the netlist has blank
steps, all compartments always integrate, and a recording is followed by so many steps without input.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.archive import Kind
from spikeloom.compiler.dynamics import MOST_STEPS, NO_CLOCKS, Clocks
from spikeloom.compiler.targets.loihi1.registers import (
    DECAY_ONE,
    in_units,
)
from spikeloom.compiler.targets.netlist_file import (
    MOST,
    AxonNetlist,
    NetlistFile,
    column_faults,
    is_outside,
    part_of,
)
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray

MOST_BLANK = 4096
"""Blank steps after a recording."""

PER_COMPARTMENT = (
    *(
        "neuron",
        "decay_u",
        "decay_v",
        "threshold",
        "bias_mantissa",
        "bias_exponent",
        "scale",
        "readout_class",
    ),
)
"""Arrays of a netlist, beside ``layer``, with an entry for each compartment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One population of the network, as the netlist remembers it."""

    name: str  # ``conv1``, ``fc1`` …
    neurons: int  # Neurons of the float model's layer; the chip may hold fewer compartments
    unread: tuple[
        int, ...
    ]  # Neurons left out as their spikes reach no neuron; others that are missing cannot fire
    depth: int  # Steps that the layer lags behind the data
    beta: float  # Decay of the float model
    theta: float  # Its threshold
    weight_bits: int  # Storage width of the mantissas
    synapses: int  # Structural synapses into the layer, before zeros were dropped
    max_fan_in: int  # Largest structural fan-in of a neuron
    alpha: float = 0.0  # Current decay of the float model


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Netlist(AxonNetlist):
    """A placed integer network; see the module docstring for ids and time."""

    target: str
    taxels: int
    polarities: int
    classes: int
    layers: tuple[Layer, ...]  # In order of depth; ``readout_class`` says which of them votes
    core_tile: IntArray  # (cores,) int64; tile of each core, row-major on the mesh: ``x = tile % width``
    # core_compartments, core_axons: (cores + 1,) int64; range bounds, see above
    core_compartments: IntArray
    core_axons: IntArray
    # layer, neuron: (compartments,) int64; which neuron of which layer a compartment is
    layer: IntArray
    neuron: IntArray
    decay_u: IntArray  # (compartments,) int64; register: the current loses ``(decay_u + 1)/4096`` a step
    decay_v: IntArray  # (compartments,) int64; register: the membrane loses ``decay_v/4096`` a step
    threshold: IntArray  # (compartments,) int64; mantissa; a spike needs ``v > 64 * threshold``
    # (compartments,) int64; ``mantissa * 2**exponent`` is added to the membrane, unshifted
    bias_mantissa: IntArray
    bias_exponent: IntArray
    # (compartments,) float64; weight units (mantissa times 2**exponent) per unit of the float model's
    # membrane, which is register / (64 * scale); no register of the chip
    scale: FloatArray
    readout_class: IntArray  # (compartments,) int64; class that a spike votes for, -1 for none
    # axon_source, axon_format: (axons,) int64; source id and synapse format of each axon
    axon_source: IntArray
    axon_format: IntArray
    axon_synapses: IntArray  # (axons + 1,) int64; range bounds into the synapses
    # (synapses,) of the narrowest integer type: compartment within the core, and mantissa
    synapse_target: IntArray
    synapse_weight: IntArray
    # (formats,) int64; synapse formats of the whole netlist, of which a core uses some
    format_weight_bits: IntArray
    format_exponent: IntArray
    format_index_bits: IntArray
    provenance: Mapping[str, Any]  # checkpoint hash, graph, options, version
    clocks: Clocks = NO_CLOCKS
    bins: int = 1
    blank: int = 0  # Blank steps after each recording; 0 where layers have windows

    @property
    def n_cores(self) -> int:
        """Number of cores in use."""
        return len(self.core_tile)

    @property
    def n_compartments(self) -> int:
        """Number of compartments on all cores."""
        return len(self.layer)

    @property
    def n_axons(self) -> int:
        """Number of input axons on all cores."""
        return len(self.axon_source)

    @property
    def n_synapses(self) -> int:
        """Number of stored synapses, zeros in dense lists included."""
        return len(self.synapse_weight)

    @property
    def max_depth(self) -> int:
        """Steps that the slowest layer lags behind the data."""
        return max(layer.depth for layer in self.layers)

    @property
    def drain(self) -> int:
        """Chip steps of a recording after those of its data."""
        return self.blank or self.max_depth

    @property
    def begins(self) -> IntArray:
        """Chip step of a recording from which each layer integrates, before 0 where all always do; (layers,)."""
        return np.array([-self.blank or layer.depth for layer in self.layers])

    @property
    def keep_u(self) -> IntArray:
        """What a step keeps of each current, in 1/4096; shape (compartments,)."""
        return DECAY_ONE - 1 - self.decay_u

    @property
    def keep_v(self) -> IntArray:
        """What a step keeps of each membrane, in 1/4096; shape (compartments,)."""
        return DECAY_ONE - self.decay_v

    @property
    def bias(self) -> IntArray:
        """``mantissa * 2**exponent``, membrane units; shape (compartments,)."""
        return self.bias_mantissa << self.bias_exponent

    def compartments_of(self, layer: int) -> IntArray:
        """Compartment ids of a layer, ordered by neuron; shape (compartments of the layer,)."""
        ids = np.flatnonzero(self.layer == layer)
        return ids[np.argsort(self.neuron[ids], kind="stable")]

    @property
    def absent(self) -> tuple[BoolArray, ...]:
        """Neurons of each layer, (neurons,) bool, without a compartment."""
        present = (self.neuron[self.compartments_of(index)] for index in range(len(self.layers)))
        return tuple(
            ~np.isin(np.arange(layer.neurons), neurons)
            for layer, neurons in zip(self.layers, present, strict=True)
        )

    def number_in_layer(self) -> IntArray:
        """Place of each compartment among those of its layer; shape (compartments,)."""
        order = np.lexsort((self.neuron, self.layer))
        return order.argsort() - np.searchsorted(self.layer[order], self.layer)

    def core_of_compartment(self) -> IntArray:
        """Core of each compartment; shape (compartments,)."""
        return part_of(self.core_compartments)

    def synapses_of(self, core: int) -> tuple[IntArray, IntArray, IntArray]:
        """Synapses of one core: source, compartment and effective weight of each; all (synapses of the core,) int64."""
        axons = slice(*self.core_axons[core : core + 2].tolist())
        ends = self.axon_synapses[axons.start : axons.stop + 1]
        stored = slice(*ends[[0, -1]].tolist())
        length = np.diff(ends)
        exponent = np.repeat(self.format_exponent[self.axon_format[axons]], length)
        return (
            np.repeat(self.axon_source[axons], length),
            self.synapse_target[stored] + self.core_compartments[core],
            in_units(self.synapse_weight[stored], exponent),
        )

    def effective_weight(self) -> IntArray:
        """``mantissa * 2**exponent`` of each synapse; shape (synapses,). Exact: at exponent -1 mantissas are even."""
        exponent = self.format_exponent[self.axon_format[self.axon_of_synapse()]]
        return in_units(self.synapse_weight, exponent)

    def synapse_compartment(self) -> IntArray:
        """Compartment id that each synapse targets; shape (synapses,)."""
        base = self.core_compartments[self.core_of_axon()]
        return self.synapse_target + base[self.axon_of_synapse()]


LAYER: Kind = {
    "name": str,
    "unread": [(0, MOST)],
    **dict.fromkeys(("neurons", "depth", "max_fan_in"), (0, MOST)),
    "weight_bits": (1, 8),
    "synapses": (0, MOST**2),
    **dict.fromkeys(("beta", "theta", "alpha"), float),
}
"""Entries of :class:`Layer` in a file."""


def inconsistencies(netlist: Netlist) -> list[str]:
    """Say what in a netlist points nowhere: a file can match its hash and still be nonsense."""
    compartments = netlist.n_compartments
    axons = netlist.n_axons
    synapses = netlist.n_synapses
    formats = len(netlist.format_exponent)
    bounds = {
        "core_compartments": (netlist.n_cores, compartments),
        "core_axons": (netlist.n_cores, axons),
        "axon_synapses": (axons, synapses),
    }
    lengths = dict.fromkeys(PER_COMPARTMENT, compartments) | {
        "axon_format": axons,
        "synapse_target": synapses,
    }
    lengths |= {"format_weight_bits": formats, "format_index_bits": formats}
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
        "core_tile": (0, 2**16),
    }
    if found := column_faults(netlist, bounds, lengths, ranges):
        return found
    if not np.all(np.isfinite(netlist.scale) & (netlist.scale > 0)):
        found.append("scale has values that are not positive numbers")
    some = np.flatnonzero(np.diff(netlist.axon_synapses))
    highest = np.maximum.reduceat(netlist.synapse_target, netlist.axon_synapses[some]) if len(some) else some
    on_core = np.diff(netlist.core_compartments)[netlist.core_of_axon()[some]]
    if is_outside(netlist.synapse_target, 0, 2**31) or np.any(highest >= on_core):
        found.append("synapse_target points beyond its core")
    if 0 < netlist.blank < netlist.max_depth:
        found.append(f"{netlist.blank} blank steps follow a recording, layers lag up to {netlist.max_depth}")
    for index, layer in enumerate(netlist.layers):
        if layer.depth >= len(netlist.layers):
            found.append(
                f"layer {layer.name} lags {layer.depth} steps behind, with {len(netlist.layers)} layers"
            )
        neurons = np.sort(netlist.neuron[netlist.layer == index])
        if np.intersect1d(neurons, layer.unread).size or max(layer.unread, default=0) >= layer.neurons:
            found.append(
                f"layer {layer.name} holds neurons that it leaves out, or leaves out some that are not there"
            )
        if (
            is_outside(neurons, 0, layer.neurons)
            or len(np.unique(neurons)) != len(neurons)
            or not len(neurons)
        ):
            found.append(
                f"layer {layer.name} holds none of its {layer.neurons} neurons, one twice or one that is not there"
            )
    return found


def _layer(entry: dict[str, Any]) -> Layer:
    return Layer(**(entry | {"unread": tuple(entry["unread"])}))


FILE = NetlistFile(
    format="spikeloom-netlist",
    version=5,
    targets=("loihi1",),
    netlist=Netlist,
    entries={"layers": [LAYER, ...], "bins": (1, MOST_STEPS)},
    optional={"blank": (1, MOST_BLANK)},
    layer=_layer,
    inconsistencies=inconsistencies,
    floats=frozenset({"scale"}),
    as_stored=frozenset({"synapse_target", "synapse_weight"}),
)

netlist_bytes, write_netlist, read_netlist = FILE.content, FILE.write, FILE.read
