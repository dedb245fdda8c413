"""What a run of crossbar cores costs: synaptic events, spikes, hops, ticks, and energy by two readings.

A *synaptic event* is a set crossing point that a spike on its axon meets. The chip's measured power can be read in two
ways, which are never added up: all of it divided by the events of one workload (26 pJ each, standing power within), or
a price for what an event adds on top of a floor that the whole chip takes for as long as it runs. The first flatters a
network that does little, the second charges it with 4,096 cores of which it uses some; the share of the cores in use
is told beside it. A tick takes its time in full, whatever happens in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.targets.base import EnergyTable, Target
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.runtime.machines.truenorth.trace import Counts

NOT_PRICED = (
    "injection of input events and clocks, read-out of votes (no public figure per event)",
    "spikes and hops by themselves (both prices are per synaptic event and hold them at the measured workload)",
)
"""Told with every estimate."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Energy:
    """Energy of recordings by one reading.

    Parameters
    ----------
    events_j : (samples,) float64
        Of the synaptic events.
    floor_j : (samples,) float64, or None
        Of the whole chip while it runs; None where the price of an event holds it.
    """

    events_j: FloatArray
    floor_j: FloatArray | None

    @property
    def total_j(self) -> FloatArray:
        """Joules of each recording."""
        return self.events_j if self.floor_j is None else self.events_j + self.floor_j


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Costs:
    """Costs of recordings.

    Parameters
    ----------
    ticks : (samples,) int64
    time_s : (samples,) float64
        At the length of a tick in real time.
    synaptic_events, spikes : (samples, layers) int64
        By the layer that receives and that sends.
    packets, hops : (samples,) int64
        Spikes with a target on the chip, and the cores that they pass.
    energy : mapping of table to Energy
    """

    ticks: IntArray
    time_s: FloatArray
    synaptic_events: IntArray
    spikes: IntArray
    packets: IntArray
    hops: IntArray
    energy: Mapping[str, Energy]


def estimate(netlist: CrossbarNetlist, target: Target, counts: Counts) -> Costs:
    """Count and price a batch of recordings.

    Parameters
    ----------
    netlist : CrossbarNetlist
        What ran.
    target : Target
        Its chip.
    counts : Counts
        Of the batch, with one leading axis.
    """
    layers = len(netlist.layers)
    into = np.zeros((netlist.n_axons, layers), np.int64)
    np.add.at(into, (netlist.axon_of_synapse(), netlist.layer[netlist.neuron_of_synapse()]), 1)
    member = np.eye(layers, dtype=np.int64)[netlist.layer]
    sent = counts.spikes[:, netlist.wire_neuron]
    events = counts.axons @ into
    time_s: FloatArray = counts.ticks.astype(np.float64) * (target.limit("tick.length") * 1e-6)
    return Costs(
        ticks=counts.ticks,
        time_s=time_s,
        synaptic_events=events,
        spikes=counts.spikes @ member,
        packets=sent.sum(axis=1),
        hops=sent @ netlist.hops(),
        energy={table.name: price(table, events.sum(axis=1), time_s) for table in target.energy},
    )


def price(table: EnergyTable, events: IntArray, time_s: FloatArray) -> Energy:
    """Energy of recordings with so many synaptic events that take so long, both (samples,).

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import CROSSBARS, load_target
    >>> all_in, marginal = load_target("truenorth", CROSSBARS).energy
    >>> price(all_in, np.array([1_000_000]), np.array([0.25])).total_j.round(9).tolist()
    [2.6e-05]
    >>> price(marginal, np.array([1_000_000]), np.array([0.25])).total_j.round(7).tolist()
    [0.0161023]
    """
    floor = table.floor_w
    joules: FloatArray = events.astype(np.float64) * table.joule("synaptic_event")
    return Energy(events_j=joules, floor_j=None if floor is None else floor * time_s)
