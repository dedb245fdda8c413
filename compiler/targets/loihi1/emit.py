"""Write a partitioned, placed network down as a netlist.

Every non-zero synapse is stored once; nothing else changes. Lists are stored sparse unless they are nearly
full, as far as the core's memory allows it, because a zero inside a dense list is visited, and paid, like
any other synapse.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spikeloom.compiler.arrays import frozen, read_only, read_only_float
from spikeloom.compiler.ir import INPUT, depths, fan_in
from spikeloom.compiler.passes.prune import Masks, none_of
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import MANTISSA, IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout import core_needs
from spikeloom.compiler.targets.loihi1.netlist import Layer, Netlist
from spikeloom.compiler.types import AnyArray, IntArray


def _entries(lists: core_needs.Lists, dense: IntArray, base: int) -> tuple[AnyArray, ...]:
    """Synapses of lists: entries of each list, targets on a core where the chunk starts at `base`, mantissas."""
    length = np.where(dense, lists.last - lists.first + 1, lists.nonzero)
    start = np.cumsum(length) - length
    each = np.repeat(np.arange(len(length)), lists.nonzero)  # list of each synapse that is not zero
    rank = np.arange(len(each)) - np.repeat(np.cumsum(lists.nonzero) - lists.nonzero, lists.nonzero)
    place = start[each] + np.where(dense[each], lists.row - lists.first[each], rank)
    within = np.arange(length.sum()) - np.repeat(start, length)
    dense_target = np.repeat(lists.first, length) + within + base
    target = dense_target.astype(core_needs.PLACE)
    target[place] = base + lists.row
    weight = np.zeros(len(target), MANTISSA)
    weight[place] = lists.mantissa
    return length, target, weight


def _layers(network: IntegerNetwork, removed: Masks) -> tuple[Layer, ...]:
    return tuple(
        Layer(
            name=population.name,
            neurons=population.size,
            unread=tuple(np.flatnonzero(removed[post]).tolist()),
            depth=depth,
            beta=population.beta,
            theta=population.theta,
            alpha=population.alpha,
            weight_bits=max(p.bits for p in network.projections if p.post == post),
            synapses=int(fan_in(network, post).sum()),
            max_fan_in=int(fan_in(network, post).max()),
        )
        for post, (population, depth) in enumerate(zip(network.populations, depths(network), strict=True))
    )


def _axons(
    network: IntegerNetwork, cores: core_needs.Cores, target: Target, compartment_id: Sequence[IntArray]
) -> tuple[dict[str, Any], list[core_needs.SynapseFormat]]:
    """Input axons of all cores with their synapses, by column of the netlist, and the formats that they use.

    `compartment_id` are those of the neurons of each population.
    """
    per_core = np.zeros(len(cores), np.int64)
    number: dict[core_needs.SynapseFormat, int] = {}
    columns: list[tuple[IntArray, ...]] = []
    places = bytearray()  # grows in place, so nothing is held twice
    weights = bytearray()
    needs = core_needs.Needs(network, target)
    for core, chunks in enumerate(cores):
        base = 0
        lean = needs.lean(chunks)
        for chunk in chunks:
            index = core_needs.index_bits(base + chunk.size - 1, target)
            for lists in needs.lists(chunk):
                projection = network.projections[lists.projection]
                dense, _ = core_needs.choose_dense(
                    lists, projection, base, chunk.size, lean=lean, target=target
                )
                flags, seen, which = np.unique(dense, return_index=True, return_inverse=True)
                keys = [(projection.bits, projection.exponent, 0 if flag else index) for flag in flags]
                for at in np.argsort(seen):
                    number.setdefault(keys[at], len(number))
                formats = np.array([number[key] for key in keys], np.int64)[which]
                source = lists.source
                if projection.pre != INPUT:
                    source = network.input.size + compartment_id[projection.pre][source]
                per_core[core] += len(source)
                length, place, weight = _entries(lists, dense, base)
                columns.append((source, formats, length))
                places += place.data
                weights += weight.data
            needs.drop(chunk)  # all of them would be as much as the netlist
            base += chunk.size
    source, formats, length = map(np.concatenate, zip(*columns, strict=True))
    return {
        "core_axons": read_only(np.cumsum([0, *per_core])),
        "axon_source": frozen(source),
        "axon_format": frozen(formats),
        "axon_synapses": read_only(np.append(0, np.cumsum(length))),
        "synapse_target": frozen(np.frombuffer(places, core_needs.PLACE)),
        "synapse_weight": frozen(np.frombuffer(weights, MANTISSA)),
    }, list(number)


def _votes(network: IntegerNetwork, layer: IntArray, neuron: IntArray) -> IntArray:
    """Class that each compartment votes for, -1 for none."""
    voting = layer == network.readout.population
    votes = np.full(len(layer), -1)
    votes[voting] = network.readout.label[neuron[voting]]
    return votes


def emit(
    network: IntegerNetwork,
    cores: core_needs.Cores,
    tiles: tuple[int, ...],
    target: Target,
    provenance: Mapping[str, Any],
    *,
    origin: IntegerNetwork | None = None,
    identity: tuple[IntArray, ...] | None = None,
    unread: Masks | None = None,
) -> Netlist:
    """Assemble the netlist of a network on cores, with a tile for each of them and JSON values to remember.

    Where neurons were left out, `origin` is the network with all of them, `identity` says for each
    population which of them are held, and `unread` which were removed although they fire, because their
    spikes reach no neuron.
    """
    order = [chunk for chunks in cores for chunk in chunks]
    layer = np.concatenate([np.full(chunk.size, chunk.population) for chunk in order])
    numbers = np.concatenate([np.arange(chunk.first, chunk.last) for chunk in order])
    sizes = np.cumsum([population.size for population in network.populations])
    compartment_id = np.split(np.lexsort((numbers, layer)), sizes[:-1])

    def column(name: str) -> AnyArray:
        """A field of the populations, of each compartment."""
        return np.concatenate(
            [getattr(network.populations[c.population], name)[c.first : c.last] for c in order]
        )

    known = numbers
    if identity is not None:
        known = np.concatenate([identity[c.population][c.first : c.last] for c in order])
    axons, formats = _axons(network, cores, target, compartment_id)
    return Netlist(
        target=target.name,
        taxels=network.input.taxels,
        polarities=network.input.polarities,
        classes=network.classes,
        layers=_layers(origin or network, unread or none_of(network)),
        core_tile=read_only(tiles),
        core_compartments=read_only(
            np.cumsum([0, *(sum(chunk.size for chunk in chunks) for chunks in cores)])
        ),
        layer=read_only(layer),
        neuron=read_only(known),
        decay_u=read_only([network.populations[post].decay_u for post in layer]),
        decay_v=read_only([network.populations[post].decay_v for post in layer]),
        threshold=read_only(column("threshold")),
        bias_mantissa=read_only(column("bias_mantissa")),
        bias_exponent=read_only(column("bias_exponent")),
        scale=read_only_float(column("scale")),
        readout_class=read_only(_votes(network, layer, numbers)),
        **axons,
        format_weight_bits=read_only([bits for bits, _, _ in formats]),
        format_exponent=read_only([exponent for _, exponent, _ in formats]),
        format_index_bits=read_only([index for _, _, index in formats]),
        provenance=dict(provenance),
        clocks=network.input.clocks,
        bins=network.input.bins,
    )
