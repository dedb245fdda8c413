"""Lay a network out on as few cores as every limit allows.

The integer network is not changed: which neuron sits where has no influence on any spike. A layer on more cores is
swept and fed in parallel, but each of its spikes, and each spike that it receives, is sent to more of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

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
            raise OptionError(f"{option}: {owner} {allowed} cores ({target.name}.chip.cores); give {allowed} or fewer")
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

    Layers in `cores_for` get so many cores at least, which hold no other layer. `rates` are spikes per step (neurons,)
    of each population. CapacityError if a limit cannot be kept, OptionError if there are not so many cores.
    """
    least = least_cores(network, cores_for or {}, target, chips)
    cores = partition(network, target, rates, cores_for=least or None, chips=chips)
    return Layout(cores=cores, placement=place_on_chips(core_traffic(network, cores, rates), target))
