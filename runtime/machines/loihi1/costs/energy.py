"""Where the energy of a run goes: by part of the chip, and by core.

The counts and prices are those of :mod:`costs.cost`; only the way in which they are added up differs.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.costs.cost import EVENTS, price
from spikeloom.runtime.machines.loihi1.trace import Counts

PARTS = {
    "synapse": ("synaptic_operation_dense", "synaptic_operation_sparse"),
    "soma": ("neuron_idle", "neuron_active", "spike"),
    "network": ("packet", "hop_east_west", "hop_north_south"),
}
"""Parts of a chip and the events that are theirs; every event belongs to one."""


def by_part(table: EnergyTable, events: Mapping[str, FloatArray]) -> dict[str, FloatArray] | tuple[str, ...]:
    """Energy of each part in joules, or the events that happened and that the table has no price for.

    `events` are amounts by layer, as :func:`cost.count` gives them, or by core, as :func:`count_by_core` does; the
    parts add up to :func:`cost.price` of the same amounts.
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
    """Amount of every event of ``cost.EVENTS`` per recording and core, (samples, cores) float64 each.

    Synaptic operations belong to the core that receives them, packets and hops to the core that sends them.

    Parameters
    ----------
    counts : Counts
        Of a batch: arrays have one leading axis of recordings.
    updates : (samples, cores) int64
        Neuron updates on each core, for example :func:`updates_by_core` of a trace.
    chip_steps : int or (samples,) int64
        Chip steps of all recordings, or of each.
    input_tiles, dense
        As for :func:`timing.prepare`; cores of inputs come after the others and cost only their packets and hops.
    """
    cores = netlist.n_cores + len(input_tiles)
    tile = np.append(netlist.core_tile, np.array(input_tiles, np.int64))
    channels = np.arange(netlist.n_inputs) // target.limit("core.compartments")
    home = np.append(netlist.n_cores + channels, netlist.core_of_compartment())
    fired = np.concatenate([counts.inputs, counts.spikes], axis=1).astype(np.float64)
    source, receiver = netlist.axon_source, netlist.core_of_axon()

    entries = np.diff(netlist.axon_synapses)
    if dense is None:
        in_dense = np.where(netlist.format_index_bits[netlist.axon_format] == 0, entries, 0)
    else:
        in_dense = np.bincount(netlist.axon_of_synapse()[dense], minlength=netlist.n_axons)

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
        "synaptic_operation_sparse": sums(entries - in_dense, every, receiver),
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
