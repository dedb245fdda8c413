"""What of a compiled network its recordings do not need: each part is taken away and the decisions are counted again.

A part is taken away by silencing it: synapses from it weigh nothing, so every other spike is as if it were
not there. What is silenced together is found by bisection along a ranking, least effect first: of the sets
that are looked at, the largest that changes no more training decisions than allowed. Nothing is chosen on
the recordings that are reported.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from spikeloom.compiler.arrays import frozen
from spikeloom.compiler.checkpoint import Checkpoint, Dense
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.compartments import (
    ONE_STEP_SUM_MAX,
    Compilation,
    Netlist,
    layer_of,
    rounded,
    without,
    without_channels,
)
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.report.console import Progress


def silenced(netlist: Netlist, sources: IntArray) -> Netlist:
    """The netlist with synapses of weight zero from some sources: input channels, then compartments."""
    silent = np.zeros(netlist.n_inputs + netlist.n_compartments, np.bool_)
    silent[sources] = True
    away = np.repeat(silent[netlist.axon_source], np.diff(netlist.axon_synapses))
    weight = np.where(away, 0, netlist.synapse_weight).astype(netlist.synapse_weight.dtype)
    return replace(netlist, synapse_weight=weight)


def channels_of(netlist: Netlist, taxels: IntArray) -> IntArray:
    """Input channels of some taxels; shape (taxels, polarities)."""
    return np.asarray(taxels[:, None] * netlist.polarities + np.arange(netlist.polarities))


def spared_neurons(netlist: Netlist, spikes: IntArray, fits: Callable[[Netlist], bool]) -> IntArray:
    """Compartments that may go together so that the rest `fits`; at least those that never spiked."""
    share = effects(netlist, spikes)
    order = np.argsort(share, kind="stable")
    order = order[np.isfinite(share[order])]
    sources = netlist.n_inputs + order
    never = int(np.count_nonzero(share == 0))
    return order[: most_spared(len(order), never, lambda count: fits(silenced(netlist, sources[:count])))]


def spared_taxels(
    netlist: Netlist, training: Recordings, alone: IntArray, fits: Callable[[Netlist], bool]
) -> IntArray:
    """Taxels that may go together; those first without which, `alone`, fewest decisions change."""
    events = training.events.sum(axis=(0, 2, 3), dtype=np.int64)
    order = np.lexsort((events, alone))
    sources = channels_of(netlist, order)
    silent = int(np.count_nonzero(events == 0))
    return order[: most_spared(len(order), silent, lambda count: fits(silenced(netlist, sources[:count])))]


def effects(netlist: Netlist, spikes: IntArray) -> FloatArray:
    """Share that each compartment has in what its layer sends on; shape (compartments,).

    Spikes (compartments,) count by the weights that they meet, in thresholds; those that vote have the share
    infinity.
    """
    met = np.zeros(netlist.n_inputs + netlist.n_compartments)
    for core in range(netlist.n_cores):
        source, compartment, weight = netlist.synapses_of(core)
        np.add.at(met, source, np.abs(weight) / np.maximum(netlist.threshold[compartment], 1))
    sent = spikes * met[netlist.n_inputs :]
    whole = np.bincount(netlist.layer, sent, len(netlist.layers))
    share: FloatArray = sent / np.maximum(whole, 1e-300)[netlist.layer]
    share[netlist.voters] = np.inf
    return share


def most_spared(parts: int, least: int, fits: Callable[[int], bool]) -> int:
    """Bisect for a largest number of parts that fits; fewer than `least` are not tried.

    >>> most_spared(4, 1, lambda count: count <= 3)
    3
    """
    low = least
    high = parts
    while low < high:
        middle = (low + high + 1) // 2
        if fits(middle):
            low = middle
        else:
            high = middle - 1
    return low


def without_taxels(compilation: Compilation, taxels: IntArray) -> Compilation:
    """Without the synapses from some taxels."""
    deaf = np.zeros(compilation.netlist.n_inputs, np.bool_)
    deaf[channels_of(compilation.netlist, taxels)] = True
    return replace(compilation, integer=without_channels(compilation.integer, deaf))


def laid_out(compilation: Compilation, unused: IntArray | None = None) -> Netlist:
    """Lay out what is left, without some compartments of the netlist; a layer keeps one neuron."""
    netlist = compilation.netlist
    gone = np.zeros(netlist.n_compartments, np.bool_)
    gone[[] if unused is None else unused] = True
    masks = tuple(np.zeros(population.size, np.bool_) for population in compilation.integer.populations)
    for layer, mask in enumerate(masks):
        ids = netlist.compartments_of(layer)
        mask[netlist.neuron[ids]] = gone[ids]
        if len(ids) and gone[ids].all():
            mask[netlist.neuron[ids[0]]] = False
    return without(compilation, masks)


def narrowed(checkpoint: Checkpoint, gone: Mapping[str, IntArray]) -> Checkpoint:
    """A float network without some neurons of its dense layers, by their numbers; a layer keeps one neuron.

    Neurons of the first layer share their weights, so they stay.
    """
    dense: list[Dense] = []
    kept = np.arange(checkpoint.dense[0].weight.shape[1])
    for stage in checkpoint.dense:
        columns = kept
        kept = np.setdiff1d(np.arange(len(stage.bias)), gone.get(stage.name, ()))
        kept = kept if len(kept) else np.arange(1)
        weight = np.ascontiguousarray(stage.weight[np.ix_(kept, columns)])
        dense.append(Dense(name=stage.name, weight=frozen(weight), bias=frozen(stage.bias[kept])))
    return replace(checkpoint, dense=tuple(dense))


def changed_alone(netlist: Netlist, of: Recordings, wanted: IntArray) -> IntArray:
    """Decisions that change without each taxel; shape (taxels,)."""
    machine = machine_of(netlist)
    changed = np.zeros(netlist.taxels, np.int64)
    progress = Progress(netlist.taxels)
    for taxel in range(netlist.taxels):
        progress(taxel, f"{of.split}, taxels one at a time")
        if of.events[:, taxel].any():
            without_it = of.events.copy()
            without_it[:, taxel] = 0
            changed[taxel] = np.count_nonzero(
                machine.run(without_it, lengths=of.lengths).decisions != wanted
            )
    return changed


def without_hops(
    compilation: Compilation, loaded: LoadedNetwork, hops: tuple[int, ...]
) -> Compilation | None:
    """A first layer that lacks some hops, rounded to the storage that it has; others as they are.

    Neurons that were left out stay out. None where a register cannot hold what is left.
    """
    checkpoint = loaded.checkpoint
    convolution = loaded.network.convolution
    assert checkpoint is not None, "only a checkpoint has hops"
    assert convolution is not None
    fewer = checkpoint.hops.copy()
    fewer[list(hops)] = 0
    integer = compilation.integer
    network = expand(replace(checkpoint, hops=fewer), convolution.propagation)
    form = integer.forms[0]
    form = replace(form, threshold=np.maximum(form.threshold, 1))
    layer = rounded(layer_of(network, 0), form)
    if layer is None or layer.reached > ONE_STEP_SUM_MAX:
        return None
    others = (p for p in integer.projections if p.post != 0)
    return replace(compilation, integer=replace(integer, projections=(*layer.projections, *others)))
