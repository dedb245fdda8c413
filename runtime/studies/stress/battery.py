"""The battery of ``stress``: one table of everything that is perturbed, at which levels, and what is done for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TITLES
from spikeloom.compiler.types import IntArray
from spikeloom.models.graphs import build_graph
from spikeloom.models.systems import propagation_of
from spikeloom.runtime.studies.stress import damages, disturbances
from spikeloom.runtime.studies.stress.bench import Bench, Sensor, after_others, going_round
from spikeloom.runtime.studies.stress.disturbances import Events
from spikeloom.runtime.studies.stress.pair import Inputs, Pair

Level = int | float | str
Changed = TypeVar("Changed")
Disturb = Callable[[Events, Any, Sensor, np.random.Generator], Events]
Damage = Callable[[Pair, Any, Sensor, np.random.Generator], Pair]

SEEDS = 5
"""Draws of each random perturbation."""

MOST_STEPS = 100_000


@dataclass(frozen=True, slots=True)
class Scale:
    """What levels count, those to measure from mild to harsh (`full` with ``--full``), and which make sense."""

    unit: str
    levels: tuple[Level, ...]
    full: tuple[Level, ...]
    least: float = 0.0
    most: float = 1.0
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One kind of trouble: its name, a line for people, its levels, and one of three functions that bring it about.

    `disturb` changes events, `damage` netlist and float network, `replay` how recordings follow each other. They get
    the level as it stands in the scale, and a source of chance unless it has no part in it (`seeded`). `obstacle` says
    why the perturbation makes no sense for a network, or None.
    """

    name: str
    what: str
    scale: Scale
    disturb: Disturb | None = None
    damage: Damage | None = None
    replay: Callable[[Bench, Any, np.random.Generator], Inputs] | None = None
    seeded: bool = True
    obstacle: Callable[[Pair, Sensor], str | None] | None = None


# -- obstacles ---------------------------------------------------------------------------------------------------------


def _no_graph(_pair: Pair, sensor: Sensor) -> str | None:
    if sensor.checkpoint is None:
        return "a network from an ONNX or NIR file has no taxel graph that is known"
    system = sensor.checkpoint.system
    return None if system in GRAPH_SYSTEMS else f"{TITLES[system]} has no taxel graph"


def _no_places(pair: Pair, sensor: Sensor) -> str | None:
    unknown = "positions of the taxels are not known, no graph can be built on them"
    return _no_graph(pair, sensor) or (unknown if sensor.places is None else None)


def _several_planes(pair: Pair, _sensor: Sensor) -> str | None:
    netlist = pair.netlist
    exponent = netlist.format_exponent[netlist.axon_format[netlist.axon_of_synapse()]]
    kinds = {*zip(netlist.layer[netlist.synapse_compartment()].tolist(), exponent.tolist(), strict=True)}
    return "weights are stored in several planes" if len(kinds) > len({layer for layer, _ in kinds}) else None


def _not_two_polarities(pair: Pair, _sensor: Sensor) -> str | None:
    count = pair.netlist.polarities
    return None if count == 2 else f"the sensor has {count} polarities"


# -- what is done ------------------------------------------------------------------------------------------------------


def _on_taxels(change: Callable[[Events, IntArray], Events], *, adjacent: bool = False) -> Disturb:
    def disturb(events: Events, count: Any, sensor: Sensor, rng: np.random.Generator) -> Events:
        if adjacent:
            return change(events, disturbances.neighbours(sensor.distance, count, rng))
        return change(events, disturbances.chosen(sensor.taxels, count, rng))

    return disturb


def _drawn(change: Callable[[Any, Any, np.random.Generator], Changed]) -> Callable[..., Changed]:
    return lambda before, level, _sensor, rng: change(before, level, rng)


def _fixed(change: Callable[[Any, Any], Changed]) -> Callable[..., Changed]:
    return lambda before, level, _sensor, _rng: change(before, level)


def _on_edges(change: Callable[[IntArray, int, Any, np.random.Generator], IntArray]) -> Damage:
    def damage(pair: Pair, share: Any, sensor: Sensor, rng: np.random.Generator) -> Pair:
        assert sensor.edges is not None, "no obstacle"
        return _on_graph(pair, sensor, change(sensor.edges, sensor.taxels, share, rng))

    return damage


def _other_graph(pair: Pair, name: Any, sensor: Sensor, _rng: np.random.Generator) -> Pair:
    assert sensor.places is not None, "no obstacle"
    return _on_graph(pair, sensor, build_graph(name, sensor.places).edges)


def _on_graph(pair: Pair, sensor: Sensor, edges: IntArray) -> Pair:
    checkpoint = sensor.checkpoint
    assert checkpoint is not None, "no obstacle"
    seen = propagation_of(checkpoint.system, edges, checkpoint.taxels, checkpoint.grid, len(checkpoint.hops))
    return damages.stored_alike(pair, expand(checkpoint, seen))


# -- the table ---------------------------------------------------------------------------------------------------------

TAXELS = Scale("taxels", (1, 3, 5, 10, 20), tuple(range(1, 21)), most=np.inf, whole=True)
STEPS = Scale(
    "steps", (2, 5, 10, 25, 50), (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 75, 100), most=MOST_STEPS, whole=True
)
TEMPO = Scale(
    "times", (1.1, 1.25, 1.5, 2, 4), (1.05, 1.1, 1.2, 1.3, 1.4, 1.5, 1.75, 2, 2.5, 3, 4, 6), least=1, most=MOST_STEPS
)
TENTHS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
DENSITY = "share of entries with an event"
HIDDEN = "share of hidden neurons"

BATTERY = (
    # -- recordings
    Perturbation("taxels_dead", "random taxels send nothing", TAXELS, disturb=_on_taxels(disturbances.silence)),
    Perturbation(
        "taxels_dead_adjacent",
        "a taxel and its nearest ones send nothing",
        TAXELS,
        disturb=_on_taxels(disturbances.silence, adjacent=True),
    ),
    Perturbation(
        "taxels_stuck",
        "random taxels send both polarities in every step",
        TAXELS,
        disturb=_on_taxels(disturbances.stick),
    ),
    Perturbation(
        "taxels_stuck_adjacent",
        "a taxel and its nearest ones send both polarities in every step",
        TAXELS,
        disturb=_on_taxels(disturbances.stick, adjacent=True),
    ),
    Perturbation(
        "events_lost",
        "each event is lost with a probability",
        Scale("probability", (0.1, 0.25, 0.5, 0.75, 0.9), (*TENTHS, 0.95)),
        disturb=_drawn(disturbances.lose),
    ),
    Perturbation(
        "events_spurious",
        "each empty entry gets an event with a probability",
        Scale(
            "probability",
            (0.005, 0.01, 0.02, 0.05, 0.1),
            (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2),
        ),
        disturb=_drawn(disturbances.invent),
    ),
    Perturbation(
        "time_jitter",
        "each event moves by a normal number of steps",
        Scale(
            "steps, standard deviation", (1, 2, 5, 10, 25), (0.5, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50), most=MOST_STEPS
        ),
        disturb=_drawn(disturbances.jitter),
    ),
    Perturbation(
        "start_late",
        "the grasp begins later than the recording",
        STEPS,
        disturb=_fixed(disturbances.start_late),
        seeded=False,
    ),
    Perturbation(
        "start_early",
        "the first steps of the grasp are missing",
        STEPS,
        disturb=_fixed(disturbances.start_early),
        seeded=False,
    ),
    Perturbation("faster", "the grasp takes place faster", TEMPO, disturb=_fixed(disturbances.play), seeded=False),
    Perturbation(
        "slower",
        "the grasp takes place more slowly, its end is cut off",
        TEMPO,
        disturb=_fixed(lambda events, times: disturbances.play(events, 1 / times)),
        seeded=False,
    ),
    Perturbation(
        "polarity_swapped",
        "random taxels exchange rise and fall",
        Scale("share of taxels", (0.1, 0.25, 0.5, 1), (*TENTHS, 1)),
        disturb=lambda events, share, sensor, rng: disturbances.swap_polarity(
            events, disturbances.chosen(sensor.taxels, round(share * sensor.taxels), rng)
        ),
        obstacle=_not_two_polarities,
    ),
    Perturbation(
        "near_empty",
        "events are taken away down to a density",
        Scale(
            DENSITY,
            (0.1, 0.05, 0.02, 0.005, 0.001),
            (0.1, 0.075, 0.05, 0.03, 0.02, 0.015, 0.01, 0.0075, 0.005, 0.002, 0.001, 0),
        ),
        disturb=_drawn(disturbances.thin),
    ),
    Perturbation(
        "saturated",
        "events are added up to a density",
        Scale(DENSITY, (0.15, 0.2, 0.3, 0.5, 1), (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1)),
        disturb=_drawn(disturbances.fill),
    ),
    # -- state that is left over
    Perturbation(
        "warm_state",
        "other recordings run before, without a reset between",
        Scale("recordings before", (1, 2), (1, 2, 3, 5, 10), least=1, most=100, whole=True),
        replay=after_others,
    ),
    Perturbation(
        "longer",
        "the recording goes round again without a reset; decided on the last round alone",
        Scale("times the length", (2, 10), (2, 3, 5, 10, 20), least=1, most=100, whole=True),
        replay=lambda bench, rounds, _: going_round(bench, rounds),
        seeded=False,
    ),
    # -- the network
    Perturbation(
        "weight_bit_flips",
        "each stored bit of a weight flips with a probability",
        Scale(
            "probability", (1e-4, 1e-3, 0.01, 0.05), (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2)
        ),
        damage=_drawn(damages.flip_bits),
    ),
    Perturbation(
        "neurons_silent",
        "random hidden neurons never fire",
        Scale(HIDDEN, (0.05, 0.1, 0.25, 0.5), (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, 0.9)),
        damage=_drawn(partial(damages.stick_neurons, firing=False)),
    ),
    Perturbation(
        "neurons_firing",
        "random hidden neurons fire in every step",
        Scale(HIDDEN, (0.005, 0.02, 0.05, 0.1), (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2)),
        damage=_drawn(partial(damages.stick_neurons, firing=True)),
    ),
    Perturbation(
        "threshold_spread",
        "each threshold drifts by a factor of its own",
        Scale("standard deviation, share", (0.05, 0.1, 0.2, 0.4), (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)),
        damage=_drawn(damages.spread_thresholds),
    ),
    Perturbation(
        "threshold_raised",
        "all thresholds rise: towards a silent network",
        Scale(
            "times",
            (1.05, 1.1, 1.25, 1.5, 2),
            (1.02, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.5, 1.75, 2, 3),
            least=1,
            most=1000,
        ),
        damage=_fixed(damages.scale_thresholds),
        seeded=False,
    ),
    Perturbation(
        "threshold_lowered",
        "all thresholds fall: towards a saturated network",
        Scale("times", (0.95, 0.9, 0.75, 0.5), (0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.35, 0.25)),
        damage=_fixed(damages.scale_thresholds),
        seeded=False,
    ),
    Perturbation(
        "ties_fire",
        "thresholds fall by register units: at 1, more than every tie fires (>= for >)",
        Scale("units", (1, 2), (1, 2, 3, 5), most=1000, whole=True),
        damage=_fixed(lambda pair, units: damages.with_thresholds(pair, pair.netlist.threshold - units)),
        seeded=False,
    ),
    Perturbation(
        "layers_late",
        "layers after the first open their windows late, off by one and more",
        Scale("steps", (1, 2, 5, 25), (1, 2, 3, 5, 10, 25, 50, 100), most=1000, whole=True),
        damage=_fixed(damages.open_late),
        seeded=False,
    ),
    Perturbation(
        "other_graph",
        "another taxel graph than the one of the training",
        Scale("graph", ("knn:1", "knn:4", "mst:0"), (*(f"knn:{k}" for k in range(1, 9)), "mst:0", "mst:3", "manual")),
        damage=_other_graph,
        seeded=False,
        obstacle=_no_places,
    ),
    Perturbation(
        "edges_rewired",
        "edges of the taxel graph lead elsewhere",
        Scale("share of edges", (0.05, 0.1, 0.25, 0.5), (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1)),
        damage=_on_edges(damages.rewire),
        obstacle=_no_graph,
    ),
    Perturbation(
        "edges_doubled",
        "edges of the taxel graph are listed twice",
        Scale("share of edges", (0.1, 0.25, 0.5, 1), (*TENTHS, 1)),
        damage=_on_edges(lambda edges, _, share, rng: damages.double(edges, share, rng)),
        obstacle=_no_graph,
    ),
    Perturbation(
        "fewer_bits",
        "weights keep fewer bits on the scale that they have",
        Scale("bits", (6, 5, 4, 3, 2), (7, 6, 5, 4, 3, 2), least=2, most=8, whole=True),
        damage=_fixed(damages.fewer_bits),
        seeded=False,
        obstacle=_several_planes,
    ),
    Perturbation(
        "outlier_weight",
        "one weight a layer grows beyond the largest and takes the scale with it",
        Scale("times the largest", (2, 4, 8, 16), (2, 4, 8, 16, 32, 64), least=1, most=64, whole=True),
        damage=_drawn(damages.add_outliers),
    ),
    Perturbation(
        "shorter_decay",
        "membranes and lasting currents keep a smaller share",
        Scale("times the decay", (0.75, 0.5, 0.25, 0), (0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0)),
        damage=_fixed(damages.shorten_decay),
        seeded=False,
    ),
)

NAMES = {perturbation.name: perturbation for perturbation in BATTERY}


# -- levels ------------------------------------------------------------------------------------------------------------


def why_not(name: str, pair: Pair, sensor: Sensor) -> str | None:
    """Why a perturbation makes no sense for a network, or None where it does."""
    obstacle = NAMES[name].obstacle
    return None if obstacle is None else obstacle(pair, sensor)


def level_of(name: str, words: str) -> Level:
    """Read a level of a perturbation; refused if it is none that makes sense.

    Examples
    --------
    >>> level_of("taxels_dead", "3"), level_of("other_graph", "knn:4")
    (3, 'knn:4')
    """
    scale = NAMES[name].scale
    if isinstance(scale.levels[0], str):
        return build_graph(words).name
    try:
        level = float(words)
    except ValueError:
        level = float("nan")
    if not scale.least <= level <= scale.most or (scale.whole and level != int(level)):
        kind = "a whole number" if scale.whole else "a number"
        limits = f"from {scale.least:g}" + ("" if scale.most == np.inf else f" to {scale.most:g}")
        raise OptionError(f"{name}:{words}: {words!r} is no level of it; give {kind} {limits} ({scale.unit})")
    return int(level) if level == int(level) else level


def levels_of(name: str, taxels: int, *, full: bool, also: Sequence[Level] = ()) -> tuple[Level, ...]:
    """Levels to measure on a sensor of so many taxels, from mild to harsh, further ones among them.

    Examples
    --------
    >>> levels_of("taxels_dead", 6, full=False, also=[2])
    (1, 2, 3, 5)
    """
    scale = NAMES[name].scale
    levels = scale.full if full else scale.levels
    if scale is TAXELS:
        levels = tuple(level for level in levels if float(level) <= taxels)
    every = [*levels, *(level for level in dict.fromkeys(also) if level not in levels)]
    if isinstance(scale.levels[0], str):
        return tuple(every)
    return tuple(sorted(every, key=float, reverse=float(scale.levels[0]) > float(scale.levels[-1])))
