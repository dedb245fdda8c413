"""What a run costs: synaptic operations, neuron updates, packets, hops, and energy per named table.

Everything is computed from counts of a simulation and from the netlist; the simulators know no joules. A
*synaptic operation* is one stored entry of a synapse list visited by one spike; zeros held in a dense list
are visited too and are also counted apart. Priced is a run of ``T + depth`` chip steps in which input events
act in the step they arrive in: they visit synapses, but their injection into the mesh has no public price.

References
----------
.. [1] M. Davies et al., IEEE Micro 38(1), 2018, table 2.
.. [2] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.loihi1.layout.place import chip_of_core, hops
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.trace import Counts

PARTS = {
    "synapse": ("synaptic_operation_dense", "synaptic_operation_sparse"),
    "soma": ("neuron_idle", "neuron_active", "spike"),
    "network": ("packet", "hop_east_west", "hop_north_south"),
}
"""Parts of a chip and the events that are theirs."""

EVENTS = tuple(event for events in PARTS.values() for event in events)
"""Events that energy tables may price; ``synaptic_operation`` in a table prices both forms."""

OPTIONAL = frozenset({"spike"})
"""Events that a table may leave out because it prices them elsewhere (Davies: in the active neuron update)."""

NOT_PRICED = (
    "reset of each compartment at the start of its layer's window (no public figure; that of a whole chip took 5.9 µJ, "
    "Frady 2020, table 2)",
    "read-out of votes (no public figure)",
    "work off the chip: binning of the sensor's events, joining of bins, making of clocks",
)
"""What no table covers; always listed, never counted as zero."""

BETWEEN_CHIPS = "packet_between_chips"
"""Packets that leave their chip: priced as packets, but neither their way over the link nor hops on the way to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Costs:
    """Counts per recording and group of neurons, (samples, groups), and energies; groups are those of a meter.

    Synaptic operations belong to the group that receives them, packets and hops to the group that sends
    them; `zeros` are operations on stored zeros, `between_chips` packets that leave their chip. `steps` are
    the chip steps of the longest recording; joules are by table, and `unpriced` are the tables that lack
    events which happened.
    """

    events: Mapping[str, FloatArray]
    zeros: FloatArray
    between_chips: FloatArray
    steps: int
    energy: Mapping[str, FloatArray]
    unpriced: Mapping[str, tuple[str, ...]]

    @property
    def synaptic_operations(self) -> FloatArray:
        """Visited entries, dense and sparse; shape (samples, groups)."""
        return self.events["synaptic_operation_dense"] + self.events["synaptic_operation_sparse"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Meter:
    """What one event of each source causes, prepared by :func:`prepare` for any number of runs.

    `caused` is (sources, names * groups): amount of each event of `names` for each group by a spike of each
    source, input channels first; `neurons` are the compartments of each group.
    """

    target: Target
    names: tuple[str, ...]
    caused: FloatArray
    neurons: IntArray


def prepare(netlist: Netlist, target: Target, by: Literal["layer", "core", "whole"] = "layer") -> Meter:
    """Look up what spikes cause on a target with energy tables, by layer, by core or all in one group."""
    n_inputs = netlist.n_inputs
    size = netlist.n_inputs + netlist.n_compartments
    core_of = netlist.core_of_compartment()
    group, groups = {
        "layer": (netlist.layer, len(netlist.layers)),
        "core": (core_of, netlist.n_cores),
        "whole": (np.zeros_like(netlist.layer), 1),
    }[by]
    neurons = np.bincount(group, minlength=groups)

    def caused(amount: IntArray | BoolArray, source: IntArray, receiver: IntArray) -> FloatArray:
        """Sums over synapses, axons or neurons; (sources, groups)."""
        sums = np.bincount(source * len(neurons) + receiver, amount.astype(np.float64), size * len(neurons))
        return np.asarray(sums, np.float64).reshape(size, len(neurons))

    axon = netlist.axon_of_synapse()
    dense = netlist.format_index_bits[netlist.axon_format[axon]] == 0
    entries = netlist.axon_source[axon], group[netlist.synapse_compartment()]
    sent = np.flatnonzero(netlist.axon_source >= n_inputs)  # a channel is on no core and sends nothing
    source = netlist.axon_source[sent]
    sender = source - n_inputs
    start = netlist.core_tile[core_of[sender]]
    end = netlist.core_tile[netlist.core_of_axon()[sent]]
    leaves = chip_of_core(start, target) != chip_of_core(end, target)
    east_west, north_south = np.where(leaves, 0, hops(start, end, target.limit("mesh.width")))
    compartments = np.arange(n_inputs, size)
    amounts = {
        "synaptic_operation_dense": caused(dense, *entries),
        "synaptic_operation_sparse": caused(~dense, *entries),
        "spike": caused(np.ones_like(group), compartments, group),
        "packet": caused(np.ones_like(source), source, group[sender]),
        "hop_east_west": caused(east_west, source, group[sender]),
        "hop_north_south": caused(north_south, source, group[sender]),
        BETWEEN_CHIPS: caused(leaves, source, group[sender]),
        "zeros": caused(netlist.synapse_weight == 0, *entries),
    }
    return Meter(
        target=target, names=tuple(amounts), caused=np.hstack(list(amounts.values())), neurons=neurons
    )


def count(meter: Meter, counts: Counts, chip_steps: int | IntArray) -> dict[str, FloatArray]:
    """Amount per recording and group of everything that a meter knows and of neuron updates.

    `counts` are those of a batch, with one leading axis of recordings and updates by group; `chip_steps`
    those of all recordings, or of each (samples,).
    """
    sources = np.concatenate([counts.inputs, counts.spikes], axis=1).astype(np.float64)
    amounts = dict(zip(meter.names, np.split(sources @ meter.caused, len(meter.names), axis=1), strict=True))
    amounts["neuron_active"] = counts.updates.astype(np.float64)
    amounts["neuron_idle"] = meter.neurons * np.reshape(chip_steps, (-1, 1)) - amounts["neuron_active"]
    return amounts


def _named(table: EnergyTable, event: str) -> str:
    """The name under which a table prices an event."""
    return (
        "synaptic_operation" if "synaptic_operation" in table.prices and event.startswith("syn") else event
    )


def lacking(table: EnergyTable, events: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Events that happened and that a table has no price for."""
    return tuple(
        event
        for event in EVENTS
        if _named(table, event) not in table.prices and event not in OPTIONAL and np.any(events[event])
    )


def joules(table: EnergyTable, events: Mapping[str, FloatArray], of: Iterable[str] = EVENTS) -> FloatArray:
    """Energy of some events; what the table has no price for is left out."""
    energy = np.zeros_like(events["packet"])
    for event in of:
        name = _named(table, event)
        if name in table.prices:
            energy = energy + events[event] * table.joule(name)
    return energy


def by_table(target: Target, events: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Energy by each table that has a price for all that happened."""
    return {table.name: joules(table, events) for table in target.energy if not lacking(table, events)}


def by_part(target: Target, events: Mapping[str, FloatArray]) -> dict[str, dict[str, FloatArray]]:
    """The same for each part of the chip."""
    return {
        table.name: {part: joules(table, events, of) for part, of in PARTS.items()}
        for table in target.energy
        if not lacking(table, events)
    }


def price(meter: Meter, counts: Counts, chip_steps: int | IntArray) -> Costs:
    """Price a run with every table of its chip; `counts` and `chip_steps` as for :func:`count`."""
    return costs_of(meter.target, count(meter, counts, chip_steps), chip_steps)


def costs_of(target: Target, amounts: Mapping[str, FloatArray], chip_steps: int | IntArray) -> Costs:
    """Price what :func:`count` found."""
    events = {event: amounts[event] for event in EVENTS}
    energy = by_table(target, events)
    return Costs(
        events=events,
        zeros=amounts["zeros"],
        between_chips=amounts[BETWEEN_CHIPS],
        steps=int(np.max(chip_steps)),
        energy=energy,
        unpriced={table.name: lacking(table, events) for table in target.energy if table.name not in energy},
    )


def updates_by_core(netlist: Netlist, updated: BoolArray) -> IntArray:
    """Neuron updates per recording and core: ``Trace.updated``, (samples, chip steps, compartments), added up."""
    each = updated.sum(axis=1, dtype=np.int64)
    return np.stack([each[:, a:b].sum(axis=1) for a, b in pairwise(netlist.core_compartments)], axis=1)
