"""Lay a network out on few cores, within every limit.

The integer network is not changed: which neuron sits where has no influence on any spike. A layer on more
cores is swept and fed in parallel, but each of its spikes, and each spike that it receives, is sent to more
of them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.loihi1.layout.core_needs import Cores
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.layout.place import Placement, core_traffic, place_on_chips
from spikeloom.compiler.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Which neuron sits on which core, and which core on which tile."""

    cores: Cores
    placement: Placement


def faults(layout: Layout, network: IntegerNetwork, target: Target) -> Iterator[str]:
    """Rules that the layout of a network breaks: every neuron sits on one core, every core on a tile with room."""
    for post, population in enumerate(network.populations):
        chunks = sorted(chunk for core in layout.cores for chunk in core if chunk.population == post)
        begins = [0, *(chunk.last for chunk in chunks)]
        ends = [*(chunk.first for chunk in chunks), population.size]
        if begins != ends or any(chunk.size < 1 for chunk in chunks):
            yield f"the cores do not divide the {population.size} neurons of {population.name} among them"
    tiles = np.array(layout.placement.tiles, np.int64)
    if len(tiles) != len(layout.cores):
        yield f"{len(layout.cores)} cores are on {len(tiles)} tiles"
    if np.any(tiles < 0) or np.any(np.bincount(np.maximum(tiles, 0)) > target.limit("mesh.tile_cores")):
        yield f"a tile holds more than {target.limit('mesh.tile_cores')} cores, or is none"


def least_cores(
    network: IntegerNetwork, cores_for: Mapping[str, int], target: Target, chips: int = 1
) -> dict[int, int]:
    """Least number of cores by population, from names; OptionError if there is no such layer or not so many cores."""
    names = [population.name for population in network.populations]
    allowed = chips * target.limit("chip.cores")
    owner = f"{target.title} has" if chips == 1 else f"{chips} chips {target.title} have"
    for name, least in cores_for.items():
        option = f"--cores-for {name}={least}"
        if name not in names:
            raise OptionError(f"{option}: no such layer; layers are {', '.join(names)}")
        size = network.populations[names.index(name)].size
        if least > allowed:
            raise OptionError(
                f"{option}: {owner} {allowed} cores ({target.name}.chip.cores); give {allowed} or fewer"
            )
        if least > size:
            raise OptionError(f"{option}: {name} has {size} neurons on the chip; give {size} or fewer")
    return {names.index(name): least for name, least in cores_for.items()}


def lay_out(
    network: IntegerNetwork,
    target: Target,
    *,
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    rates: tuple[FloatArray, ...] | None = None,
) -> Layout:
    """Lay a network out on the fewest cores.

    Layers in `cores_for` get so many cores at least, which hold no other layer. `rates` are spikes per step
    (neurons,) of each population. CapacityError if a limit cannot be kept, OptionError if there are not so
    many cores.
    """
    least = least_cores(network, cores_for or {}, target, chips)
    cores = partition(network, target, rates, cores_for=least, chips=chips)
    return Layout(cores=cores, placement=place_on_chips(core_traffic(network, cores, rates), target))
