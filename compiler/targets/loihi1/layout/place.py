"""Put cores on tiles of the mesh so that spikes travel few hops.

Neither the network nor the partition is changed: position has no influence on any spike.

References
----------
.. [1] A. Balaji et al., "Mapping Spiking Neural Networks to Neuromorphic Hardware", IEEE TVLSI 28(1), 2020: spikes on
   the interconnect as the objective. At this size it is solved exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from spikeloom.compiler.ir import INPUT, IntegerNetwork
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import lists_into
from spikeloom.compiler.targets.loihi1.layout.partition import Partition
from spikeloom.compiler.types import FloatArray, IntArray

EXACT_STEPS = 30_000
"""Search steps (some 40 microseconds each) after which the best placement found so far is taken, and said not to be
proven optimal."""

STARTS = 16
"""Cores around which a layout is grown; the best of these layouts is where the search starts."""

TIE = 1e-9
"""What a north-south hop costs beyond an east-west one in the search: it decides between equal layouts only."""

Tiles = TypeVar("Tiles", int, IntArray)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Tiles of the cores."""

    tiles: tuple[int, ...]  # Tile of each core, row-major on the mesh
    spike_hops: float  # Spikes per step times hops that this placement costs
    bound: float  # No placement costs less (by more than a billionth); equal to `spike_hops` if that is proven optimal
    between_chips: float = 0.0  # Packets per step that leave their chip


def core_traffic(network: IntegerNetwork, partition: Partition, rates: tuple[FloatArray, ...] | None) -> FloatArray:
    """Packets per step from each core to each core, one for each spike and axon that listens; shape (cores, cores).

    Without `rates` every neuron counts as one spike a step.
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


def hops(tile: Tiles, other: Tiles, width: int) -> tuple[Tiles, Tiles]:
    """East-west and north-south hops between two tiles of a chip under XY routing.

    Examples
    --------
    >>> hops(0, 17, 8)
    (1, 2)
    """
    return abs(tile % width - other % width), abs(tile // width - other // width)


def _prices(x: IntArray, y: IntArray) -> FloatArray:
    """Price of a packet between each two sites; shape (sites, sites)."""
    prices: FloatArray = np.abs(x[:, None] - x) + (1 + TIE) * np.abs(y[:, None] - y)
    return prices


def _cost(between: FloatArray, price: FloatArray, site: IntArray) -> float:
    return float((between * price[np.ix_(site, site)]).sum() / 2)


def _lower_bound(between: FloatArray, price: FloatArray, tile_cores: int) -> float:
    """Spike hops if every core had its heaviest partners nearest, as if all the others were placed for its sake."""
    nearest = np.repeat(np.sort(np.floor(price), axis=1), tile_cores, axis=1).min(axis=0)[1 : len(between)]
    partners = np.sort(between, axis=1)[:, :0:-1]
    return float((partners * nearest).sum() / 2)


def _grow(between: FloatArray, price: FloatArray, tile_cores: int, first: int) -> IntArray:
    """Place one core in the middle, then always the one that talks most to the placed ones, where it is cheapest."""
    site = np.full(len(between), -1)
    load = np.zeros(len(price), np.int64)
    middle = int(np.argmin(price.sum(axis=1)))
    core, where = first, middle
    while True:
        site[core] = where
        load[where] += 1
        placed = site >= 0
        if placed.all():
            return site
        core = int(np.argmax(np.where(placed, -1.0, between[:, placed].sum(axis=1))))
        added = between[core, placed] @ price[site[placed]] + TIE * price[middle]
        where = int(np.argmin(np.where(load < tile_cores, added, np.inf)))


def _improve(between: FloatArray, price: FloatArray, tile_cores: int, site: IntArray) -> IntArray:
    """Move one core or swap two, always the change that saves most, until none saves."""
    site = site.copy()
    while True:
        at = between @ price[site]  # cost of each core at each site, were it the only one to leave
        here = at[np.arange(len(site)), site]
        move = at - here[:, None]
        move[:, np.bincount(site, minlength=len(price)) >= tile_cores] = np.inf
        there = at[:, site]
        # two cores that swap stay as far apart as they were
        swap = there + there.T - here[:, None] - here + 2 * between * price[np.ix_(site, site)]
        if min(move.min(), swap.min()) >= -1e-12 * here.sum():
            return site
        if move.min() <= swap.min():
            core, to = np.unravel_index(np.argmin(move), move.shape)
            site[core] = to
        else:
            pair = list(np.unravel_index(np.argmin(swap), swap.shape))
            site[pair] = site[pair[::-1]]


def _search(
    between: FloatArray, width: int, height: int, tile_cores: int, known: float
) -> tuple[tuple[IntArray, IntArray] | None, float, bool]:
    """Branch and bound over the layouts that cost less than `known`, heaviest core first.

    Sites are counted from the first core, so layouts that differ by a shift or a reflection are visited once. An
    optimal layout of n cores spans n columns and rows at most, for an empty one only adds hops. A branch ends when
    there is no room left for the cheapest site of every core to come plus the optimum of the cores to come among
    themselves; that one was found before by the same search, which runs over ever longer tails of the cores.

    Given back are columns and rows of the best layout below `known`, if there is one; the optimum of the longest tail
    that was searched to its end, below which no layout costs; and whether all were searched.
    """
    cores = len(between)
    span_x, span_y = min(width, cores) - 1, min(height, cores) - 1
    y, x = np.mgrid[-span_y : span_y + 1, -span_x : span_x + 1].reshape(2, -1)
    price = _prices(x, y)
    origin = int(np.flatnonzero((x == 0) & (y == 0))[0])
    order = np.argsort(-between.sum(axis=1), kind="stable")
    between = between[np.ix_(order, order)]
    among = np.zeros(cores + 1)  # optimum of the tail that starts at each core
    chosen = np.zeros(cores, np.int64)
    load = np.zeros(len(x), np.int64)
    best, found, steps = 0.0, False, 0
    layout = chosen.copy()

    def visit(core: int, cost: float, added: FloatArray, box: tuple[int, int, int, int]) -> None:
        """Place `core` and those after it; `added` is what each of them costs at each site so far."""
        nonlocal best, found, steps
        if core == cores:
            best, found = cost, True
            layout[:] = chosen
            return
        steps += 1
        if steps > EXACT_STEPS:
            return
        left, right, low, high = box
        free = load < tile_cores
        # A layout fits the mesh, and while it is its own mirror image it grows to one side only.
        inside = free & (x >= (right - span_x if right > left else 0)) & (x <= left + span_x)
        inside &= (y >= (high - span_y if high > low else 0)) & (y <= low + span_y)
        rest = float(added[1:, free].min(axis=1).sum() + among[core + 1])
        sites = np.flatnonzero(inside)
        for site in sites[np.argsort(added[0, sites], kind="stable")]:
            now = cost + float(added[0, site])
            if (now + rest) * (1 + 1e-12) >= best:
                return
            load[site] += 1
            chosen[core] = site
            wider = (min(left, x[site]), max(right, x[site]), min(low, y[site]), max(high, y[site]))
            visit(core + 1, now, added[1:] + between[core, core + 1 :, None] * price[site], wider)
            load[site] -= 1

    for first in reversed(range(cores)):
        farthest = float(between[first, first + 1 :].sum()) * (width + height)
        best = known if first == 0 else (float(among[first + 1]) + farthest) * (1 + 1e-9) + 1e-300
        found = False
        load[:] = 0
        load[origin] = 1
        chosen[first] = origin
        visit(first + 1, 0.0, between[first, first + 1 :, None] * price[origin], (0, 0, 0, 0))
        if steps > EXACT_STEPS:
            break
        among[first] = best
    # only the whole network's layout counts, a tail's does not
    whole = found and first == 0
    place_of = np.empty(cores, np.int64)
    place_of[order] = layout
    column, row = x[place_of], y[place_of]
    return (column - column.min(), row - row.min()) if whole else None, float(among.max()), steps <= EXACT_STEPS


def place(traffic: FloatArray, target: Target) -> Placement:
    """Choose tiles of least spikes times hops; among equal ones those with more of the cheaper east-west hops.

    A layout is grown and improved change by change, then branch and bound looks for a better one. At the size of a
    tactile network (up to nine cores) that ends with a proof; at more it may stop after ``EXACT_STEPS``. `traffic` is
    packets per step, (cores, cores).
    """
    return _place(traffic, target.limit("mesh.width"), target.limit("mesh.height"), target.limit("mesh.tile_cores"))


def _place(traffic: FloatArray, width: int, height: int, tile_cores: int) -> Placement:
    between = traffic + traffic.T
    np.fill_diagonal(between, 0)
    cores = len(between)
    y, x = np.divmod(np.arange(width * height), width)
    price = _prices(x, y)
    heaviest = np.argsort(-between.sum(axis=1), kind="stable")[:STARTS]
    grown = [_improve(between, price, tile_cores, _grow(between, price, tile_cores, int(core))) for core in heaviest]
    site = min(grown, key=lambda layout: _cost(between, price, layout))
    layout, tail_bound, complete = _search(between, width, height, tile_cores, _cost(between, price, site))
    if layout is not None:
        site = layout[1] * width + layout[0]
    tiles = tuple(int(tile) for tile in site)
    spent = float(sum(between[a, b] * sum(hops(tiles[a], tiles[b], width)) for a in range(cores) for b in range(a)))
    weaker = max(tail_bound / (1 + TIE), _lower_bound(between, price, tile_cores))
    return Placement(tiles=tiles, spike_hops=spent, bound=spent if complete else min(spent, weaker))


def place_within(traffic: FloatArray, target: Target, tiles: int) -> Placement:
    """Choose tiles as :func:`place` does, but at most so many; of several that fit the best rectangle is taken."""
    free = place(traffic, target)
    if len(set(free.tiles)) <= tiles:
        return free
    width, height = target.limit("mesh.width"), target.limit("mesh.height")
    tile_cores = target.limit("mesh.tile_cores")
    found = []
    for columns in range(1, min(width, tiles) + 1):
        rows = min(height, tiles // columns)
        if columns * rows * tile_cores >= len(traffic):
            inside = _place(traffic, columns, rows, tile_cores)
            moved = tuple(tile // columns * width + tile % columns for tile in inside.tiles)
            found.append(replace(inside, tiles=moved))
    return min(found, key=lambda placement: placement.spike_hops, default=free)
