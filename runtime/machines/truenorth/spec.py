"""The definition: one tick of crossbar cores in plain Python integers, one neuron at a time, written to be read.

:mod:`truenorth.engine` is the fast twin and must agree with this module on every spike, membrane and count.

A tick
------
1. *Arrivals.* An axon has a spike if an input event, a clock or a spike of an earlier tick is due on it; several of
   them are one.
2. *Integrate.* The weight of the axon's type, for each axon with a spike and a crossing point. Positive and negative
   weights are added up apart, for the order in which the chip visits its axons is not ours to rely on: a
   tick in which *some* order would leave the register of 20 bits with sign is counted. The register
   saturates.
3. *Leak.* Added, or with reversal added times the sign of the membrane; what such a leak carries past zero is zero.
4. *Threshold.* A spike where the membrane is at least the threshold.
5. *Reset.* To a value, by the threshold, or not at all. Without a spike a membrane below the negative threshold is
   set to it, or reset the same way.

All neurons of all cores do this in every tick; a spike is on its way for 1 to 15 ticks.

References
----------
.. [1] A. Cassidy et al., "Cognitive computing building block", IJCNN 2013: the neuron.
.. [2] P. Merolla et al., Science 345, 2014, supplement, table S2: the order within a tick.
.. [3] RANC (UA-RCL), ``simulator/src/neuronblock.cpp`` and ``NeuronBlock.v``: the same order, and ``>=``.
.. [4] NeMo (markplagge), ``tn_neuron.c``: leak reversal and negative threshold.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.legalize import signed_range
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines import base


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counts(base.Counts):
    """Events of whole runs; votes are spikes in the ticks in which a neuron votes, zero for those that do not."""

    ticks: IntArray  # (…) int64; ticks that were run
    axons: IntArray  # (…, axons) int64; ticks in which an axon had a spike
    merged: IntArray  # (…) int64; spikes that reached an axon in a tick in which it had one already, and were lost
    # (…, neurons) int64; ticks in which the membrane left its register, or would have in some order of
    # arrivals; it saturates
    overflows: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace(base.Trace):
    """Result of a simulation.

    Membranes are those at the end of each tick, after resets. In a batch a shorter recording is filled up with
    zeros after its last tick.
    """

    counts: Counts


@dataclass(slots=True)
class Neuron:
    """Parameters and membrane of one neuron; the names are those of the netlist."""

    leak: int
    leak_reversal: bool
    threshold: int
    reset_mode: int
    reset: int
    negative_threshold: int
    negative_saturates: bool
    membrane: int


def saturated(value: int, bits: int) -> int:
    """The nearest number that a register of so many bits with sign holds.

    >>> saturated(524288, 20), saturated(-524289, 20), saturated(7, 20)
    (524287, -524288, 7)
    """
    low, high = signed_range(bits)
    return max(low, min(high, value))


def neuron_tick(neuron: Neuron, positive: int, negative: int, bits: int) -> tuple[bool, bool]:
    """Let one neuron live through a tick: its membrane is replaced.

    `positive` and `negative` are the sums of the weights that arrived, as magnitudes, `bits` is the width of
    the register. Returns whether it spiked, and whether the register was left, or would have been in some
    order of arrivals.

    A threshold of 3 reached exactly is a spike; a linear reset keeps what is above it.

    >>> neuron = Neuron(0, False, 3, RESET_LINEAR, 0, 0, False, 2)
    >>> neuron_tick(neuron, 5, 1, 20), neuron.membrane
    ((True, False), 3)
    """
    low, high = signed_range(bits)

    # integrate
    left = neuron.membrane + positive > high or neuron.membrane - negative < low
    v = saturated(neuron.membrane + positive - negative, bits)

    # leak
    if neuron.leak_reversal:
        sign = (v > 0) - (v < 0)
        leaked = v + sign * neuron.leak
        if leaked * sign < 0:  # carried past zero
            leaked = 0
    else:
        leaked = v + neuron.leak
    v = saturated(leaked, bits)
    left = left or v != leaked

    # threshold
    spiked = v >= neuron.threshold

    # reset
    if spiked:
        if neuron.reset_mode == RESET_TO:
            v = neuron.reset
        elif neuron.reset_mode == RESET_LINEAR:
            v -= neuron.threshold
    elif v < -neuron.negative_threshold:
        if neuron.negative_saturates:
            v = -neuron.negative_threshold
        elif neuron.reset_mode == RESET_TO:
            v = -neuron.reset
        elif neuron.reset_mode == RESET_LINEAR:
            v += neuron.negative_threshold
    neuron.membrane = saturated(v, bits)
    return spiked, left or neuron.membrane != v


def neurons_at_rest(netlist: CrossbarNetlist) -> list[Neuron]:
    """All neurons, before the first tick."""
    *registers, _ = Neuron.__dataclass_fields__
    columns = [getattr(netlist, name).tolist() for name in (*registers, "initial")]
    return [Neuron(*values) for values in zip(*columns, strict=True)]


def crossing_points(netlist: CrossbarNetlist) -> list[list[tuple[int, int]]]:
    """Of each axon, the neurons that it reaches, with the weights."""
    points: list[list[tuple[int, int]]] = [[] for _ in range(netlist.n_axons)]
    crossing = np.stack([netlist.axon_of_synapse(), netlist.neuron_of_synapse()], axis=1)
    for axon, neuron in crossing.tolist():
        points[axon].append((neuron, int(netlist.weight[neuron, netlist.axon_type[axon]])))
    return points


def injected(netlist: CrossbarNetlist, events: EventArray) -> defaultdict[int, list[int]]:
    """Axons that input events and clocks reach in each tick of a recording (n_inputs, T), once for each of them."""
    due: defaultdict[int, list[int]] = defaultdict(list)
    fed, clocked, _ = (aims.tolist() for aims in netlist.aims())
    for channel, axon, offset in zip(
        netlist.feed_channel.tolist(), fed, netlist.feed_tick.tolist(), strict=True
    ):
        for step in np.flatnonzero(events[channel]).tolist():
            due[step * netlist.bin_ticks + offset].append(axon)
    periods = netlist.clock_period.tolist()
    phases = netlist.clock_phase.tolist()
    for axon, period, phase in zip(clocked, periods, phases, strict=True):
        for tick in range(phase, netlist.ticks(events.shape[1]), period):
            due[tick].append(axon)
    return due


def _voting(netlist: CrossbarNetlist, ticks: int, steps: int) -> BoolArray:
    """Which spikes vote, (ticks, neurons): those of read-out neurons, in its window."""
    tick = np.arange(ticks)[:, None]
    last = netlist.readout_first + steps * netlist.bin_ticks
    window = (tick >= netlist.readout_first) & (tick < last)
    voting: BoolArray = window & (netlist.readout_class >= 0)
    return voting


def simulate(netlist: CrossbarNetlist, events: EventArray) -> Trace:
    """Run one recording (n_inputs, T), uint8 or bool, through the cores of a network that breaks no rule of its chip.

    Any value but zero is an event. The trace holds spikes and membranes and has no leading axis. DataError
    if the recording has another number of input channels than the network.
    """
    base.require_channels(netlist, events.shape[0])
    bits = load_target(netlist.target).limit("neuron.membrane_bits")
    steps = events.shape[1]
    ticks = netlist.ticks(steps)
    neurons = neurons_at_rest(netlist)
    points = crossing_points(netlist)
    # what leads to the axons: from outside by tick, from neurons by their wires
    due = injected(netlist, events)
    wires: list[list[tuple[int, int]]] = [[] for _ in neurons]
    wired = np.stack([netlist.wire_neuron, netlist.aims()[2], netlist.wire_delay], axis=1)
    for source, axon, delay in wired.tolist():
        wires[source].append((axon, delay))

    spikes = np.zeros((ticks, len(neurons)), np.bool_)
    membranes = np.zeros((ticks, len(neurons)), np.int32)
    axons = [0] * netlist.n_axons
    overflows = [0] * len(neurons)
    merged = 0
    for tick in range(ticks):
        # arrivals
        active = sorted(set(due[tick]))
        merged += len(due[tick]) - len(active)
        positive = [0] * len(neurons)
        negative = [0] * len(neurons)
        for axon in active:
            axons[axon] += 1
            for n, weight in points[axon]:
                if weight > 0:
                    positive[n] += weight
                else:
                    negative[n] -= weight

        for n, neuron in enumerate(neurons):
            spiked, left = neuron_tick(neuron, positive[n], negative[n], bits)
            membranes[tick, n] = neuron.membrane
            overflows[n] += left
            if spiked:
                spikes[tick, n] = True
                for axon, delay in wires[n]:
                    due[tick + delay].append(axon)

    counts = Counts(
        ticks=np.array(ticks, np.int64),
        spikes=spikes.sum(axis=0, dtype=np.int64),
        votes=(spikes & _voting(netlist, ticks, steps)).sum(axis=0, dtype=np.int64),
        axons=np.array(axons, np.int64),
        merged=np.array(merged, np.int64),
        overflows=np.array(overflows, np.int64),
    )
    return Trace(counts=counts, spikes=spikes, membranes=membranes)
