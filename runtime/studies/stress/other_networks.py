"""Another float network stored on the scales of a netlist: on a taxel graph that went wrong, or with outlier weights.

Compiling anew would choose other scales and cores; here nothing changes but what the other network changes. The result
is a netlist to simulate, not one to load: its cores may need more than there is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spikeloom.compiler import Netlist
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import ONE_STEP_SUM_MAX, IntArray, round_half_even
from spikeloom.compiler.ir import (
    Form,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Projection,
)
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.emit import emit
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk
from spikeloom.compiler.targets.loihi1.layout.partition import Partition
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, round_population
from spikeloom.runtime.studies.stress.pair import Pair


def stored_alike(pair: Pair, network: Network, *, coarser: int = 1) -> Pair:
    """Another float network of the same sizes, stored as the netlist stores its own.

    Widths, exponents and thresholds are the netlist's, weights are rounded to the nearest; a neuron that the netlist
    does not hold gets its layer's median threshold. With `coarser` scales, and thresholds with them, are so many times
    smaller; so they are where a register could overflow otherwise.

    Raises
    ------
    OptionError
        If a bias has no register value at this scale.
    """
    netlist = pair.netlist
    filled = np.flatnonzero(np.diff(netlist.axon_synapses))
    listener = netlist.layer[netlist.synapse_compartment()[netlist.axon_synapses[filled]]]
    exponents = netlist.format_exponent[netlist.axon_format[filled]]
    populations, projections = list[IntegerPopulation](), list[IntegerProjection]()
    for post, (population, layer) in enumerate(zip(network.populations, netlist.layers, strict=True)):
        ids = netlist.compartments_of(post)
        threshold = np.full(layer.neurons, round(float(np.median(netlist.threshold[ids]))))
        threshold[netlist.neuron[ids]] = netlist.threshold[ids]
        threshold = np.maximum(round_half_even(threshold / coarser), 1)
        used = tuple(sorted(set(exponents[listener == post].tolist()))) or (0,)
        form = Form(bits=layer.weight_bits, exponents=used, threshold=threshold)
        into = tuple(projection for projection in network.projections if projection.post == post)
        try:
            integer, planes = _fitted(population, into, form)
        except ValueError as error:
            raise OptionError(f"{population.name}: {error}; omit this perturbation") from error
        populations.append(integer)
        projections += planes
    whole = IntegerNetwork(
        input=network.input,
        populations=tuple(populations),
        projections=tuple(projections),
        readout=network.readout,
        classes=network.classes,
    )
    return Pair(netlist=unplaced(whole, netlist), network=network)


def _fitted(
    population: Population, into: tuple[Projection, ...], form: Form
) -> tuple[IntegerPopulation, tuple[IntegerProjection, ...]]:
    """Round to a form, with thresholds so much smaller that no register can overflow where one could."""
    while True:
        integer, planes = round_population(population, into, form)
        fullest = float(loads(integer, planes).max(initial=0))
        smaller = np.maximum(np.floor(form.threshold * (ONE_STEP_SUM_MAX / max(fullest, 1.0))), 1).astype(np.int64)
        if fullest <= ONE_STEP_SUM_MAX or np.array_equal(smaller, form.threshold):
            return integer, planes
        form = replace(form, threshold=smaller)


def unplaced(network: IntegerNetwork, like: Netlist) -> Netlist:
    """A netlist to simulate, not to load: cores hold as many compartments as they can, whatever these need."""
    target = load_target(like.target)
    most = target.limit("core.compartments")
    cores = tuple(
        (Chunk(population=post, first=first, last=min(first + most, population.size)),)
        for post, population in enumerate(network.populations)
        for first in range(0, population.size, most)
    )
    partition = Partition(cores=cores, bound=len(cores))
    return emit(network, partition, tuple(range(len(cores))), target, like.provenance)


def add_outliers(pair: Pair, factor: int, rng: np.random.Generator) -> Pair:
    """In each layer one weight grows to a multiple of the largest and takes the scale with it.

    The float network has that one weight more; on the chip all others are stored on a grid that is as much coarser.
    """
    projections = list[Projection]()
    for projection in pair.network.projections:
        weight = projection.weight.copy()
        if weight.nnz:
            place = int(rng.integers(weight.nnz))
            weight.data[place] = np.copysign(factor * np.abs(weight.data).max(), weight.data[place])
        projections.append(replace(projection, weight=weight))
    return stored_alike(pair, replace(pair.network, projections=tuple(projections)), coarser=factor)


# -- taxel graphs ------------------------------------------------------------------------------------------------------


def _links(edges: IntArray) -> tuple[IntArray, bool]:
    """Edges to choose from: pairs where each edge has its way back, else single ones; repeats once, no loops."""
    single = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0)
    both = len(np.unique(np.concatenate([single, single[:, ::-1]]), axis=0)) == len(single)
    return (single[single[:, 0] < single[:, 1]], True) if both else (single, False)


def _there_and_back(links: IntArray, both: bool) -> IntArray:
    return np.concatenate([links, links[:, ::-1]]) if both else links


def rewire(edges: IntArray, taxels: int, share: float, rng: np.random.Generator) -> IntArray:
    """Replace a share of the edges by others that the graph does not have; (edges, 2) int64."""
    links, both = _links(edges)
    known = set(map(tuple, links.tolist()))
    free = [
        (a, b) for a in range(taxels) for b in range(a + 1 if both else 0, taxels) if a != b and (a, b) not in known
    ]
    count = min(round(share * len(links)), len(free))
    kept = links[np.sort(rng.permutation(len(links))[count:])]
    others = np.array(free, np.int64).reshape(-1, 2)[rng.permutation(len(free))[:count]]
    return _there_and_back(np.concatenate([kept, others]), both)


def double(edges: IntArray, share: float, rng: np.random.Generator) -> IntArray:
    """List a share of the edges twice, as the released kNN graphs do; (edges, 2) int64."""
    links, both = _links(edges)
    again = links[rng.permutation(len(links))[: round(share * len(links))]]
    return np.concatenate([edges, _there_and_back(again, both)])
