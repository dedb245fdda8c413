"""How votes, operations, energy and time of recordings add up step by step, from one run.

Whatever is linear in events is added up by the engine itself (:class:`trace.Charges`): no spike is kept, and
no window is run for itself. A chip that is stopped after so many steps has done, and cost, what stands
there.
"""

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.bounds import largest_current, one_step_bounds
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import DECAY_BITS, MEMBRANE_SHIFT
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.capabilities import LONGEST, Cumulative
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost, timing
from spikeloom.runtime.machines.loihi1.trace import Charges, side_by_side


def least_intervals(netlist: Netlist) -> IntArray:
    """See :attr:`Stoppable.least_intervals`; in the order of compartments."""
    voters = netlist.voters
    current = np.floor(largest_current(one_step_bounds(netlist)[0][voters], netlist.decay_u[voters]))
    gain = current.astype(np.int64) + netlist.bias[voters]
    threshold = netlist.threshold[voters] << MEMBRANE_SHIFT
    keep = netlist.keep_v[voters]
    membrane = np.zeros_like(gain)
    interval = np.zeros_like(gain)
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


def steady(netlist: Netlist) -> BoolArray:
    """See :attr:`Stoppable.steady`: what nothing lowers, and its own spike alone lifts over the threshold."""
    voters = netlist.voters
    sender = netlist.axon_source[netlist.axon_of_synapse()] - netlist.n_inputs
    receiver = netlist.synapse_compartment()
    itself = np.bincount(
        receiver, np.where(sender == receiver, netlist.effective_weight(), 0), netlist.n_compartments
    )
    lifted = (itself > netlist.threshold) & (netlist.bias_mantissa >= 0) & (one_step_bounds(netlist)[1] == 0)
    return np.asarray(lifted[voters])


def run(
    prepared: engine.Engine, target: Target, events: EventArray, lengths: IntArray, *, lag: int
) -> Cumulative:
    """Run recordings (samples, n_inputs, T), each for its own length in data steps (samples,), once.

    `lag` are the chip steps by which the votes are behind the data.
    """
    netlist = prepared.netlist
    latencies = timing.tables_of(netlist, target)
    meter = cost.prepare(netlist, target, "whole")
    # what events add to the amounts that the meter knows, and to neuron updates
    sources = np.pad(meter.caused.astype(np.int64), ((0, 0), (0, 1)))
    updates = np.zeros((netlist.n_compartments, sources.shape[1]), np.int64)
    updates[:, -1] = 1
    amounts = Charges(sources=sources, updates=updates)
    polls = np.zeros((netlist.n_inputs + netlist.n_compartments, netlist.classes), np.int64)
    voters = netlist.voters
    polls[netlist.n_inputs + voters, netlist.readout_class[voters]] = 1
    polled = Charges(sources=polls, updates=np.zeros((netlist.n_compartments, netlist.classes), np.int64))
    parts = [polled, amounts, *map(timing.charges, latencies.values())]
    trace = engine.simulate(prepared, events, lengths=lengths, charges=side_by_side(parts))
    assert trace.charged is not None, "sums were wanted"
    ends = np.cumsum([part.sources.shape[1] for part in parts])[:-1]
    votes, happened, *times = np.split(trace.charged, ends, axis=2)
    chip_steps = lengths + netlist.max_depth
    runs = np.arange(trace.charged.shape[1]) < chip_steps[:, None]
    events_by_step = _events(meter, happened, runs)
    energy = cost.by_table(target, events_by_step)
    operations = events_by_step["synaptic_operation_dense"] + events_by_step["synaptic_operation_sparse"]
    return Cumulative(
        votes=np.cumsum(votes, axis=1)[:, lag : lag + events.shape[2]],
        depth=lag,
        lengths=lengths,
        chip_steps=chip_steps,
        operations=np.cumsum(operations, axis=1),
        energy={name: np.cumsum(each, axis=1) for name, each in energy.items()},
        time={
            name: np.cumsum(timing.simple_times(each, own, chip_steps).duration_ns, axis=1) * 1e-9
            for (name, each), own in zip(latencies.items(), times, strict=True)
        },
    )


def _events(meter: cost.Meter, happened: IntArray, runs: BoolArray) -> dict[str, FloatArray]:
    """Amount of each priced event in each chip step; (samples, chip steps)."""
    amounts = dict(
        zip((*meter.names, "neuron_active"), np.moveaxis(happened.astype(np.float64), 2, 0), strict=True)
    )
    amounts["neuron_idle"] = runs * meter.neurons - amounts["neuron_active"]
    return {event: amounts[event] for event in cost.EVENTS}
