"""The battery of ``stress``: every perturbation by name, which of them apply, and at which levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TITLES
from spikeloom.models.graphs import build_graph
from spikeloom.runtime.studies.stress.damages import Pair
from spikeloom.runtime.studies.stress.network_troubles import NETWORK
from spikeloom.runtime.studies.stress.perturbation import Level, Sensor
from spikeloom.runtime.studies.stress.recording_troubles import RECORDINGS, STATE

SEEDS = 5
"""Draws of each random perturbation."""

BATTERY = (*RECORDINGS, *STATE, *NETWORK)

NAMES = {perturbation.name: perturbation for perturbation in BATTERY}

GRAPH_ONLY = ("other_graph", "edges_rewired", "edges_doubled")


def why_not(name: str, pair: Pair, sensor: Sensor) -> str | None:
    """Why a perturbation makes no sense for a network, or None where it does."""
    netlist = pair.netlist
    if name in GRAPH_ONLY:
        if sensor.checkpoint is None:
            return "a network from an ONNX or NIR file has no taxel graph that is known"
        if sensor.checkpoint.system not in GRAPH_SYSTEMS:
            return f"{TITLES[sensor.checkpoint.system]} has no taxel graph"
        if name == "other_graph" and sensor.places is None:
            return "positions of the taxels are not known, no graph can be built on them"
    if name == "fewer_bits":
        target = netlist.synapse_compartment()
        form = netlist.axon_format[netlist.axon_of_synapse()]
        kinds = {*zip(netlist.layer[target].tolist(), netlist.format_exponent[form].tolist(), strict=True)}
        if len(kinds) > len({layer for layer, _ in kinds}):
            return "weights are stored in several planes"
    if name == "polarity_swapped" and netlist.polarities != 2:
        return f"the sensor has {netlist.polarities} polarities"
    return None


def level_of(name: str, words: str) -> Level:
    """Read a level of a perturbation.

    Raises
    ------
    OptionError
        If it is none that makes sense.

    Examples
    --------
    >>> level_of("taxels_dead", "3"), level_of("other_graph", "knn:4")
    (3, 'knn:4')
    """
    known = NAMES[name]
    if isinstance(known.levels[0], str):
        return build_graph(words).name
    try:
        level = float(words)
    except ValueError:
        level = float("nan")
    if not known.least <= level <= known.most or (known.whole and level != int(level)):
        kind = "a whole number" if known.whole else "a number"
        limits = f"from {known.least:g}" + ("" if known.most == np.inf else f" to {known.most:g}")
        raise OptionError(f"{name}:{words}: {words!r} is no level of it; give {kind} {limits} ({known.unit})")
    return int(level) if level == int(level) else level


def levels_of(name: str, taxels: int, *, full: bool, also: Sequence[Level] = ()) -> tuple[Level, ...]:
    """Levels to measure on a sensor of so many taxels, from mild to harsh, others among them that were asked for.

    Examples
    --------
    >>> levels_of("taxels_dead", 6, full=False, also=[2])
    (1, 2, 3, 5)
    """
    known = NAMES[name]
    levels = known.full if full else known.levels
    if known.unit == "taxels":
        levels = tuple(level for level in levels if float(level) <= taxels)
    numbers = [float(level) for level in levels if not isinstance(level, str)]
    more = tuple(level for level in dict.fromkeys(also) if level not in levels)
    if not numbers:
        return levels + more
    both = [*levels, *more]
    return tuple(sorted(both, key=float, reverse=numbers[0] > numbers[-1]))
