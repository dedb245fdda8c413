"""What a run costs: synaptic operations, neuron updates, packets, hops, and energy per named table.

Everything is computed from counts of a simulation and from the netlist; the simulators know no joules. A *synaptic
operation* is one stored entry of a synapse list visited by one spike; zeros held in a dense list are visited too and
are also counted apart. Priced is a run of ``T + depth`` chip steps in which input events act in the step they arrive
in: they visit synapses, but their injection into the mesh has no public price.

References
----------
.. [1] M. Davies et al., IEEE Micro 38(1), 2018, table 2.
.. [2] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_of_core
from spikeloom.compiler.targets.loihi1.layout.place import hops
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.timing import entries_by_form
from spikeloom.runtime.machines.loihi1.trace import Counts

EVENTS = (
    "synaptic_operation_dense",
    "synaptic_operation_sparse",
    "neuron_idle",
    "neuron_active",
    "spike",
    "packet",
    "hop_east_west",
    "hop_north_south",
)
"""Events that energy tables may price; ``synaptic_operation`` in a table prices both forms."""

PARTS = {
    "synapse": ("synaptic_operation_dense", "synaptic_operation_sparse"),
    "soma": ("neuron_idle", "neuron_active", "spike"),
    "network": ("packet", "hop_east_west", "hop_north_south"),
}
"""Parts of a chip and the events that are theirs; every event belongs to one."""

OPTIONAL = frozenset({"spike"})
"""Events that a table may leave out because it prices them elsewhere (Davies: in the active neuron update)."""

NOT_PRICED = (
    "injection of input events into the mesh (no public figure per event)",
    "reset of each compartment at the start of its layer's window (one register write each; no public figure)",
)
"""What no table covers; always listed, never counted as zero."""

BETWEEN_CHIPS = "packet_between_chips"
"""Packets that leave their chip: priced as packets, but neither their way over the link nor hops on the way to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Costs:
    """Counts per recording and layer, (samples, layers), and energies.

    Synaptic operations belong to the layer that receives them, packets and hops to the layer that sends them; `zeros`
    are operations on stored zeros, `between_chips` packets that leave their chip. `steps` are the chip steps of the
    longest recording; joules are by table, and `unpriced` are the tables that lack events which happened.
    """

    events: Mapping[str, FloatArray]
    zeros: FloatArray
    between_chips: FloatArray
    steps: int
    energy: Mapping[str, FloatArray]
    unpriced: Mapping[str, tuple[str, ...]]

    @property
    def synaptic_operations(self) -> FloatArray:
        """Visited entries, dense and sparse; shape (samples, layers)."""
        return self.events["synaptic_operation_dense"] + self.events["synaptic_operation_sparse"]


def _visits(netlist: Netlist) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Entries that one spike of each source visits in each layer; each (sources, layers).

    Those of dense lists, those of sparse lists, and zeros among both.
    """
    size, layers = netlist.n_inputs + netlist.n_compartments, len(netlist.layers)
    dense, sparse, zeros = (np.zeros(size * layers) for _ in range(3))
    in_dense = netlist.format_index_bits[netlist.axon_format] == 0
    length = np.diff(netlist.axon_synapses)
    for core in range(netlist.n_cores):
        source, compartment, weight = netlist.synapses_of(core)
        axons = slice(*netlist.core_axons[core : core + 2])
        listed = np.repeat(in_dense[axons], length[axons])
        entry = source * layers + netlist.layer[compartment]
        for total, kept in ((dense, listed), (sparse, ~listed), (zeros, weight == 0)):
            place, amount = np.unique(entry[kept], return_counts=True)
            total[place] += amount
    shape = size, layers
    return dense.reshape(shape), sparse.reshape(shape), zeros.reshape(shape)


def _routes(netlist: Netlist, target: Target) -> FloatArray:
    """What one spike of each compartment sends; shape (compartments, 4).

    Packets, east-west and north-south hops of those that stay on their chip, and packets that do not.
    """
    width = target.limit("mesh.width")
    inner = netlist.axon_source >= netlist.n_inputs
    source = netlist.axon_source[inner] - netlist.n_inputs
    start, end = netlist.core_of_compartment()[source], netlist.core_of_axon()[inner]
    chip = chip_of_core(netlist.core_tile, target)
    leaves = chip[start] != chip[end]
    moves = np.where(leaves, 0, hops(netlist.core_tile[start], netlist.core_tile[end], width))
    each = [np.ones(len(source)), *moves, leaves]
    return np.stack([np.bincount(source, amount, netlist.n_compartments) for amount in each], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Meter:
    """What one event of each source causes, prepared by :func:`prepare` for any number of runs.

    `caused` is (sources, names * layers): amount of each event of `names` for each layer by a spike of each source,
    input channels first; `neurons` are the compartments of each layer.
    """

    netlist: Netlist
    target: Target
    names: tuple[str, ...]
    caused: FloatArray
    neurons: FloatArray


def prepare(netlist: Netlist, target: Target) -> Meter:
    """Look up what spikes cause on a target with energy tables."""
    dense, sparse, zeros = _visits(netlist)
    of_layer = np.eye(len(netlist.layers))[netlist.layer]
    silent = np.zeros((netlist.n_inputs, len(netlist.layers)))
    sent = {
        event: np.concatenate([silent, route[:, None] * of_layer])
        for event, route in zip(
            ("packet", "hop_east_west", "hop_north_south", BETWEEN_CHIPS), _routes(netlist, target).T, strict=True
        )
    }
    caused = {
        "synaptic_operation_dense": dense,
        "synaptic_operation_sparse": sparse,
        "spike": np.concatenate([silent, of_layer]),
        **sent,
        "zeros": zeros,
    }
    return Meter(
        netlist=netlist,
        target=target,
        names=tuple(caused),
        caused=np.concatenate(list(caused.values()), axis=1),
        neurons=np.bincount(netlist.layer, minlength=len(netlist.layers)).astype(np.float64),
    )


def count(meter: Meter, counts: Counts, steps: int | IntArray) -> dict[str, FloatArray]:
    """Amount per recording and layer of everything that a meter knows and of neuron updates.

    `counts` are those of a batch, with one leading axis of recordings; `steps` the data steps T of all of them, or of
    each (samples,).
    """
    sources = np.concatenate([counts.inputs, counts.spikes], axis=1).astype(np.float64)
    amounts = dict(zip(meter.names, np.split(sources @ meter.caused, len(meter.names), axis=1), strict=True))
    active = counts.updates.astype(np.float64)
    amounts["neuron_active"] = active
    amounts["neuron_idle"] = meter.neurons * (np.reshape(steps, (-1, 1)) + meter.netlist.max_depth) - active
    return amounts


def price(table: EnergyTable, events: Mapping[str, FloatArray]) -> FloatArray | tuple[str, ...]:
    """Energy in joules, or the events that happened and that the table has no price for."""
    names = {
        event: "synaptic_operation" if "synaptic_operation" in table.prices and event.startswith("syn") else event
        for event in EVENTS
    }
    lacking = tuple(
        event
        for event, name in names.items()
        if name not in table.prices and event not in OPTIONAL and np.any(events[event])
    )
    if lacking:
        return lacking
    energy = np.zeros_like(events["packet"])
    for event, name in names.items():
        if name in table.prices:
            energy = energy + events[event] * table.joule(name)
    return energy


def estimate(meter: Meter, counts: Counts, steps: int | IntArray) -> Costs:
    """Price a run with every table of its chip; `counts` and `steps` as for :func:`count`."""
    amounts = count(meter, counts, steps)
    events = {event: amounts[event] for event in EVENTS}
    priced = {table.name: price(table, events) for table in meter.target.energy}
    return Costs(
        events=events,
        zeros=amounts["zeros"],
        between_chips=amounts[BETWEEN_CHIPS],
        steps=int(np.max(steps)) + meter.netlist.max_depth,
        energy={name: result for name, result in priced.items() if not isinstance(result, tuple)},
        unpriced={name: result for name, result in priced.items() if isinstance(result, tuple)},
    )


def by_part(table: EnergyTable, events: Mapping[str, FloatArray]) -> dict[str, FloatArray] | tuple[str, ...]:
    """Energy of each part in joules, or the events that happened and that the table has no price for.

    `events` are amounts by layer, as :func:`count` gives them, or by core, as :func:`count_by_core` does; the
    parts add up to :func:`price` of the same amounts.
    """
    whole = price(table, events)
    if isinstance(whole, tuple):
        return whole
    found = {}
    for part, own in PARTS.items():
        energy = price(table, {event: amount if event in own else 0 * amount for event, amount in events.items()})
        assert not isinstance(energy, tuple)
        found[part] = energy
    return found


def count_by_core(
    netlist: Netlist,
    target: Target,
    counts: Counts,
    updates: IntArray,
    chip_steps: int | IntArray,
    *,
    input_tiles: tuple[int, ...] = (),
    dense: BoolArray | None = None,
) -> dict[str, FloatArray]:
    """Amount of every event of `EVENTS` per recording and core, (samples, cores) float64 each.

    Synaptic operations belong to the core that receives them, packets and hops to the core that sends them. `updates`
    (samples, cores) are :func:`updates_by_core` of a trace, `chip_steps` those of all recordings or of each;
    `input_tiles` and `dense` are as for :func:`timing.prepare`: cores of inputs come after the others and cost only
    their packets and hops.
    """
    cores = netlist.n_cores + len(input_tiles)
    tile = np.append(netlist.core_tile, np.array(input_tiles, np.int64))
    channels = np.arange(netlist.n_inputs) // target.limit("core.compartments")
    home = np.append(netlist.n_cores + channels, netlist.core_of_compartment())
    fired = np.concatenate([counts.inputs, counts.spikes], axis=1).astype(np.float64)
    source, receiver = netlist.axon_source, netlist.core_of_axon()

    in_dense, in_sparse = entries_by_form(netlist, dense)

    def sums(amount: IntArray, axons: IntArray, at: IntArray) -> FloatArray:
        """What the spikes of the axons' sources cause on the cores `at`; (samples, cores)."""
        each = csr_array((amount[axons].astype(np.float64), (at[axons], source[axons])), (cores, fired.shape[1]))
        caused: FloatArray = (each @ fired.T).T
        return caused

    every = np.arange(netlist.n_axons)
    sent = every if input_tiles else np.flatnonzero(source >= netlist.n_inputs)
    sender = np.minimum(home[source], cores)  # a channel that is on no core sends nothing
    y, x = np.divmod(np.append(tile, 0), target.limit("mesh.width"))

    def on_cores(amount: IntArray) -> FloatArray:
        """Pad amounts of the netlist's cores with nothing on those of the inputs."""
        padded = np.zeros((len(fired), cores))
        padded[:, : netlist.n_cores] = amount
        return padded

    neurons = np.diff(netlist.core_compartments)
    spikes = [np.bincount(home[netlist.n_inputs :], row, netlist.n_cores) for row in counts.spikes]
    amounts = {
        "synaptic_operation_dense": sums(in_dense, every, receiver),
        "synaptic_operation_sparse": sums(in_sparse, every, receiver),
        "neuron_idle": on_cores(neurons * np.reshape(chip_steps, (-1, 1)) - updates),
        "neuron_active": on_cores(updates),
        "spike": on_cores(np.array(spikes).reshape(-1, netlist.n_cores)),
        "packet": sums(np.ones(netlist.n_axons, np.int64), sent, sender),
        "hop_east_west": sums(np.abs(x[sender] - x[receiver]), sent, sender),
        "hop_north_south": sums(np.abs(y[sender] - y[receiver]), sent, sender),
    }
    return {event: amounts[event] for event in EVENTS}


def updates_by_core(netlist: Netlist, updated: BoolArray) -> IntArray:
    """Neuron updates per recording and core: ``Trace.updated``, (samples, chip steps, compartments), added up."""
    each = updated.sum(axis=1, dtype=np.int64)
    return np.stack([each[:, a:b].sum(axis=1) for a, b in pairwise(netlist.core_compartments)], axis=1)
