"""How votes, operations, energy and time of recordings add up step by step, from one run.

Whatever is linear in events is added up by the engine itself (:class:`trace.Charges`): no spike is kept, and no
window is run for itself. A chip that is stopped after so many steps has done, and cost, what stands there.
"""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.fixedpoint import DECAY_BITS, MEMBRANE_SHIFT, largest_current
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_count
from spikeloom.compiler.targets.loihi1.netlist import Netlist, one_step_bounds
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.integer import LONGEST, Cumulative
from spikeloom.runtime.machines.loihi1 import engine, timing
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.trace import Charges, side_by_side


def read_out_depth(netlist: Netlist) -> int:
    """Chip steps by which the votes lag behind the data: the depth of the latest layer that votes."""
    return max(netlist.layers[int(layer)].depth for layer in np.unique(netlist.layer[netlist.readout_class >= 0]))


def least_intervals(netlist: Netlist) -> IntArray:
    """See :attr:`IntegerMachine.least_intervals`; in the order of compartments."""
    voters = np.flatnonzero(netlist.readout_class >= 0)
    current = largest_current(one_step_bounds(netlist)[0][voters], netlist.decay_u[voters])
    gain = current + (netlist.bias_mantissa << netlist.bias_exponent)[voters]
    threshold = netlist.threshold[voters] << MEMBRANE_SHIFT
    keep = 2**DECAY_BITS - netlist.decay_v[voters]
    membrane, interval = np.zeros_like(gain), np.zeros_like(gain)
    open_ = np.ones(len(gain), np.bool_)
    for step in range(1, LONGEST + 1):
        raised = (membrane * keep >> DECAY_BITS) + gain
        fires = open_ & (raised > threshold)
        interval[fires] = step
        open_ &= ~fires & (raised > membrane)  # what no longer rises never will
        membrane = np.maximum(raised, 0)
        if not open_.any():
            break
    interval[open_] = LONGEST
    return interval


def vote_charges(netlist: Netlist) -> Charges:
    """What a spike adds to the votes of each class."""
    spikes = np.zeros((netlist.n_compartments, netlist.classes), np.int64)
    voters = np.flatnonzero(netlist.readout_class >= 0)
    spikes[voters, netlist.readout_class[voters]] = 1
    return Charges(
        channels=np.zeros((netlist.n_inputs, netlist.classes), np.int64), spikes=spikes, updates=np.zeros_like(spikes)
    )


def votes_of(netlist: Netlist, events: engine.EventArray, lengths: IntArray) -> IntArray:
    """Votes so far after each step of the read-out, ``Cumulative.votes`` alone; arguments as for :func:`run`."""
    prepared = engine.prepare(netlist, charges=vote_charges(netlist))
    trace = engine.simulate(prepared, events, lengths=lengths)
    assert trace.charged is not None, "votes were wanted"
    return _by_step(netlist, trace.charged, events.shape[2])


def _by_step(netlist: Netlist, votes: IntArray, steps: int) -> IntArray:
    """Votes so far after each step of the read-out, from those of each chip step."""
    depth = read_out_depth(netlist)
    return np.cumsum(votes, axis=1)[:, depth : depth + steps]


def run(netlist: Netlist, target: Target, events: engine.EventArray, lengths: IntArray) -> Cumulative:
    """Run recordings (samples, n_inputs, T), each for its own length in data steps (samples,), once."""
    timed = target.time if chip_count(netlist.core_tile, target) == 1 else ()
    latencies = [timing.prepare(netlist, target, table) for table in timed]
    meter = cost.prepare(netlist, target)
    parts = [vote_charges(netlist), _event_charges(meter), *map(timing.charges, latencies)]
    prepared = engine.prepare(netlist, charges=side_by_side(parts))
    trace = engine.simulate(prepared, events, lengths=lengths)
    assert trace.charged is not None, "sums were wanted"
    ends = np.cumsum([part.spikes.shape[1] for part in parts])[:-1]
    votes, happened, *times = np.split(trace.charged, ends, axis=2)
    chip_steps = lengths + netlist.max_depth
    runs = np.arange(trace.charged.shape[1]) < chip_steps[:, None]
    events_by_step = _events(meter, happened, runs)
    found = {table.name: cost.price(table, events_by_step) for table in target.energy}
    operations = events_by_step["synaptic_operation_dense"] + events_by_step["synaptic_operation_sparse"]
    return Cumulative(
        votes=_by_step(netlist, votes, events.shape[2]),
        depth=read_out_depth(netlist),
        lengths=lengths,
        chip_steps=chip_steps,
        operations=np.cumsum(operations, axis=1),
        energy={name: np.cumsum(each, axis=1) for name, each in found.items() if not isinstance(each, tuple)},
        time={
            table.name: np.cumsum(timing.simple_times(each, own, chip_steps).duration_ns, axis=1) * 1e-9
            for table, each, own in zip(timed, latencies, times, strict=True)
        },
    )


def _event_charges(meter: cost.Meter) -> Charges:
    """What events add to the amounts that a meter knows, layers taken together, and to neuron updates."""
    netlist = meter.netlist
    caused = meter.caused.reshape(len(meter.caused), len(meter.names), -1).sum(axis=2).astype(np.int64)
    caused = np.concatenate([caused, np.zeros((len(caused), 1), np.int64)], axis=1)
    updates = np.zeros((netlist.n_compartments, caused.shape[1]), np.int64)
    updates[:, -1] = 1
    return Charges(channels=caused[: netlist.n_inputs], spikes=caused[netlist.n_inputs :], updates=updates)


def _events(meter: cost.Meter, happened: IntArray, runs: BoolArray) -> dict[str, FloatArray]:
    """Amount of each priced event in each chip step; (samples, chip steps)."""
    amounts = dict(zip((*meter.names, "neuron_active"), np.moveaxis(happened.astype(np.float64), 2, 0), strict=True))
    amounts["neuron_idle"] = runs * meter.neurons.sum() - amounts["neuron_active"]
    return {event: amounts[event] for event in cost.EVENTS}
