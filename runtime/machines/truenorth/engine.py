"""The fast twin of :mod:`truenorth.spec`: crossbar cores by events, bit for bit the same."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.legalize import signed_range
from spikeloom.compiler.targets.truenorth.netlist import RESET_LINEAR, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.truenorth import kernel
from spikeloom.runtime.machines.truenorth.spec import Neuron, neuron_tick
from spikeloom.runtime.machines.truenorth.trace import Counts, EventArray, Trace, check_channels
from spikeloom.runtime.machines.truenorth.twins import Twins, find_twins

SETTLING = 64
"""Ticks within which a neuron without input must come to rest to be let sleep."""

MOST_STEADY = 1 << 15
"""Neurons beyond those of the plainest kind that may live through every tick; where there are more, all of these work
when they are reached, which is less for a large network of which little is active."""

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
    kinds = find_twins(netlist, kernel.HALF)
    twins, plain, steady, cap = _steady_first(netlist, kinds, low, high, careful=careful)
    first, axons = twins.first_neuron, len(twins.first_axon)
    wired = twins.axon[netlist.axons_at(netlist.cores_at(netlist.wire_x, netlist.wire_y), netlist.wire_line)]
    ticking, clocked = _held(twins, netlist.axons_at(netlist.clock_core, netlist.clock_line))
    rows, fed = _held(twins, netlist.axons_at(netlist.feed_core, netlist.feed_line))
    offsets, offset = np.unique(netlist.feed_tick[rows], return_inverse=True)
    key = offset.reshape(-1) * netlist.n_inputs + netlist.feed_channel[rows]
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(len(offsets) * netlist.n_inputs + 1))
    starts = np.arange(len(offsets))[:, None] * netlist.n_inputs + np.arange(netlist.n_inputs + 1)

    near = twins.synapse_neuron < steady
    axon, neuron, halves = (column[near] for column in _synapses(twins))
    bounds, segments, row = _segments(axon, neuron, halves, axons)
    axon, neuron, halves = (column[~near] for column in _synapses(twins))
    saturates = netlist.negative_saturates == 1
    under = np.where(saturates, -netlist.negative_threshold, -netlist.reset)
    linear = (netlist.reset_mode == RESET_LINEAR).astype(np.int64)
    reset = np.where(linear == 1, 0, netlist.reset)
    far = np.bincount(axon, minlength=axons) > 0
    registers = (netlist.leak, netlist.threshold, reset, -netlist.negative_threshold, under, linear)
    wiring = kernel.Wiring(
        offsets=offsets.astype(np.int64),
        feed_bounds=ends[starts].astype(np.int64),
        feed_axon=fed[order].astype(np.int32),
        clocks=np.stack([clocked, netlist.clock_period[ticking], netlist.clock_phase[ticking]], axis=1),
        segment_bounds=bounds,
        segments=segments,
        row=row,
        plain=plain,
        steady=np.stack([*(register[first[:steady]] for register in registers), cap[:steady]]).astype(np.int32),
        axon_synapses=np.searchsorted(axon, np.arange(axons + 1)).astype(np.int64),
        synapse_neuron=neuron.astype(np.int32),
        synapse_weight=halves,
        number=first.astype(np.int64),
        parameters=_parameters(netlist, wired, bits)[first],
        direct=_direct(netlist, wired, far)[first],
        instant=_instant(netlist, high)[first],
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


def _synapses(twins: Twins) -> tuple[IntArray, IntArray, IntArray]:
    return twins.synapse_axon, twins.synapse_neuron, twins.synapse_halves


def _steady_first(
    netlist: CrossbarNetlist, twins: Twins, low: int, high: int, *, careful: bool
) -> tuple[Twins, int, int, IntArray]:
    """The same kinds with steady neurons first; how many are plain, and steady in all; and the cap of each kind.

    Steady are neurons without random numbers and reversal whose registers, and all that can reach them in a tick, leave
    the membrane within its range: *plain* ones, which are reset to a value and held at their negative threshold, those
    that are reset to values on both sides, and those that are held and reset by their threshold, as far as they begin a
    tick at their cap or below: the highest membrane from which a tick cannot leave the register.
    """
    first = twins.first_neuron
    positive, negative = (
        np.bincount(twins.synapse_neuron, part, len(first))
        for part in (twins.synapse_halves >> kernel.HALF, twins.synapse_halves & kernel.LOWER)
    )
    simple = ((netlist.mask_bits == 0) & (netlist.leak_reversal == 0))[first]
    to_value, linear = ((netlist.reset_mode == mode)[first] for mode in (RESET_TO, RESET_LINEAR))
    held = (netlist.negative_saturates == 1)[first]
    ends = netlist.reset, netlist.initial
    cap = high - positive - np.maximum(netlist.leak, 0)[first]
    most = np.maximum.reduce([netlist.threshold - 1, *ends])[first]
    least = np.minimum.reduce([-netlist.negative_threshold, *ends])[first] - negative
    least += np.minimum(netlist.leak, 0)[first]
    plain = simple & to_value & held & (most <= cap) & (least >= low)
    other_ends = np.abs(netlist.reset)[first]
    two_sided = (
        to_value & ~held & (np.maximum(most, other_ends) <= cap) & (np.minimum(least, least - other_ends) >= low)
    )
    by_threshold = linear & held & (netlist.initial[first] <= cap) & (least >= low)
    others = simple & (two_sided | (by_threshold & (not careful)))
    if np.count_nonzero(others) > MOST_STEADY:
        others = np.zeros_like(others)
    order = np.argsort(np.where(plain, 0, np.where(others, 1, 2)), kind="stable")
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
    count = int(np.count_nonzero(plain))
    return ordered, count, count + int(np.count_nonzero(others)), cap[order]


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


def _parameters(netlist: CrossbarNetlist, wired: IntArray, bits: int) -> kernel.Int32:
    """Columns of the kernel."""
    target, delay = np.full(netlist.n_neurons, -1), np.zeros(netlist.n_neurons, np.int64)
    target[netlist.wire_neuron], delay[netlist.wire_neuron] = wired, netlist.wire_delay
    columns = {
        kernel.LEAK: netlist.leak,
        kernel.REVERSAL: netlist.leak_reversal,
        kernel.THRESHOLD: netlist.threshold,
        kernel.MASK_BITS: netlist.mask_bits,
        kernel.RESET_MODE: netlist.reset_mode,
        kernel.RESET: netlist.reset,
        kernel.NEGATIVE: netlist.negative_threshold,
        kernel.SATURATES: netlist.negative_saturates,
        kernel.REST: _rests(netlist, bits),
        kernel.WIRE_AXON: target,
        kernel.WIRE_DELAY: delay,
        kernel.VOTES_FROM: np.where(netlist.readout_class >= 0, netlist.readout_first, -1),
    }
    return np.stack([columns[i] for i in range(len(columns))], axis=1).astype(np.int32)


def _rests(netlist: CrossbarNetlist, bits: int) -> IntArray:
    """Membrane at which each neuron without arrivals stays, silent, or ``NO_REST`` where it does not come to one."""
    names = [name for name in Neuron.__dataclass_fields__ if name != "membrane"]
    columns = np.stack([*(getattr(netlist, name) for name in names), netlist.initial], axis=1)
    distinct, which = np.unique(columns, axis=0, return_inverse=True)
    found = np.full(len(distinct), kernel.NO_REST)
    for row, values in enumerate(distinct.tolist()):
        neuron = Neuron(*values)
        for _ in range(SETTLING):
            before = neuron.membrane
            spiked, left = neuron_tick(neuron, 0, 0, 0, bits)
            if not spiked and not left and neuron.membrane == before and not neuron.mask_bits:
                found[row] = before
                break
    return found[which.reshape(-1)]


def _held(twins: Twins, aims: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of a table that lead to the first axon of a kind, and that kind; those of its twins say the same."""
    rows = np.flatnonzero(twins.first_axon[twins.axon[aims]] == aims)
    return rows, twins.axon[aims[rows]]


def _direct(netlist: CrossbarNetlist, wired: IntArray, far: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Whether the spikes of each neuron need not be queued; `far` axons reach neurons that are not steady."""
    aims = netlist.axons_at(netlist.cores_at(netlist.wire_x, netlist.wire_y), netlist.wire_line)
    others = (
        netlist.axons_at(netlist.feed_core, netlist.feed_line),
        netlist.axons_at(netlist.clock_core, netlist.clock_line),
    )
    alone = np.bincount(np.concatenate([aims, *others]), minlength=netlist.n_axons) == 1
    found = np.zeros(netlist.n_neurons, np.bool_)
    found[netlist.wire_neuron] = alone[aims] & ~far[wired] & (netlist.wire_delay == 1)
    return found


def _instant(netlist: CrossbarNetlist, high: int) -> kernel.Int32:
    """Leak of the neurons that :func:`builder.history_free` describes; 0 for all others."""
    neuron, axon = netlist.neuron_of_synapse(), netlist.axon_of_synapse()
    weight = netlist.weight[neuron, netlist.axon_type[axon]]
    sums = [np.bincount(neuron, np.maximum(sign * weight, 0), netlist.n_neurons) for sign in (1, -1)]
    plain = (netlist.leak < 0) & (netlist.reset_mode == RESET_TO) & (np.maximum(*sums) - netlist.leak <= high)
    for name in ("leak_reversal", "threshold", "mask_bits", "reset", "negative_threshold", "initial"):
        plain &= getattr(netlist, name) == 0
    return np.where(plain, netlist.leak, 0).astype(np.int32)


def simulate(
    network: CrossbarNetlist | Engine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    seed: int = 0,
    spikes: bool = False,
    membranes: bool = False,
) -> Trace:
    """Run recordings through the cores, as :func:`spec.simulate` does each.

    Parameters
    ----------
    network : CrossbarNetlist or Engine
        A network that breaks no rule of its chip, or what :func:`prepare` made of it.
    events : (samples, n_inputs, T) uint8 or bool
        Input events; any value but zero is an event.
    lengths : (samples,) int64, optional
        Data steps of each recording where some are shorter than T; what comes after them is not run.
    seed : int
        Of the random numbers; the same for all recordings, so that none depends on its neighbours.
    spikes, membranes : bool
        Keep them, at one and four bytes a neuron and tick.

    Raises
    ------
    DataError
        If the recordings have another number of input channels than the network.
    NumericRangeError
        If they would take more ticks than a run can count.
    """
    engine = network if isinstance(network, Engine) else prepare(network)
    netlist = engine.netlist
    check_channels(netlist, events.shape[1])
    samples, channels, whole = events.shape
    steps = np.full(samples, whole) if lengths is None else np.asarray(lengths, np.int64)
    most = netlist.ticks(whole)
    if most >= MOST_TICKS:
        raise NumericRangeError(f"recordings of {whole} data steps take {most} ticks, {MOST_TICKS - 1} can be counted")
    twins = engine.twins
    neurons = len(twins.first_neuron)
    axons = np.zeros((samples, len(twins.first_axon)), np.int64)
    spiked, votes, overflows = np.zeros((3, samples, neurons), np.int64)
    raster = np.zeros((samples, most if spikes else 0, neurons), np.bool_)
    held = np.zeros((samples, most if membranes else 0, neurons), np.int32)
    inputs, merged = np.zeros((samples, channels), np.int64), np.zeros(samples, np.int64)

    def one(sample: int) -> None:
        arriving = np.ascontiguousarray(events[sample, :, : steps[sample]].T).astype(np.uint8)
        inputs[sample] = np.count_nonzero(arriving, axis=0)
        arrays = (axons, spiked, votes, overflows, raster, held)
        merged[sample] = kernel.run(
            arriving,
            netlist.bin_ticks,
            netlist.ticks(int(steps[sample])),
            np.uint64(seed),
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
        return simulate(again, events, lengths=lengths, seed=seed, spikes=spikes, membranes=membranes)
    counts = Counts(
        ticks=steps * netlist.bin_ticks + netlist.drain,
        inputs=inputs,
        spikes=spiked[:, twins.neuron],
        votes=votes[:, twins.neuron],
        axons=axons[:, twins.axon],
        merged=merged,
        overflows=overflows[:, twins.neuron],
    )
    return Trace(
        counts=counts,
        spikes=raster[:, :, twins.neuron] if spikes else None,
        membranes=held[:, :, twins.neuron] if membranes else None,
    )
