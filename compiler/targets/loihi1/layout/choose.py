"""Choose how many cores each layer gets, by what the layout is for: few cores or short steps.

The integer network is not changed: which neuron sits where has no influence on any spike.

A layer on more cores is swept and fed in parallel, but each of its spikes, and each spike that it receives, is sent to
more of them. Layouts are judged by :mod:`layout.forecast`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.targets.base import PICOSECONDS, Target
from spikeloom.compiler.targets.loihi1.layout.core_needs import Cores, Needs
from spikeloom.compiler.targets.loihi1.layout.forecast import Expectation, Forecast, fastest, sample
from spikeloom.compiler.targets.loihi1.layout.partition import arrange, partition
from spikeloom.compiler.targets.loihi1.layout.place import Placement, core_traffic, place_on_chips
from spikeloom.compiler.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Which neuron sits on which core, and which core on which tile."""

    cores: Cores
    placement: Placement
    expected: Expectation | None  # Time of a step, where it can be foretold


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
    goal: str = "cores",
    cores_for: Mapping[str, int] | None = None,
    chips: int = 1,
    rates: tuple[FloatArray, ...] | None = None,
    calibration: Calibration | None = None,
    identity: tuple[IntArray, ...] | None = None,
) -> tuple[Layout, Layout]:
    """Choose a layout for a goal, one of ``options.GOALS``, and that of fewest cores; often they are one.

    Layers in `cores_for` get so many cores at least, which hold no other layer. `rates` are spikes per step (neurons,)
    of each population; `identity` says which neurons of the calibration the network holds, all by default.
    CapacityError if a limit cannot be kept, OptionError if the goal cannot be judged or there are not so many cores.
    """
    least = least_cores(network, cores_for or {}, target, chips)
    forecast = None
    if calibration is not None and target.time:
        all_neurons = tuple(np.arange(population.size) for population in network.populations)
        activity = sample(network, calibration, identity or all_neurons)
        forecast = Forecast(Needs(network, target), activity, target.time[0])

    def placed(cores: Cores) -> Layout:
        placement = place_on_chips(core_traffic(network, cores, rates), target)
        expected = None
        if forecast is not None and len(cores) <= target.limit("chip.cores"):
            expected = forecast.expect(cores, len(set(placement.tiles)))
        return Layout(cores=cores, placement=placement, expected=expected)

    usual = placed(partition(network, target, rates, chips=chips))
    if least:
        return placed(partition(network, target, rates, cores_for=least, chips=chips)), usual
    if goal == "cores":
        return usual, usual
    if forecast is None:
        raise OptionError(f"--optimize {goal}: {target.title} has no time table; give another target")
    assert usual.expected is not None, "a forecast tells it on one chip"
    trial = fastest(forecast)
    if trial is None or trial.step >= usual.expected.step_ns * PICOSECONDS:
        return usual, usual
    fast = placed(arrange(forecast.needs, [(chunk,) for chunk in trial.chunks]))
    assert fast.expected is not None, "likewise"
    return (fast if fast.expected.step_ns < usual.expected.step_ns else usual), usual
