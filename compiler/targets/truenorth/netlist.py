"""A network on crossbar cores, as flat integer arrays, and its file; it may break rules, which ``legalize`` lists.

Ids
---
*Neurons* are numbered core after core; those of core ``k`` are ``core_neurons[k] … core_neurons[k+1]-1``, and the
first of them is neuron 0 of its core. *Axons* are numbered the same way through ``core_axons``; ``axon_line`` says
which of its core's lines an axon is. The crossing points of axon ``a`` that are set are
``axon_synapses[a] … axon_synapses[a+1]-1``, each with a neuron of the core (0-based on it). A spike on the axon adds
``weight[neuron, axon_type[axon]]`` to each of these neurons: the type belongs to the axon, the weights to the neuron.

What leads to an axon stands in tables of rows: *wires* from neurons, *feeds* from input channels, *clocks*.
The chip allows a neuron one wire only; the tables can hold more, so that :mod:`truenorth.legalize` can say
what is wrong.

Time
----
A data step takes ``bin_ticks`` ticks. An event of data step ``s`` reaches the axon of a feed in tick
``s * bin_ticks + feed_tick``. A spike of tick ``t`` reaches the axon of a wire in tick ``t + wire_delay``; spikes that
reach one axon in the same tick are one. A clock reaches its axon in the ticks ``phase, phase + period, …``. A
recording of ``T`` data steps takes ``T * bin_ticks + drain`` ticks from the initial potentials on; the spikes of a
neuron that votes count in the ticks ``readout_first … readout_first + T * bin_ticks - 1``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import MOST_STEPS, NO_CLOCKS, Clocks
from spikeloom.compiler.targets.netlist_file import COMMON, AxonNetlist, NetlistFile, column_faults, part_of
from spikeloom.compiler.types import IntArray

RESET_TO = 0
RESET_LINEAR = 1
RESET_NONE = 2
"""What a spike leaves: the reset value, the membrane less the threshold, the membrane."""

AXON_TYPES = 4
"""Columns of ``CrossbarNetlist.weight``."""

PER_NEURON = (
    *("leak", "leak_reversal", "threshold", "reset_mode", "reset", "negative_threshold"),
    *("negative_saturates", "initial", "layer", "neuron", "readout_class", "readout_first"),
)
"""Arrays with one entry a neuron, beside ``weight``."""

MOST_TICKS = 2**20
"""Ticks that a data step may take, or that a feed or a vote may come late."""

TABLES = {
    "feed": ("feed_channel", "feed_core", "feed_line", "feed_tick"),
    "clock": ("clock_core", "clock_line", "clock_period", "clock_phase"),
    "wire": ("wire_neuron", "wire_x", "wire_y", "wire_line", "wire_delay"),
}
"""Columns of each table of rows."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CrossbarNetlist(AxonNetlist):
    """A placed network of crossbar cores; see the module docstring for ids and time."""

    target: str
    taxels: int
    polarities: int
    classes: int
    bin_ticks: int  # Ticks of a data step
    layers: tuple[str, ...]  # Names; relays that copy spikes have one of their own
    # core_x, core_y: (cores,) int64; places on the mesh
    core_x: IntArray
    core_y: IntArray
    # core_neurons, core_axons: (cores + 1,) int64; range bounds, see above
    core_neurons: IntArray
    core_axons: IntArray
    # axon_line, axon_type: (axons,) int64; line on the core, and type
    axon_line: IntArray
    axon_type: IntArray
    axon_synapses: IntArray  # (axons + 1,) int64; range bounds into the crossing points
    synapse_neuron: IntArray  # (synapses,) int64; neuron on the core
    weight: IntArray  # (neurons, 4) int64; by axon type
    leak: IntArray  # (neurons,) int64; added in every tick
    leak_reversal: (
        IntArray  # (neurons,) int64; 1 where the leak takes the membrane's sign, and stops at zero
    )
    threshold: IntArray  # (neurons,) int64; a spike needs a membrane of at least this
    # reset_mode, reset: (neurons,) int64; ``RESET_TO``, ``RESET_LINEAR`` or ``RESET_NONE``, and the value of
    # the first
    reset_mode: IntArray
    reset: IntArray
    negative_threshold: (
        IntArray  # (neurons,) int64; magnitude; a membrane below ``-negative_threshold`` is reset, too
    )
    negative_saturates: (
        IntArray  # (neurons,) int64; 1 where it stays at ``-negative_threshold`` instead of being reset
    )
    initial: IntArray  # (neurons,) int64; membrane before the first tick
    # layer, neuron: (neurons,) int64; which neuron of which layer it is; copies of one share the numbers
    layer: IntArray
    neuron: IntArray
    readout_class: IntArray  # (neurons,) int64; class that a spike votes for, -1 for none
    readout_first: IntArray  # (neurons,) int64; tick from which on it does
    # (wires,) int64: from a neuron to a line of the core at a place, and ticks on the way
    wire_neuron: IntArray
    wire_x: IntArray
    wire_y: IntArray
    wire_line: IntArray
    wire_delay: IntArray
    # (feeds,) int64: from an input channel (``taxel * polarities + polarity``, then `clocks`) to a line of a
    # core
    feed_channel: IntArray
    feed_core: IntArray
    feed_line: IntArray
    feed_tick: IntArray
    # clock_core, clock_line, clock_period, clock_phase: (clocks,) int64; periodic spikes from outside
    clock_core: IntArray
    clock_line: IntArray
    clock_period: IntArray
    clock_phase: IntArray
    provenance: Mapping[str, Any]
    clocks: Clocks = NO_CLOCKS
    bins: int = 1

    @property
    def n_cores(self) -> int:
        """Number of cores in use."""
        return len(self.core_x)

    @property
    def n_neurons(self) -> int:
        """Number of neurons on all cores."""
        return len(self.leak)

    @property
    def n_axons(self) -> int:
        """Number of axons on all cores."""
        return len(self.axon_line)

    @property
    def n_synapses(self) -> int:
        """Number of crossing points that are set."""
        return len(self.synapse_neuron)

    @property
    def drain(self) -> int:
        """Ticks of a recording after those of its data: until the last vote's window ends."""
        voters = self.readout_first[self.readout_class >= 0]
        return int(voters.max(initial=0))

    def ticks(self, steps: int) -> int:
        """Ticks that a recording of so many data steps takes."""
        return steps * self.bin_ticks + self.drain

    def core_of_neuron(self) -> IntArray:
        """Core of each neuron; shape (neurons,)."""
        return part_of(self.core_neurons)

    def neuron_of_synapse(self) -> IntArray:
        """Neuron id of each crossing point; shape (synapses,)."""
        return self.synapse_neuron + self.core_neurons[self.core_of_axon()[self.axon_of_synapse()]]

    def axons_at(self, core: IntArray, line: IntArray) -> IntArray:
        """Axon on each line of a core, -1 where there is none; (n,) of (n,) cores, -1 for no core, and lines."""
        return _places((self.core_of_axon(), self.axon_line), (core, line))

    def cores_at(self, x: IntArray, y: IntArray) -> IntArray:
        """Core at each place, -1 where there is none; (n,) of (n,) coordinates."""
        return _places((self.core_x, self.core_y), (x, y))

    def aims(self) -> tuple[IntArray, IntArray, IntArray]:
        """Axons that feeds, clocks and wires lead to, -1 where there is none; (feeds,), (clocks,), (wires,)."""
        return (
            self.axons_at(self.feed_core, self.feed_line),
            self.axons_at(self.clock_core, self.clock_line),
            self.axons_at(self.cores_at(self.wire_x, self.wire_y), self.wire_line),
        )

    def hops(self) -> IntArray:
        """Cores that the spike of each wire passes, x first and then y; shape (wires,)."""
        core = self.core_of_neuron()[self.wire_neuron]
        return np.asarray(np.abs(self.core_x[core] - self.wire_x) + np.abs(self.core_y[core] - self.wire_y))


def _places(held: tuple[IntArray, IntArray], wanted: tuple[IntArray, IntArray]) -> IntArray:
    """First index at which each wanted pair is held, -1 where it is not."""
    codes, sought = (first * 2**32 + second for first, second in (held, wanted))  # both are of 32 bits
    pairs, index = np.unique(codes, return_index=True)
    if not len(pairs):
        return np.full(len(sought), -1)
    at = np.minimum(np.searchsorted(pairs, sought), len(pairs) - 1)
    return np.where(pairs[at] == sought, index[at], -1)


def inconsistencies(netlist: CrossbarNetlist) -> list[str]:
    """Say what in a network points nowhere, so that nothing could be made of it."""
    cores = netlist.n_cores
    neurons = netlist.n_neurons
    axons = netlist.n_axons
    if not neurons:
        return ["it has no neurons"]
    bounds = {
        "core_neurons": (cores, neurons),
        "core_axons": (cores, axons),
        "axon_synapses": (axons, netlist.n_synapses),
    }
    lengths = {"core_y": cores, "axon_type": axons, **dict.fromkeys(PER_NEURON, neurons)}
    lengths |= {name: len(getattr(netlist, columns[0])) for columns in TABLES.values() for name in columns}
    ranges = {
        "layer": (0, len(netlist.layers)),
        "neuron": (0, 2**31),
        "readout_class": (-1, netlist.classes),
        "readout_first": (0, MOST_TICKS),
        "wire_neuron": (0, neurons),
        "feed_channel": (0, netlist.n_inputs),
        "feed_tick": (0, MOST_TICKS),
        "clock_period": (1, 2**31),
        "clock_phase": (0, 2**31),
        "reset_mode": (RESET_TO, RESET_NONE + 1),
        "leak_reversal": (0, 2),
        "negative_saturates": (0, 2),
    }
    registers = [name for name in FILE.arrays if name not in ranges and name not in bounds]
    ranges |= dict.fromkeys(registers, (-(2**31), 2**31))
    if found := column_faults(netlist, bounds, lengths, ranges):
        return found
    if netlist.weight.shape != (neurons, AXON_TYPES):
        found.append(
            f"weight is {' by '.join(map(str, netlist.weight.shape))}, not {neurons} by {AXON_TYPES}"
        )
    on_core = np.diff(netlist.core_neurons)[netlist.core_of_axon()][netlist.axon_of_synapse()]
    if netlist.n_synapses and (
        netlist.synapse_neuron.min() < 0 or np.any(netlist.synapse_neuron >= on_core)
    ):
        found.append("synapse_neuron points beyond its core")
    if np.any((np.diff(netlist.synapse_neuron) <= 0) & (np.diff(netlist.axon_of_synapse()) == 0)):
        found.append("synapse_neuron does not rise along an axon")
    for what, aims in zip(TABLES, netlist.aims(), strict=True):
        found += [f"{what} {row} leads to no axon" for row in np.flatnonzero(aims < 0)[:1]]
    if np.any(netlist.cores_at(netlist.core_x, netlist.core_y) != np.arange(cores)):
        found.append("two cores are at one place")
    if np.any(netlist.axons_at(netlist.core_of_axon(), netlist.axon_line) != np.arange(axons)):
        found.append("two axons are on one line of a core, which has one type")
    return found


def unlike(netlist: CrossbarNetlist, due: CrossbarNetlist) -> list[str]:
    """Say what in a netlist is not as it is due, an entry for each field; what it remembers aside."""
    differing = []
    for name in (*COMMON, *FILE.entries, *FILE.arrays):
        ours = getattr(netlist, name)
        theirs = getattr(due, name)
        if name not in FILE.arrays:
            if name != "provenance" and ours != theirs:
                differing.append(f"{name} is {ours} instead of {theirs}")
        elif ours.shape != theirs.shape:
            differing.append(f"{name} has {len(ours):,} entries instead of {len(theirs):,}")
        elif len(other := np.argwhere(ours != theirs)):
            first = tuple(other[0].tolist())
            more = f", and {len(other) - 1:,} more" if len(other) > 1 else ""
            of = (name in PER_NEURON or name == "weight") and int(netlist.layer[first[0]])
            owner = "" if of is False else f" of {netlist.layers[of]} neuron {netlist.neuron[first[0]]}"
            differing.append(f"{name}{list(first)}{owner} is {ours[first]} instead of {theirs[first]}{more}")
    return differing


FILE = NetlistFile(
    format="spikeloom-crossbars",
    version=2,
    targets=("truenorth",),
    netlist=CrossbarNetlist,
    entries={"layers": [str, ...], "bin_ticks": (1, MOST_TICKS), "bins": (1, MOST_STEPS)},
    layer=str,
    inconsistencies=inconsistencies,
    tables=frozenset({"weight"}),
)

crossbar_bytes = FILE.content
write_crossbars = FILE.write
read_crossbars = FILE.read
