"""What of a compiled network its recordings do not need: each part is taken away and the decisions are counted again.

A part is taken away by silencing it: synapses from it weigh nothing, so every other spike is as if it were not there.
What is silenced together is found by bisection along a ranking, least effect first: of the sets that are looked at, the
largest that changes no more training decisions than allowed. Nothing is chosen on the recordings that are reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler import Compilation, Netlist, layer_of, rounded, without
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX
from spikeloom.compiler.ir import Form, IntegerNetwork
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.passes.prune import without_channels
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.studies.pruning.results import Costs


def spikes_of(netlist: Netlist, of: Recordings) -> IntArray:
    """Spikes of each compartment in all recordings; (compartments,)."""
    spikes: IntArray = machine_of(netlist).run(of.events, lengths=of.lengths).counts.sum(axis=0)
    return spikes


def decisions(netlist: Netlist, of: Recordings) -> IntArray:
    """Class of each recording."""
    return machine_of(netlist).run(of.events, lengths=of.lengths).decisions


def priced(netlist: Netlist, of: Recordings) -> tuple[IntArray, Costs]:
    """Class of each recording, and what an inference costs."""
    run, price = machine_of(netlist).price(of.events, bin_s=1.0, lengths=of.lengths)  # at full speed, whatever the pace
    return run.decisions, Costs(
        operations=float(price.synaptic_operations.mean()),
        energy_j={name: float(each.mean()) for name, each in price.energy_j.items()},
        time_s={name: float(each.mean()) for name, each in price.time_s.items()},
        cores=netlist.n_cores,
        neurons=netlist.n_compartments,
        synapses=netlist.n_synapses,
    )


def silenced(netlist: Netlist, sources: BoolArray) -> Netlist:
    """The netlist with synapses of weight zero from some sources: input channels, then compartments."""
    away = np.repeat(sources[netlist.axon_source], np.diff(netlist.axon_synapses))
    weight = np.where(away, 0, netlist.synapse_weight).astype(netlist.synapse_weight.dtype)
    return replace(netlist, synapse_weight=weight)


def effects(netlist: Netlist, spikes: IntArray) -> FloatArray:
    """Share that each compartment has in what its layer sends on; shape (compartments,).

    Spikes (compartments,) count by the weights that they meet, in thresholds; those that vote have the share infinity.
    """
    met = np.zeros(netlist.n_inputs + netlist.n_compartments)
    for core in range(netlist.n_cores):
        source, compartment, weight = netlist.synapses_of(core)
        np.add.at(met, source, np.abs(weight) / np.maximum(netlist.threshold[compartment], 1))
    sent = spikes * met[netlist.n_inputs :]
    whole = np.bincount(netlist.layer, sent, len(netlist.layers))
    share: FloatArray = sent / np.maximum(whole, 1e-300)[netlist.layer]
    share[netlist.readout_class >= 0] = np.inf
    return share


def most_spared(order: IntArray, least: int, fits: Callable[[IntArray], bool]) -> IntArray:
    """Bisect for a longest beginning of `order` that fits; one shorter than `least` is not tried.

    Examples
    --------
    >>> most_spared(np.array([4, 2, 7, 1]), 1, lambda parts: len(parts) <= 3).tolist()
    [4, 2, 7]
    """
    low, high = least, len(order)
    while low < high:
        middle = (low + high + 1) // 2
        if fits(order[:middle]):
            low = middle
        else:
            high = middle - 1
    return order[:low]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """A compiled network, what is left of it, and training recordings.

    At most so many of the `wanted` decisions (samples,) are `allowed` to change on them.
    """

    compilation: Compilation
    integer: IntegerNetwork
    training: Recordings
    wanted: IntArray
    allowed: int

    def differ(self, netlist: Netlist) -> int:
        """Training decisions that a netlist changes."""
        return int(np.count_nonzero(decisions(netlist, self.training) != self.wanted))

    def built(self, unused: IntArray | None = None, of: Netlist | None = None) -> Netlist:
        """Lay out what is left, without some compartments of a netlist `of` it."""
        masks = tuple(np.zeros(population.size, np.bool_) for population in self.integer.populations)
        if unused is not None and of is not None:
            for layer, mask in enumerate(masks):
                mask[of.neuron[unused[of.layer[unused] == layer]]] = True
                held = of.neuron[of.compartments_of(layer)]
                if len(held) and mask[held].all():
                    mask[held[0]] = False  # a layer keeps one neuron
        return without(replace(self.compilation, integer=self.integer), masks)

    def spare_neurons(self, netlist: Netlist, spikes: IntArray) -> IntArray:
        """Compartments that may go together, those that never spiked first; at least these."""
        share = effects(netlist, spikes)
        order = np.argsort(share, kind="stable")
        order = order[np.isfinite(share[order])]
        never = int(np.count_nonzero(share == 0))

        def fits(gone: IntArray) -> bool:
            sources = np.zeros(netlist.n_inputs + netlist.n_compartments, np.bool_)
            sources[netlist.n_inputs + gone] = True
            return self.differ(silenced(netlist, sources)) <= self.allowed

        return most_spared(order, never, fits)

    def spare_taxels(self, netlist: Netlist, alone: IntArray) -> IntArray:
        """Taxels that may go together; those first without which, `alone`, fewest decisions change."""
        events = self.training.events.sum(axis=(0, 2, 3), dtype=np.int64)
        order = np.lexsort((events, alone))
        return most_spared(
            order,
            int(np.count_nonzero(events == 0)) if np.all(alone[events == 0] == 0) else 0,
            lambda gone: self.differ(silenced(netlist, sources_of(netlist, gone))) <= self.allowed,
        )


def sources_of(netlist: Netlist, taxels: IntArray) -> BoolArray:
    """Channels of some taxels among the sources; shape (n_inputs + compartments,)."""
    found = np.zeros(netlist.n_inputs + netlist.n_compartments, np.bool_)
    channels = np.asarray(taxels)[:, None] * netlist.polarities + np.arange(netlist.polarities)
    found[channels.ravel()] = True
    return found


def without_taxels(integer: IntegerNetwork, netlist: Netlist, taxels: IntArray) -> IntegerNetwork:
    """The integer network without the synapses from some taxels."""
    return without_channels(integer, sources_of(netlist, taxels)[: netlist.n_inputs])


def changed_alone(netlist: Netlist, of: Recordings, wanted: IntArray) -> IntArray:
    """Decisions that change without each taxel; shape (taxels,)."""
    machine, changed = machine_of(netlist), np.zeros(netlist.taxels, np.int64)
    progress = Progress(netlist.taxels)
    for taxel in range(netlist.taxels):
        progress(taxel, f"{of.split}, taxels one at a time")
        if of.events[:, taxel].any():
            without_it = of.events.copy()
            without_it[:, taxel] = 0
            changed[taxel] = np.count_nonzero(machine.run(without_it, lengths=of.lengths).decisions != wanted)
    return changed


def without_hops(
    compilation: Compilation, checkpoint: Checkpoint, adjacency: FloatArray, hops: tuple[int, ...]
) -> IntegerNetwork | None:
    """The integer network with a first layer that lacks some hops, rounded to the storage that it has; others as is.

    Neurons that were left out stay out. None where a register cannot hold what is left.
    """
    fewer = checkpoint.hops.copy()
    fewer[list(hops)] = 0
    integer, network = compilation.integer, expand(replace(checkpoint, hops=fewer), adjacency)
    planes = [p for p in integer.projections if p.post == 0]
    form = Form(
        bits=planes[0].bits,
        exponents=tuple(sorted({p.exponent for p in planes})),
        threshold=np.maximum(integer.populations[0].threshold, 1),
    )
    layer = rounded(layer_of(network, 0), form)
    if layer is None or layer.reached > ONE_STEP_SUM_MAX:
        return None
    return replace(integer, projections=(*layer.projections, *(p for p in integer.projections if p.post != 0)))
