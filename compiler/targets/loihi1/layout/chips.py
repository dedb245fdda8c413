"""Share the cores of a network that is too large for one chip among several, and place each chip's by itself.

Neither the network nor the partition is changed: position has no influence on any spike. Tiles are numbered chip after
chip. Links between chips have no public latency or energy on Loihi, so the only aim is that few packets need one.
"""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import Placement, place
from spikeloom.compiler.types import FloatArray, IntArray


def chip_tiles(target: Target) -> int:
    """Tiles of one chip."""
    return target.limit("mesh.width") * target.limit("mesh.height")


def chip_of_core(core_tile: IntArray, target: Target) -> IntArray:
    """Chip of each core, from its tile; shape (cores,).

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import load_target
    >>> chip_of_core(np.array([0, 31, 32, 70]), load_target("loihi1")).tolist()
    [0, 0, 1, 2]
    """
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

    A chip, of `room` cores, is grown from the lowest core that has none by the one that talks most to it, until it is
    full.
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
    room = target.limit("chip.cores")
    if len(traffic) <= room:
        return place(traffic, target)
    chip = share(traffic, room)
    tiles = np.zeros(len(chip), np.int64)
    placed = []
    for number in range(int(chip.max()) + 1):
        own = np.flatnonzero(chip == number)
        placed.append(place(traffic[np.ix_(own, own)], target))
        tiles[own] = number * chip_tiles(target) + np.array(placed[-1].tiles)
    return Placement(
        tiles=tuple(tiles.tolist()),
        spike_hops=sum(placement.spike_hops for placement in placed),
        between_chips=float(traffic[chip[:, None] != chip].sum()),
    )
