"""The fast twin of :mod:`truenorth.spec`: crossbar cores by events, bit for bit the same."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.layer_kernel import require_below
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.legalize import signed_range
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.runtime.machines.base import require_channels
from spikeloom.runtime.machines.truenorth import kernel
from spikeloom.runtime.machines.truenorth.spec import Counts, Trace
from spikeloom.runtime.machines.truenorth.twins import Twins, find_twins

LONGEST_GAP = 8
"""Steady neurons that an axon may skip within a row of weights; so many zeros are added as fast as one number."""

MOST_TICKS = 2**31


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Engine:
    """A network as the kernel takes it."""

    netlist: CrossbarNetlist
    twins: Twins  # Neurons and axons that are alike; the kernel runs one of each kind
    # low, high: Range of the membrane register
    low: int
    high: int
    slots: int  # Power of two above every delay
    wiring: kernel.Wiring


def prepare(netlist: CrossbarNetlist, *, careful: bool = False) -> Engine:
    """Arrange a network that breaks no rule of its chip for the kernel.

    Where it is `careful`, neurons that nothing keeps within their register never run together with others.
    """
    bits = load_target(netlist.target).limit("neuron.membrane_bits")
    low, high = signed_range(bits)
    twins, steady, cap = _steady_first(netlist, find_twins(netlist), low, high, careful=careful)
    first = twins.first_neuron
    axons = len(twins.first_axon)
    feeds, clocks, wires = netlist.aims()
    ticking, clocked = _held(twins, clocks)
    rows, fed = _held(twins, feeds)
    offsets, offset = np.unique(netlist.feed_tick[rows], return_inverse=True)
    key = offset.reshape(-1) * netlist.n_inputs + netlist.feed_channel[rows]
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(len(offsets) * netlist.n_inputs + 1))
    starts = np.arange(len(offsets))[:, None] * netlist.n_inputs + np.arange(netlist.n_inputs + 1)

    near = twins.synapse_neuron < steady
    synapses = twins.synapse_axon, twins.synapse_neuron, twins.synapse_halves
    axon, neuron, halves = (column[near] for column in synapses)
    bounds, segments, row = _segments(axon, neuron, halves, axons)
    axon, neuron, halves = (column[~near] for column in synapses)
    # of each neuron: the axon that its spikes reach, and their delay
    target = np.full(netlist.n_neurons, -1)
    delay = np.zeros(netlist.n_neurons, np.int64)
    target[netlist.wire_neuron], delay[netlist.wire_neuron] = twins.axon[wires], netlist.wire_delay
    votes = np.where(netlist.readout_class >= 0, netlist.readout_first, -1)
    columns = [*(getattr(netlist, name) for name in kernel.PARAMETERS), target, delay, votes]
    wiring = kernel.Wiring(
        offsets=offsets.astype(np.int64),
        feed_bounds=ends[starts].astype(np.int64),
        feed_axon=fed[order].astype(np.int32),
        clocks=np.stack([clocked, netlist.clock_period[ticking], netlist.clock_phase[ticking]], axis=1),
        segment_bounds=bounds,
        segments=segments,
        row=row,
        steady=np.stack([*(column[first] for column in _registers(netlist)), cap])[:, :steady].astype(
            np.int32
        ),
        axon_synapses=np.searchsorted(axon, np.arange(axons + 1)).astype(np.int64),
        synapse_neuron=neuron.astype(np.int32),
        synapse_weight=halves,
        parameters=np.stack(columns, axis=1)[first].astype(np.int32),
        initial=netlist.initial[first].astype(np.int32),
    )
    return Engine(
        netlist=netlist,
        twins=twins,
        low=low,
        high=high,
        slots=1 << int(netlist.wire_delay.max(initial=1)).bit_length(),
        wiring=wiring,
    )


def _registers(netlist: CrossbarNetlist) -> tuple[IntArray, ...]:
    """Leak, threshold, reset, lowest membrane, what one below that becomes, and whether a spike takes the threshold."""
    linear = (netlist.reset_mode == RESET_LINEAR).astype(np.int64)
    lowest = -netlist.negative_threshold
    under = np.where(netlist.negative_saturates == 1, lowest, -netlist.reset)
    return netlist.leak, netlist.threshold, np.where(linear == 1, 0, netlist.reset), lowest, under, linear


def _steady_first(
    netlist: CrossbarNetlist, twins: Twins, low: int, high: int, *, careful: bool
) -> tuple[Twins, int, IntArray]:
    """The same kinds with steady neurons first; how many are steady; and the cap of each kind.

    Steady are neurons without reversal whose registers, and all that can reach them in a tick, leave the
    membrane within its range: those that are reset to a value, and those that are held at their negative
    threshold and reset by their threshold, as far as they begin a tick at their cap or below: the highest
    membrane from which a tick cannot leave the register.
    """
    first = twins.first_neuron
    positive, negative = (
        np.bincount(twins.synapse_neuron, part, len(first)).astype(np.int64)
        for part in (twins.synapse_halves >> kernel.HALF, twins.synapse_halves & kernel.LOWER)
    )
    leak, threshold, reset, lowest, under, linear = (column[first] for column in _registers(netlist))
    initial = netlist.initial[first]
    saturates = netlist.negative_saturates[first] == 1
    simple = (netlist.leak_reversal == 0)[first]
    cap = high - positive - np.maximum(leak, 0)
    most = np.maximum.reduce([threshold - 1, reset, under, initial])
    least = np.minimum.reduce([lowest, reset, under, initial]) - negative + np.minimum(leak, 0)
    to_value = (netlist.reset_mode[first] == RESET_TO) & (most <= cap)
    by_threshold = (linear == 1) & saturates & (initial <= cap) & (not careful)
    steady = simple & (least >= low) & (to_value | by_threshold)
    order = np.argsort(~steady, kind="stable")
    rank = np.argsort(order)
    ends_at = rank[twins.synapse_neuron]
    by_axon = np.lexsort((ends_at, twins.synapse_axon))
    ordered = replace(
        twins,
        neuron=rank[twins.neuron],
        first_neuron=first[order],
        synapse_axon=twins.synapse_axon[by_axon],
        synapse_neuron=ends_at[by_axon],
        synapse_halves=twins.synapse_halves[by_axon],
    )
    return ordered, int(np.count_nonzero(steady)), cap[order]


def _segments(
    axon: IntArray, neuron: IntArray, halves: IntArray, axons: int
) -> tuple[IntArray, IntArray, kernel.Int32]:
    """Synapses (by axon, then neuron) as rows of neighbours; bounds by axon, (segments, 3), and the weights."""
    weight = (halves >> kernel.HALF) - (halves & kernel.LOWER)
    starts = np.ones(len(axon), np.bool_)
    starts[1:] = (np.diff(axon) != 0) | (np.diff(neuron) > LONGEST_GAP)
    begins = np.flatnonzero(starts)
    last = np.append(begins[1:], len(axon))[: len(begins)] - 1
    lengths = neuron[last] + 1 - neuron[begins]
    at = np.cumsum(lengths) - lengths
    row = np.zeros(int(lengths.sum()), np.int32)
    segment = np.cumsum(starts) - 1
    row[at[segment] + neuron - neuron[begins][segment]] = weight
    bounds = np.searchsorted(axon[begins], np.arange(axons + 1)).astype(np.int64)
    return bounds, np.stack([neuron[begins], neuron[last] + 1, at], axis=1).astype(np.int64), row


def _held(twins: Twins, aims: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of a table that lead to the first axon of a kind, and that kind; those of its twins say the same."""
    rows = np.flatnonzero(twins.first_axon[twins.axon[aims]] == aims)
    return rows, twins.axon[aims[rows]]


def _checked_steps(netlist: CrossbarNetlist, events: EventArray, lengths: IntArray | None) -> IntArray:
    """Data steps of each recording; raises as :func:`simulate`."""
    require_channels(netlist, events.shape[1])
    samples, _, whole = events.shape
    steps = np.full(samples, whole) if lengths is None else np.asarray(lengths, np.int64)
    require_below("length", steps, whole + 1)
    most = netlist.ticks(whole)
    if most >= MOST_TICKS:
        raise NumericRangeError(
            f"recordings of {whole} data steps take {most} ticks, {MOST_TICKS - 1} can be counted"
        )
    return steps


def simulate(
    network: CrossbarNetlist | Engine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    spikes: bool = False,
    membranes: bool = False,
) -> Trace:
    """Run recordings (samples, n_inputs, T), each as :func:`spec.simulate` does; `lengths` (samples,) are their steps.

    Spikes and membranes are kept where they are wanted, at one and four bytes a neuron and tick.

    DataError if the recordings have another number of input channels than the network. NumericRangeError if
    they would take more ticks than a run can count.
    """
    engine = network if isinstance(network, Engine) else prepare(network)
    netlist = engine.netlist
    samples = len(events)
    steps = _checked_steps(netlist, events, lengths)
    most = netlist.ticks(events.shape[2])
    twins = engine.twins
    neurons = len(twins.first_neuron)
    axons = np.zeros((samples, len(twins.first_axon)), np.int64)
    spiked, votes, overflows = np.zeros((3, samples, neurons), np.int64)
    raster = np.zeros((samples, most if spikes else 0, neurons), np.bool_)
    membranes_kept = np.zeros((samples, most if membranes else 0, neurons), np.int32)
    merged = np.zeros(samples, np.int64)

    def one(sample: int) -> None:
        arriving = np.ascontiguousarray(events[sample, :, : steps[sample]].T != 0).view(np.uint8)
        arrays = (axons, spiked, votes, overflows, raster, membranes_kept)
        merged[sample] = kernel.run(
            arriving,
            netlist.bin_ticks,
            netlist.ticks(int(steps[sample])),
            engine.low,
            engine.high,
            engine.slots,
            engine.wiring,
            kernel.Tallies(*(array[sample] for array in arrays)),
        )

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(one, range(samples)))
    if np.any(merged == kernel.BROKEN_OFF):
        again = prepare(netlist, careful=True)
        return simulate(again, events, lengths=lengths, spikes=spikes, membranes=membranes)
    counts = Counts(
        ticks=steps * netlist.bin_ticks + netlist.drain,
        spikes=spiked[:, twins.neuron],
        votes=votes[:, twins.neuron],
        axons=axons[:, twins.axon],
        merged=merged,
        overflows=overflows[:, twins.neuron],
    )
    return Trace(
        counts=counts,
        spikes=raster[:, :, twins.neuron] if spikes else None,
        membranes=membranes_kept[:, :, twins.neuron] if membranes else None,
    )
