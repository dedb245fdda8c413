"""The fast twin of :mod:`runtime.truenorth.spec`: crossbar cores by events, bit for bit the same."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from compiler.errors import NumericRangeError
from compiler.fixedpoint import IntArray
from compiler.targets import CROSSBARS, load_target
from compiler.truenorth.netlist import CrossbarNetlist
from compiler.truenorth.rules import signed_range
from runtime.truenorth import kernel
from runtime.truenorth.spec import Neuron, neuron_tick
from runtime.truenorth.trace import Counts, EventArray, Trace, check_channels

Int32 = npt.NDArray[np.int32]

SETTLING = 64
"""Ticks within which a neuron without input must come to rest to be let sleep."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Engine:
    """A network as the kernel takes it.

    Parameters
    ----------
    netlist : CrossbarNetlist
    low, high : int
        Range of the membrane register.
    slots : int
        Power of two above every delay.
    offsets : (offsets,) int64
        Ticks of a data step in which feeds inject.
    feed_bounds : (offsets, channels + 1) int64
        Rows of `feed_axon` for each of them and each channel.
    feed_axon : (feeds,) int32
    clocks : (clocks, 3) int64
        Axon, period, phase.
    synapse_neuron, synapse_weight : (synapses,) int32
        Neuron id and weight of each crossing point.
    parameters : (neurons, 12) int32
        Columns as the kernel names them.
    initial : (neurons,) int32
    """

    netlist: CrossbarNetlist
    low: int
    high: int
    slots: int
    offsets: IntArray
    feed_bounds: IntArray
    feed_axon: Int32
    clocks: IntArray
    synapse_neuron: Int32
    synapse_weight: Int32
    parameters: Int32
    initial: Int32


def prepare(netlist: CrossbarNetlist) -> Engine:
    """Arrange a network that breaks no rule of its chip for the kernel."""
    bits = load_target(netlist.target, CROSSBARS).limit("neuron.membrane_bits")
    low, high = signed_range(bits)
    neuron, axon = netlist.neuron_of_synapse(), netlist.axon_of_synapse()
    wired = netlist.axons_at(netlist.cores_at(netlist.wire_x, netlist.wire_y), netlist.wire_line)
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
    offsets = np.unique(netlist.feed_tick)
    key = np.searchsorted(offsets, netlist.feed_tick) * netlist.n_inputs + netlist.feed_channel
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(len(offsets) * netlist.n_inputs + 1))
    bounds = np.stack(
        [ends[k * netlist.n_inputs : (k + 1) * netlist.n_inputs + 1] for k in range(len(offsets))] or [ends]
    )
    clocked = netlist.axons_at(netlist.clock_core, netlist.clock_line)
    return Engine(
        netlist=netlist,
        low=low,
        high=high,
        slots=1 << int(netlist.wire_delay.max(initial=1)).bit_length(),
        offsets=offsets,
        feed_bounds=bounds,
        feed_axon=netlist.axons_at(netlist.feed_core, netlist.feed_line)[order].astype(np.int32),
        clocks=np.stack([clocked, netlist.clock_period, netlist.clock_phase], axis=1),
        synapse_neuron=neuron.astype(np.int32),
        synapse_weight=netlist.weight[neuron, netlist.axon_type[axon]].astype(np.int32),
        parameters=np.stack([columns[i] for i in range(len(columns))], axis=1).astype(np.int32),
        initial=netlist.initial.astype(np.int32),
    )


def _rests(netlist: CrossbarNetlist, bits: int) -> IntArray:
    """Membrane at which each neuron without arrivals stays, silent, or ``NO_REST`` where it does not come to one."""
    names = [name for name in Neuron.__dataclass_fields__ if name != "membrane"]
    columns = np.stack([getattr(netlist, name) for name in names] + [netlist.initial], axis=1)
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


def simulate(
    network: CrossbarNetlist | Engine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    seed: int = 0,
    spikes: bool = False,
    membranes: bool = False,
) -> Trace:
    """Run recordings through the cores, as :func:`runtime.truenorth.spec.simulate` does each.

    Parameters
    ----------
    network : CrossbarNetlist or Engine
        A network that breaks no rule of its chip, or what :func:`prepare` made of it.
    events : (samples, n_inputs, T) uint8 or bool
        Input events; any value but zero is an event.
    lengths : (samples,) int64, optional
        Data steps of each recording where some are shorter than T; what comes after them is not heard.
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
    if most >= 2**31:
        raise NumericRangeError(f"recordings of {whole} data steps take {most} ticks, {2**31 - 1} are counted")
    neurons = netlist.n_neurons
    fired = np.zeros((samples, most if spikes else 0, neurons), np.bool_)
    held = np.zeros((samples, most if membranes else 0, neurons), np.int32)
    counted, votes, overflows = np.zeros((3, samples, neurons), np.int64)
    axons = np.zeros((samples, netlist.n_axons), np.int64)
    merged, inputs = np.zeros(samples, np.int64), np.zeros((samples, channels), np.int64)

    def one(sample: int) -> None:
        heard = np.ascontiguousarray(events[sample, :, : steps[sample]]).astype(np.uint8)
        inputs[sample] = np.count_nonzero(heard, axis=1)
        merged[sample] = kernel.run(
            heard,
            netlist.bin_ticks,
            netlist.ticks(int(steps[sample])),
            np.uint64(seed),
            engine.low,
            engine.high,
            engine.slots,
            engine.offsets,
            engine.feed_bounds,
            engine.feed_axon,
            engine.clocks,
            netlist.axon_synapses,
            engine.synapse_neuron,
            engine.synapse_weight,
            engine.parameters,
            engine.initial,
            counted[sample],
            votes[sample],
            axons[sample],
            overflows[sample],
            fired[sample],
            held[sample],
        )

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(one, range(samples)))
    counts = Counts(
        ticks=steps * netlist.bin_ticks + netlist.drain,
        inputs=inputs,
        spikes=counted,
        votes=votes,
        axons=axons,
        merged=merged,
        overflows=overflows,
    )
    return Trace(counts=counts, spikes=fired if spikes else None, membranes=held if membranes else None)
