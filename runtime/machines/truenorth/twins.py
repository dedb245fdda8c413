"""Neurons that are alike and receive the same always spike together: the engine runs one of each kind.

A neuron of TrueNorth has one target, so a network has each of its neurons as often as there are axons that
must receive it, and each of these axons brings its share of one weight. Found here from the inputs on,
without knowing how the network was made: axons that only one thing leads to are of one kind if these are,
neurons are of one kind if their registers are equal and the same weights reach them from the same kinds of
axons. Positive and negative weights are added up apart, so that the counts of registers that were left stay
the same, too.
"""

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.machines.truenorth.kernel import HALF, PARAMETERS

_FEED, _CLOCK, _WIRE, _ITSELF = range(4)
_REGISTERS = (*PARAMETERS, "initial", "readout_first")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twins:
    """Which neurons and axons are of a kind."""

    # neuron, axon: (neurons,), (axons,) int64; kind of each
    neuron: IntArray
    axon: IntArray
    # first_neuron, first_axon: (kinds,) int64; the first of each kind
    first_neuron: IntArray
    first_axon: IntArray
    # synapse_axon, synapse_neuron, synapse_halves: (pairs,) int64; kinds that are joined, by axon and
    # neuron, and the weight in halves of the kernel
    synapse_axon: IntArray
    synapse_neuron: IntArray
    synapse_halves: IntArray


def find_twins(netlist: CrossbarNetlist) -> Twins:
    """Kinds of a network that breaks no rule."""
    neuron = netlist.neuron_of_synapse()
    axon = netlist.axon_of_synapse()
    aims = netlist.aims()
    weight = netlist.weight[neuron, netlist.axon_type[axon]]
    halves = np.where(weight > 0, weight << HALF, -weight)
    single = np.bincount(np.concatenate(aims), minlength=netlist.n_axons) == 1
    sources = _sources(netlist, aims, single)
    registers = _registers(netlist, single[aims[_WIRE]])
    kind = np.arange(netlist.n_neurons)
    wired = sources[:, 0] == _WIRE
    while True:
        known = sources.copy()
        known[wired, 1] = kind[sources[wired, 1]]
        axon_kind = np.unique(known, axis=0, return_inverse=True)[1].reshape(-1)
        pairs, weights = _pairs(axon_kind, neuron, axon, halves)
        neuron_kinds = _neuron_kinds(registers, pairs, weights)
        if neuron_kinds.max(initial=-1) == kind.max(initial=-1):
            break
        kind = neuron_kinds
    first_neuron, first_axon = (np.unique(kinds, return_index=True)[1] for kinds in (kind, axon_kind))
    # pairs are by neuron; those of the first of each kind stand for all
    stays = np.zeros(netlist.n_neurons, np.bool_)
    stays[first_neuron] = True
    kept = stays[pairs[0]]
    ends = kind[pairs[0][kept]]
    starts = pairs[1][kept]
    sums = weights[kept]
    order = np.lexsort((ends, starts))
    return Twins(
        neuron=kind,
        axon=axon_kind,
        first_neuron=first_neuron,
        first_axon=first_axon,
        synapse_axon=starts[order],
        synapse_neuron=ends[order],
        synapse_halves=sums[order],
    )


def _sources(netlist: CrossbarNetlist, aims: tuple[IntArray, ...], single: BoolArray) -> IntArray:
    """What leads to each axon, (axons, 3), or ``_ITSELF`` where that is not one thing."""
    columns_of = (
        (netlist.feed_channel, netlist.feed_tick),
        (netlist.clock_period, netlist.clock_phase),
        (netlist.wire_neuron, netlist.wire_delay),
    )
    axons = np.arange(netlist.n_axons)
    sources = np.stack([np.full_like(axons, _ITSELF), axons, np.zeros_like(axons)], axis=1)
    for what, (aim, columns) in enumerate(zip(aims, columns_of, strict=True)):
        only = single[aim]
        sources[aim[only]] = np.stack([np.full(len(aim), what), *columns], axis=1)[only]
    return sources


def _registers(netlist: CrossbarNetlist, alone: BoolArray) -> IntArray:
    """Everything that neurons of a kind share, beside their inputs: registers, whether they vote, where they lead."""
    leads = np.full((netlist.n_neurons, 2), -1)
    # to an axon that it has `alone`, with a delay; or to one that others reach, too, where two spikes of a
    # tick merge
    leads[netlist.wire_neuron, 0] = np.where(alone, -2, netlist.wire_neuron)
    leads[netlist.wire_neuron, 1] = netlist.wire_delay
    columns = [*(getattr(netlist, name) for name in _REGISTERS), netlist.readout_class >= 0, *leads.T]
    rows = np.stack(columns, axis=1).astype(np.int64).reshape(netlist.n_neurons, -1)
    return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1))


def _pairs(
    axon_kind: IntArray, neuron: IntArray, axon: IntArray, halves: IntArray
) -> tuple[IntArray, IntArray]:
    """Neurons and kinds of axons that reach them, (2, pairs) by neuron, and the added weights."""
    most = int(axon_kind.max(initial=0)) + 1
    keys, index = np.unique(neuron * most + axon_kind[axon], return_inverse=True)
    sums = np.zeros(len(keys), np.int64)
    np.add.at(sums, index.reshape(-1), halves)
    return np.stack(np.divmod(keys, most)), sums


def _neuron_kinds(registers: IntArray, pairs: IntArray, sums: IntArray) -> IntArray:
    """Kind of each neuron from its registers and what reaches it."""
    bounds = np.searchsorted(pairs[0], np.arange(len(registers) + 1)).tolist()
    rows = np.ascontiguousarray(np.stack([pairs[1], sums], axis=1))
    known: dict[tuple[int, bytes], int] = {}
    neuron_kinds = [
        known.setdefault((register, rows[bounds[n] : bounds[n + 1]].tobytes()), len(known))
        for n, register in enumerate(registers.tolist())
    ]
    return np.array(neuron_kinds, np.int64)
