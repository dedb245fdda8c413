"""The simple time model from sums that the engine keeps as it runs, without spike trains.

How long a core sweeps, sends and receives is a sum over events; so the events themselves need not be kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.loihi1.timing import Clock, SimpleTimes, simple_times
from spikeloom.runtime.machines.loihi1.trace import Charges


def charges(clock: Clock) -> Charges:
    """What events add to each core's picoseconds of sweep and sending, then to those of receiving: ``2 * cores`` sums.

    The input channels of the clock's netlist are on no core.
    """
    tables, netlist = clock.tables, clock.netlist
    cores = netlist.n_cores
    core = netlist.core_of_compartment()
    every = np.arange(netlist.n_compartments)
    spikes, updates = np.zeros((2, netlist.n_compartments, 2 * cores), np.int64)
    messages = np.diff(tables.first)
    spikes[every, core] = tables.spike[core] + messages * tables.axon_out
    np.add.at(spikes, (np.repeat(every, messages), cores + tables.destination), tables.processing)
    updates[every, core] = tables.update[core]
    channels = np.zeros((netlist.n_inputs, 2 * cores), np.int64)
    channel = np.repeat(np.arange(netlist.n_inputs), np.diff(tables.channel_first))
    np.add.at(channels, (channel, cores + tables.channel_destination), tables.channel_processing)
    return Charges(channels=channels, spikes=spikes, updates=updates)


def side_by_side(parts: Sequence[Charges]) -> Charges:
    """Several charges as one: the sums of each after those before it."""
    return Charges(
        channels=np.concatenate([part.channels for part in parts], axis=1),
        spikes=np.concatenate([part.spikes for part in parts], axis=1),
        updates=np.concatenate([part.updates for part in parts], axis=1),
    )


def simple_from(clock: Clock, charged: IntArray, steps: IntArray) -> SimpleTimes:
    """Times of the simple model from what :func:`charges` added up to, (samples, chip steps, 2 * cores) int64.

    `steps` (samples,) are the chip steps of each recording. Raises DataError if the sums are of another netlist.
    """
    if charged.ndim != 3 or charged.shape[::2] != (len(steps), 2 * clock.netlist.n_cores):
        raise DataError(
            f"trace: sums {charged.shape} of {len(steps)} recordings found, the netlist has {clock.netlist.n_cores} "
            "cores; give (recordings, chip steps, twice the cores), charged for this netlist"
        )
    return simple_times(clock, charged, np.diff(clock.tables.start) * clock.tables.access, steps)
