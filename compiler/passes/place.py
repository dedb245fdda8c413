"""Put cores on tiles of the mesh so that spikes travel few hops.

Neither the network nor the partition is changed: position has no influence on any spike.

References
----------
.. [1] A. Balaji et al., "Mapping Spiking Neural Networks to Neuromorphic Hardware", IEEE TVLSI 28(1), 2020: spikes on
   the interconnect as the objective. At this size it is solved exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compiler.fixedpoint import FloatArray
from compiler.ir import INPUT, IntegerNetwork
from compiler.passes.partition import Partition, lists_into
from compiler.targets import Target

EXACT_STEPS = 200_000
"""Search steps after which the best placement found so far is taken, and said not to be proven optimal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Tiles of the cores.

    Parameters
    ----------
    tiles : tuple of int
        Tile of each core, row-major on the mesh.
    spike_hops : float
        Spikes per step times hops that this placement costs.
    bound : float
        No placement costs less.
    """

    tiles: tuple[int, ...]
    spike_hops: float
    bound: float


def core_traffic(network: IntegerNetwork, partition: Partition, rates: tuple[FloatArray, ...] | None) -> FloatArray:
    """Packets per step from each core to each core; shape (cores, cores).

    A spike costs one packet per input axon that listens to it. Without `rates` every neuron counts as one spike a
    step.
    """
    core_of = [np.zeros(population.size, np.int64) for population in network.populations]
    for core, chunks in enumerate(partition.cores):
        for chunk in chunks:
            core_of[chunk.population][chunk.first : chunk.last] = core
    traffic = np.zeros((len(partition.cores),) * 2)
    for core, chunks in enumerate(partition.cores):
        for chunk in chunks:
            for lists in lists_into(network, chunk):
                pre = network.projections[lists.projection].pre
                if pre != INPUT:
                    rate = rates[pre][lists.source] if rates is not None else np.ones(len(lists.source))
                    np.add.at(traffic[:, core], core_of[pre][lists.source], rate)
    return traffic


def hops(tile: int, other: int, width: int) -> tuple[int, int]:
    """East-west and north-south hops between two tiles under XY routing.

    Examples
    --------
    >>> hops(0, 17, 8)
    (1, 2)
    """
    return abs(tile % width - other % width), abs(tile // width - other // width)


def _lower_bound(between: FloatArray, tile_cores: int) -> float:
    """Every core shares a tile with its heaviest partners at best; the rest of its traffic makes one hop at least."""
    rest = np.sort(between, axis=1)[:, : max(len(between) - (tile_cores - 1), 0)]
    return float(rest.sum() / 2)


def place(traffic: FloatArray, target: Target) -> Placement:
    """Choose tiles by branch and bound; hops count alike, ties prefer the cheaper east-west ones.

    Parameters
    ----------
    traffic : (cores, cores) float64
        Packets per step.
    target : Target
        Mesh size and cores per tile.
    """
    width, height = target.limit("mesh.width"), target.limit("mesh.height")
    tile_cores = target.limit("mesh.tile_cores")
    between = traffic + traffic.T
    np.fill_diagonal(between, 0)
    cores = len(between)
    # An optimal layout of t tiles fits in a t x t corner: empty rows and columns only add hops. Half-filled tiles
    # are allowed, so t is the number of cores, cut by the mesh.
    columns, rows = min(width, cores), min(height, cores)
    sites = [y * width + x for y in range(rows) for x in range(columns)]
    price = np.array([[10_000 * sum(hops(a, b, width)) + hops(a, b, width)[1] for b in sites] for a in sites], float)
    order = sorted(range(cores), key=lambda core: (-between[core].sum(), core))
    best_cost, best_sites = np.inf, [0] * cores
    chosen = [0] * cores
    load = [0] * len(sites)
    steps = 0

    def search(depth: int, cost: float) -> None:
        nonlocal best_cost, best_sites, steps
        if cost >= best_cost:
            return
        if depth == cores:
            best_cost, best_sites = cost, list(chosen)
            return
        steps += 1
        if steps > EXACT_STEPS:
            return
        core = order[depth]
        earlier = order[:depth]
        added = price[:, [chosen[other] for other in earlier]] @ between[core, earlier]
        for site in np.argsort(added, kind="stable"):
            if load[site] < tile_cores:
                load[site] += 1
                chosen[core] = int(site)
                search(depth + 1, cost + float(added[site]))
                load[site] -= 1

    search(0, 0.0)
    tiles = tuple(sites[site] for site in best_sites)
    spent = sum(between[a, b] * sum(hops(tiles[a], tiles[b], width)) for a in range(cores) for b in range(a))
    exact = steps <= EXACT_STEPS
    return Placement(
        tiles=tiles,
        spike_hops=float(spent),
        bound=float(spent) if exact else min(float(spent), _lower_bound(between, tile_cores)),
    )
