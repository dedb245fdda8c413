"""Another float network stored on the scales of a netlist: on a taxel graph that went wrong, or with outlier weights.

Compiling anew would choose other scales and cores; here nothing changes but what the other network changes. The result
is a netlist to simulate, not one to load: it is not cut to the size of cores.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import (
    ONE_STEP_SUM_MAX,
    IntArray,
    frozen,
    read_only,
    read_only_float,
    round_half_even,
)
from spikeloom.compiler.ir import (
    INPUT,
    Form,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Projection,
)
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.storage.weight_storage import loads, round_population
from spikeloom.runtime.studies.stress.damages import Pair


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
            raise OptionError(f"{population.name}: {error}; leave this perturbation away") from error
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
    """A netlist to simulate, not to load: each population on a core of its own, whatever a core holds.

    Parameters
    ----------
    network : IntegerNetwork
        Integer stage.
    like : Netlist
        Whose layers, depths and provenance it takes.
    """
    sizes = [population.size for population in network.populations]
    first = np.cumsum([0, *sizes])
    axons: list[tuple[IntArray, IntArray, int]] = []
    parts: dict[str, list[npt.NDArray[Any]]] = {"target": [], "weight": []}
    forms: dict[tuple[int, int], int] = {}
    per_core = np.zeros(len(sizes), np.int64)
    for projection in sorted(network.projections, key=lambda p: p.post):
        columns = sparse.csc_array(projection.weight)
        length = np.diff(columns.indptr)
        source = np.flatnonzero(length)
        per_core[projection.post] += len(source)
        form = forms.setdefault((projection.bits, projection.exponent), len(forms))
        base = 0 if projection.pre == INPUT else network.input.size + first[projection.pre]
        axons.append((source + base, length[source], form))
        parts["target"].append(columns.indices.astype(np.int32))
        parts["weight"].append(columns.data.astype(np.int16))
    populations = network.populations
    votes = np.full(first[-1], -1)
    votes[first[network.readout.population] :][: len(network.readout.label)] = network.readout.label
    lengths = np.concatenate([length for _, length, _ in axons])
    return replace(
        like,
        layers=tuple(replace(layer, unheard=()) for layer in like.layers),
        core_tile=read_only(range(len(sizes))),
        core_compartments=read_only(first),
        core_axons=read_only(np.append(0, np.cumsum(per_core))),
        layer=read_only(np.repeat(np.arange(len(sizes)), sizes)),
        neuron=read_only(np.concatenate([np.arange(size) for size in sizes])),
        decay_u=read_only(np.repeat([population.decay_u for population in populations], sizes)),
        decay_v=read_only(np.repeat([population.decay_v for population in populations], sizes)),
        threshold=read_only(np.concatenate([population.threshold for population in populations])),
        bias_mantissa=read_only(np.concatenate([population.bias_mantissa for population in populations])),
        bias_exponent=read_only(np.concatenate([population.bias_exponent for population in populations])),
        scale=read_only_float(np.concatenate([population.scale for population in populations])),
        readout_class=read_only(votes),
        axon_source=read_only(np.concatenate([source for source, _, _ in axons])),
        axon_format=read_only(np.concatenate([np.full(len(source), form) for source, _, form in axons])),
        axon_synapses=read_only(np.append(0, np.cumsum(lengths))),
        synapse_target=frozen(np.concatenate(parts["target"])),
        synapse_weight=frozen(np.concatenate(parts["weight"])),
        format_weight_bits=read_only([bits for bits, _ in forms]),
        format_exponent=read_only([exponent for _, exponent in forms]),
        format_index_bits=read_only([1] * len(forms)),
    )


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
