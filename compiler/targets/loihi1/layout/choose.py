"""Choose how many cores each layer gets, by what the layout is for: few cores, little energy or short steps.

The integer network is not changed: which neuron sits where has no influence on any spike.

A layer on more cores is swept and fed in parallel, but each of its spikes, and each spike that it receives, is sent to
more of them. Layouts are judged by :mod:`layout.forecast`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.errors import CapacityError, OptionError
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.passes.calibrate import Calibration
from spikeloom.compiler.targets.base import PICOSECONDS, Target
from spikeloom.compiler.targets.loihi1.layout.chips import place_on_chips
from spikeloom.compiler.targets.loihi1.layout.core_needs import Chunk, Needs
from spikeloom.compiler.targets.loihi1.layout.forecast import Expectation, Forecast, sample, tables
from spikeloom.compiler.targets.loihi1.layout.latency_search import estimate, fastest, tiles_for
from spikeloom.compiler.targets.loihi1.layout.partition import Partition, arrange, chunks_of, cut, partition
from spikeloom.compiler.targets.loihi1.layout.place import Placement, core_traffic, place_within
from spikeloom.compiler.types import FloatArray, IntArray

WORTH = 1e-3
"""Share of a step's energy that another layout has to save."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A placed partition."""

    parts: Partition  # Chunks of each core
    placement: Placement  # Tiles
    expected: Expectation | None  # Time and energy of a step, where these can be foretold


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

    Raises
    ------
    CapacityError
        If a limit cannot be kept.
    OptionError
        If the goal cannot be judged, or there are not so many cores.
    """
    least = least_cores(network, cores_for or {}, target, chips)
    priced = tables(target)
    forecast = None
    if calibration is not None and priced is not None:
        all_neurons = tuple(np.arange(population.size) for population in network.populations)
        activity = sample(network, calibration, identity or all_neurons)
        forecast = Forecast(Needs(network, target), activity, *priced)

    def placed(parts: Partition, tiles: int | None = None) -> Layout:
        traffic = core_traffic(network, parts, rates)
        placement = place_on_chips(traffic, target) if tiles is None else place_within(traffic, target, tiles)
        expected = None
        if forecast is not None and len(parts.cores) <= target.limit("chip.cores"):
            expected = forecast.expect(parts, placement.tiles, core_traffic(network, parts, forecast.rates))
        return Layout(parts=parts, placement=placement, expected=expected)

    usual = placed(partition(network, target, rates, chips=chips))
    if least:
        return placed(partition(network, target, rates, cores_for=least, chips=chips)), usual
    if goal == "cores":
        return usual, usual
    if forecast is None:
        raise OptionError(f"--optimize {goal}: {target.title} has no time or no energy table; give another target")
    if goal == "energy":
        found = map(placed, _thrifty(forecast, rates))
        thrifty = min(found, key=lambda layout: _expected(layout).step_j, default=usual)
        saves = _expected(thrifty).step_j < _expected(usual).step_j * (1 - WORTH)
        return (thrifty if saves else usual), usual
    cores = fastest(forecast)
    if cores is None or estimate(forecast, cores) >= _expected(usual).step_ns * PICOSECONDS:
        return usual, usual
    fast = placed(arrange(forecast.needs, cores), tiles_for(forecast, len(cores)))
    return min([usual, fast], key=lambda layout: _expected(layout).step_ns), usual


def _expected(layout: Layout) -> Expectation:
    assert layout.expected is not None
    return layout.expected


def _thrifty(forecast: Forecast, rates: tuple[FloatArray, ...] | None) -> list[Partition]:
    """Partitions of little energy: each layer cut where its synapses and the packets to it cost least by themselves.

    The stored zeros of dense lists that are visited become fewer with more cores, the packets more.
    """
    needs = forecast.needs
    fewest = chunks_of(cut(needs, {}))
    spread: dict[int, int] = {}
    for population, count in fewest.items():
        costs = {}
        for more in range(count, min(2 * count + 2, needs.network.populations[population].size) + 1):
            with suppress(CapacityError, OptionError):  # too many for the sources, or too few
                chunks = [chunk for chunk in cut(needs, {population: more}) if chunk.population == population]
                costs[len(chunks)] = sum(_cost(forecast, chunk) for chunk in chunks)
        best = min(costs, key=lambda parts: (costs[parts], parts), default=count)
        if best > count:
            spread[population] = best
    found = []
    for least in [spread, fewest, *({population: parts} for population, parts in spread.items() if len(spread) > 1)]:
        with suppress(CapacityError, OptionError):  # the layers before may have to be cut more often for it
            found.append(partition(needs.network, needs.target, rates, cores_for=least, shared=True))
    return found


def _cost(forecast: Forecast, chunk: Chunk) -> float:
    """Joules of a step that the synapses of a chunk on a core of its own and the packets to it cost."""
    _, spent = forecast.listening(chunk, 0, lean=forecast.needs.lean((chunk,)))
    packets = sum(float(forecast.rates[pre] @ axons) for pre, axons in forecast.needs.source_axons([chunk]).items())
    return spent + forecast.joule("packet") * packets
