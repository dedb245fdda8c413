"""Put cores on tiles of the mesh so that spikes travel few hops.

Neither the network nor its cores are changed: position has no influence on any spike. The cores of a network
that is too large for one chip are shared among several, and those of each are placed by themselves; tiles
are numbered chip after chip. Links between chips have no public latency or energy on Loihi, so the only aim
is that few packets need one.

References
----------
.. [1] A. Balaji et al., "Mapping Spiking Neural Networks to Neuromorphic Hardware", IEEE TVLSI 28(1), 2020: spikes on
   the interconnect as the objective.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import INPUT
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout.core_needs import Cores, sources_of
from spikeloom.compiler.types import FloatArray, IntArray

STARTS = 16
"""Cores around which a layout is grown; the best of these layouts is taken."""

TIE = 1e-9
"""What a north-south hop costs beyond an east-west one: it decides between equal layouts only."""

Tiles = TypeVar("Tiles", int, IntArray)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Tiles of the cores."""

    tiles: tuple[int, ...]  # Tile of each core, row-major on the mesh
    spike_hops: float  # Spikes per step times hops that this placement costs
    between_chips: float = 0.0  # Packets per step that leave their chip


def core_traffic(network: IntegerNetwork, cores: Cores, rates: tuple[FloatArray, ...] | None) -> FloatArray:
    """Packets per step from each core to each core, one for each spike and axon that listens; shape (cores, cores).

    Without `rates` every neuron counts as one spike a step.
    """
    core_of = [np.zeros(population.size, np.int64) for population in network.populations]
    for core, chunks in enumerate(cores):
        for chunk in chunks:
            core_of[chunk.population][chunk.first : chunk.last] = core
    traffic = np.zeros((len(cores),) * 2)
    for core, chunks in enumerate(cores):
        for chunk in chunks:
            for projection in network.projections:
                pre = projection.pre
                if projection.post == chunk.population and pre != INPUT:
                    sources = sources_of(projection.weight, chunk)
                    rate = rates[pre][sources] if rates is not None else np.ones(len(sources))
                    np.add.at(traffic[:, core], core_of[pre][sources], rate)
    return traffic


def hops(tile: Tiles, other: Tiles, width: int) -> tuple[Tiles, Tiles]:
    """East-west and north-south hops between two tiles of a chip under XY routing.

    >>> hops(0, 17, 8)
    (1, 2)
    """
    return abs(tile % width - other % width), abs(tile // width - other // width)


def _grow(between: FloatArray, price: FloatArray, tile_cores: int, first: int) -> IntArray:
    """Place one core in the middle, then always the one that talks most to the placed ones, where it is cheapest."""
    site = np.full(len(between), -1)
    load = np.zeros(len(price), np.int64)
    middle = int(np.argmin(price.sum(axis=1)))
    core = first
    where = middle
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


def place(traffic: FloatArray, target: Target) -> Placement:
    """Choose tiles of few spikes times hops; among equal ones those with more of the cheaper east-west hops.

    A layout is grown around each of the busiest cores and improved change by change, and the best of these
    is taken: the optimum, by branch and bound, on every network tried that has up to ten cores. `traffic` is
    packets per step, (cores, cores).
    """
    width = target.limit("mesh.width")
    height = target.limit("mesh.height")
    cores = len(traffic)
    tile_cores = target.limit("mesh.tile_cores")
    if cores == 1:
        return Placement(tiles=(0,), spike_hops=0.0)
    between = traffic + traffic.T
    np.fill_diagonal(between, 0)
    y, x = np.divmod(np.arange(width * height), width)
    price = np.abs(x[:, None] - x) + (1 + TIE) * np.abs(y[:, None] - y)  # of a packet between each two sites
    heaviest = np.argsort(-between.sum(axis=1), kind="stable")[:STARTS]
    grown = [
        _improve(between, price, tile_cores, _grow(between, price, tile_cores, int(core)))
        for core in heaviest
    ]
    site = min(grown, key=lambda layout: float((between * price[np.ix_(layout, layout)]).sum()))
    tiles = tuple(site.tolist())
    spent = sum(between[a, b] * sum(hops(tiles[a], tiles[b], width)) for a in range(cores) for b in range(a))
    return Placement(tiles=tiles, spike_hops=float(spent))


def chip_tiles(target: Target) -> int:
    """Tiles of one chip."""
    return target.limit("mesh.width") * target.limit("mesh.height")


def chip_of_core(core_tile: IntArray, target: Target) -> IntArray:
    """Chip of each core, from its tile; shape (cores,)."""
    return core_tile // chip_tiles(target)


def chip_count(core_tile: IntArray, target: Target) -> int:
    """Number of chips in use."""
    return len(np.unique(chip_of_core(core_tile, target)))


def require_one_chip(core_tile: IntArray, target: Target, what: str) -> None:
    """Refuse `what` for a netlist on several chips with an OptionError."""
    if (chips := chip_count(core_tile, target)) > 1:
        raise OptionError(
            f"{what}: the netlist takes {chips} chips, and links between chips are not modelled; "
            "use estimate --detail counts, or a network that one chip holds"
        )


def share(traffic: FloatArray, room: int) -> IntArray:
    """Chip of each core, on as few chips as hold them.

    A chip, of `room` cores, is grown from the lowest core that has none by the one that talks most to it,
    until it is full.
    """
    between = traffic + traffic.T
    cores = len(between)
    chip = np.full(cores, -1)
    for number in range(-(-cores // room)):
        drawn = np.zeros(cores)
        for _ in range(min(room, int((chip < 0).sum()))):
            core = int(np.argmax(np.where(chip < 0, drawn, -1.0)))
            chip[core] = number
            drawn += between[core]
    return chip


def place_on_chips(traffic: FloatArray, target: Target) -> Placement:
    """Share cores among as few chips as hold them and place the cores of each, by packets per step (cores, cores).

    Spike-hops are those within chips.
    """
    chip = share(traffic, target.limit("chip.cores"))
    tiles = np.zeros(len(chip), np.int64)
    placed = []
    for number in range(int(chip.max()) + 1):
        members = np.flatnonzero(chip == number)
        placed.append(place(traffic[np.ix_(members, members)], target))
        tiles[members] = number * chip_tiles(target) + np.array(placed[-1].tiles)
    return Placement(
        tiles=tuple(tiles.tolist()),
        spike_hops=sum(placement.spike_hops for placement in placed),
        between_chips=float(traffic[chip[:, None] != chip].sum()),
    )
