"""Another float network stored on the scales of a netlist: on a taxel graph that went wrong, or with outlier weights.

Compiling anew would choose other scales and cores; here nothing changes but what the other network changes. The result
is a netlist to simulate, not one to load: its cores may need more than there is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spikeloom.compiler import store_alike
from spikeloom.compiler.ir import Network, Projection
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.studies.stress.pair import Pair


def stored_alike(pair: Pair, network: Network, *, coarser: int = 1) -> Pair:
    """Another float network of the same sizes beside a netlist that stores it as :func:`store_alike` says."""
    return Pair(netlist=store_alike(pair.netlist, network, coarser=coarser), network=network)


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
