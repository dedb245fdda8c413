"""Write a partitioned, placed network down as a netlist.

Every non-zero synapse is stored once; nothing else changes. Lists are stored sparse unless they are nearly full, as
far as the core's memory allows it, because a zero inside a dense list is visited, and paid, like any other synapse.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import frozen, read_only, read_only_float
from spikeloom.compiler.ir import INPUT, MANTISSA, IntegerNetwork, depths, fan_in
from spikeloom.compiler.passes.prune import Masks, none_of
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import (
    Chunk,
    Cores,
    Lists,
    Needs,
    choose_dense,
    index_bits,
    lists_into,
)
from spikeloom.compiler.targets.loihi1.netlist import Layer, Netlist
from spikeloom.compiler.types import IntArray


def _entries(
    network: IntegerNetwork, chunk: Chunk, lists: Lists, dense: IntArray, base: int
) -> tuple[IntArray, npt.NDArray[np.int32], npt.NDArray[np.int16]]:
    """Synapses of a chunk's lists: entries per list, targets on the core, mantissas (``MANTISSA``)."""
    part = network.projections[lists.projection].weight[chunk.first : chunk.last].tocoo()
    keep = part.data != 0
    (row, column), data = (coordinate[keep] for coordinate in part.coords), part.data[keep]
    order = np.argsort(column, kind="stable")  # rows ascend already
    row, data = row[order], data[order]
    length = np.where(dense, lists.last - lists.first + 1, lists.nonzero)
    start = np.cumsum(length) - length
    each = np.repeat(np.arange(len(length)), lists.nonzero)  # list of each synapse that is not zero
    rank = np.arange(len(row)) - np.repeat(np.cumsum(lists.nonzero) - lists.nonzero, lists.nonzero)
    place = start[each] + np.where(dense[each], row - lists.first[each], rank)
    within = np.arange(length.sum()) - np.repeat(start, length)
    target = (np.repeat(lists.first, length) + within + base).astype(np.int32)  # right for dense lists
    target[place] = base + row
    weight = np.zeros(len(target), MANTISSA)
    weight[place] = data
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


def emit(
    network: IntegerNetwork,
    cores: Cores,
    tiles: tuple[int, ...],
    target: Target,
    provenance: Mapping[str, Any],
    *,
    origin: IntegerNetwork | None = None,
    identity: tuple[IntArray, ...] | None = None,
    unread: Masks | None = None,
) -> Netlist:
    """Assemble the netlist of a network on cores, with a tile for each of them and JSON values to remember.

    Where neurons were left out, `origin` is the network with all of them, `identity` says for each population which of
    them are held, and `unread` which were removed although they fire, because their spikes reach no neuron.
    """
    identity = identity or tuple(np.arange(population.size) for population in network.populations)
    compartment_id = [np.zeros(population.size, np.int64) for population in network.populations]
    placed: list[tuple[Chunk, int, int]] = []  # chunk, core, base on it
    counts: list[int] = []
    for core, chunks in enumerate(cores):
        base = 0
        for chunk in chunks:
            placed.append((chunk, core, base))
            ids = sum(counts) + base + np.arange(chunk.size)
            compartment_id[chunk.population][chunk.first : chunk.last] = ids
            base += chunk.size
        counts.append(base)

    formats: dict[tuple[int, int, int], int] = {}
    axons_per_core = np.zeros(len(cores), np.int64)
    parts: dict[str, list[npt.NDArray[Any]]] = {key: [] for key in ("source", "format", "length", "target", "weight")}
    lean = [Needs(network, target).lean(chunks) for chunks in cores]
    for chunk, core, base in placed:
        for lists in lists_into(network, chunk):
            projection = network.projections[lists.projection]
            dense, _ = choose_dense(lists, projection, base, chunk.size, lean=lean[core], target=target)
            length, targets, weights = _entries(network, chunk, lists, dense, base)
            sparse_bits = index_bits(base + chunk.size - 1, target)
            form = [
                formats.setdefault((projection.bits, projection.exponent, 0 if flag else sparse_bits), len(formats))
                for flag in dense
            ]
            source = lists.source
            if projection.pre != INPUT:
                source = network.input.size + compartment_id[projection.pre][source]
            axons_per_core[core] += len(source)
            found: list[npt.NDArray[Any]] = [source, np.array(form), length, targets, weights]
            for part, values in zip(parts.values(), found, strict=True):
                part.append(values)

    order = [chunk for chunk, _, _ in placed]
    populations = [network.populations[chunk.population] for chunk in order]
    neurons = [np.arange(chunk.first, chunk.last) for chunk in order]
    rows = list(zip(populations, neurons, strict=True))
    votes = [
        network.readout.label[n] if chunk.population == network.readout.population else np.full(chunk.size, -1)
        for chunk, n in zip(order, neurons, strict=True)
    ]
    columns = sorted(formats, key=lambda key: formats[key])
    return Netlist(
        target=target.name,
        taxels=network.input.taxels,
        polarities=network.input.polarities,
        classes=network.classes,
        layers=_layers(origin or network, unread or none_of(network)),
        core_tile=read_only(tiles),
        core_compartments=read_only(np.concatenate([[0], np.cumsum(counts)])),
        core_axons=read_only(np.concatenate([[0], np.cumsum(axons_per_core)])),
        layer=read_only(np.concatenate([np.full(chunk.size, chunk.population) for chunk in order])),
        neuron=read_only(np.concatenate([identity[c.population][n] for c, n in zip(order, neurons, strict=True)])),
        decay_u=read_only(np.concatenate([np.full(len(n), p.decay_u) for p, n in rows])),
        decay_v=read_only(np.concatenate([np.full(len(n), p.decay_v) for p, n in rows])),
        threshold=read_only(np.concatenate([p.threshold[n] for p, n in rows])),
        bias_mantissa=read_only(np.concatenate([p.bias_mantissa[n] for p, n in rows])),
        bias_exponent=read_only(np.concatenate([p.bias_exponent[n] for p, n in rows])),
        scale=read_only_float(np.concatenate([p.scale[n] for p, n in rows])),
        readout_class=read_only(np.concatenate(votes)),
        axon_source=read_only(np.concatenate(parts["source"])),
        axon_format=read_only(np.concatenate(parts["format"])),
        axon_synapses=read_only(np.concatenate([[0], np.cumsum(np.concatenate(parts["length"]))])),
        synapse_target=frozen(np.concatenate(parts.pop("target"))),
        synapse_weight=frozen(np.concatenate(parts.pop("weight"))),
        format_weight_bits=read_only([key[0] for key in columns]),
        format_exponent=read_only([key[1] for key in columns]),
        format_index_bits=read_only([key[2] for key in columns]),
        provenance=dict(provenance),
        clocks=network.input.clocks,
        bins=network.input.bins,
    )
