"""The part of the battery that happens to recordings; functions in :mod:`stress.disturbances`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.runtime.studies.stress import disturbances
from spikeloom.runtime.studies.stress.disturbances import Events
from spikeloom.runtime.studies.stress.perturbation import Disturb, Level, Perturbation, Sensor


def _on_taxels(change: Callable[[Events, IntArray], Events], *, adjacent: bool) -> Disturb:
    def disturb(events: Events, level: float, sensor: Sensor, rng: np.random.Generator) -> Events:
        if adjacent:
            return change(events, disturbances.neighbours(sensor.distance, int(level), rng))
        return change(events, disturbances.chosen(sensor.taxels, int(level), rng))

    return disturb


def _by_level(change: Callable[[Events, float, np.random.Generator], Events]) -> Disturb:
    return lambda events, level, _sensor, rng: change(events, level, rng)


def _fixed(change: Callable[[Events, float], Events]) -> Disturb:
    return lambda events, level, _sensor, _rng: change(events, level)


def _swapped(events: Events, level: float, sensor: Sensor, rng: np.random.Generator) -> Events:
    count = round(level * sensor.taxels)
    return disturbances.swap_polarity(events, disturbances.chosen(sensor.taxels, count, rng))


COUNTS: tuple[Level, ...] = (1, 3, 5, 10, 20)
ALL_COUNTS: tuple[Level, ...] = tuple(range(1, 21))
SHARES: tuple[Level, ...] = (0.1, 0.25, 0.5, 0.75, 0.9)
ALL_SHARES: tuple[Level, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
STEPS: tuple[Level, ...] = (2, 5, 10, 25, 50)
ALL_STEPS: tuple[Level, ...] = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 75, 100)

MOST_STEPS = 100_000

RECORDINGS: tuple[Perturbation, ...] = (
    Perturbation(
        name="taxels_dead",
        what="random taxels send nothing",
        unit="taxels",
        levels=COUNTS,
        full=ALL_COUNTS,
        most=np.inf,
        whole=True,
        disturb=_on_taxels(disturbances.silence, adjacent=False),
    ),
    Perturbation(
        name="taxels_dead_adjacent",
        what="a taxel and its nearest ones send nothing",
        unit="taxels",
        levels=COUNTS,
        full=ALL_COUNTS,
        most=np.inf,
        whole=True,
        disturb=_on_taxels(disturbances.silence, adjacent=True),
    ),
    Perturbation(
        name="taxels_stuck",
        what="random taxels send both polarities in every step",
        unit="taxels",
        levels=COUNTS,
        full=ALL_COUNTS,
        most=np.inf,
        whole=True,
        disturb=_on_taxels(disturbances.stick, adjacent=False),
    ),
    Perturbation(
        name="taxels_stuck_adjacent",
        what="a taxel and its nearest ones send both polarities in every step",
        unit="taxels",
        levels=COUNTS,
        full=ALL_COUNTS,
        most=np.inf,
        whole=True,
        disturb=_on_taxels(disturbances.stick, adjacent=True),
    ),
    Perturbation(
        name="events_lost",
        what="each event is lost with a probability",
        unit="probability",
        levels=SHARES,
        full=ALL_SHARES,
        disturb=_by_level(disturbances.lose),
    ),
    Perturbation(
        name="events_spurious",
        what="each empty entry gets an event with a probability",
        unit="probability",
        levels=(0.005, 0.01, 0.02, 0.05, 0.1),
        full=(0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2),
        disturb=_by_level(disturbances.invent),
    ),
    Perturbation(
        name="time_jitter",
        what="each event moves by a normal number of steps",
        unit="steps, standard deviation",
        levels=(1, 2, 5, 10, 25),
        full=(0.5, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50),
        most=MOST_STEPS,
        disturb=_by_level(disturbances.jitter),
    ),
    Perturbation(
        name="start_late",
        what="the grasp begins later than the recording",
        unit="steps",
        levels=STEPS,
        full=ALL_STEPS,
        seeded=False,
        most=MOST_STEPS,
        whole=True,
        disturb=_fixed(lambda events, level: disturbances.start_late(events, int(level))),
    ),
    Perturbation(
        name="start_early",
        what="the first steps of the grasp are missing",
        unit="steps",
        levels=STEPS,
        full=ALL_STEPS,
        seeded=False,
        most=MOST_STEPS,
        whole=True,
        disturb=_fixed(lambda events, level: disturbances.start_early(events, int(level))),
    ),
    Perturbation(
        name="faster",
        what="the grasp takes place faster",
        unit="times",
        levels=(1.1, 1.25, 1.5, 2, 4),
        full=(1.05, 1.1, 1.2, 1.3, 1.4, 1.5, 1.75, 2, 2.5, 3, 4, 6),
        seeded=False,
        least=1,
        most=MOST_STEPS,
        disturb=_fixed(disturbances.play),
    ),
    Perturbation(
        name="slower",
        what="the grasp takes place more slowly, its end is cut off",
        unit="times",
        levels=(1.1, 1.25, 1.5, 2, 4),
        full=(1.05, 1.1, 1.2, 1.3, 1.4, 1.5, 1.75, 2, 2.5, 3, 4, 6),
        seeded=False,
        least=1,
        most=MOST_STEPS,
        disturb=_fixed(lambda events, level: disturbances.play(events, 1 / level)),
    ),
    Perturbation(
        name="polarity_swapped",
        what="random taxels exchange rise and fall",
        unit="share of taxels",
        levels=(0.1, 0.25, 0.5, 1),
        full=(0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1),
        disturb=_swapped,
    ),
    Perturbation(
        name="near_empty",
        what="events are taken away down to a density",
        unit="share of entries with an event",
        levels=(0.1, 0.05, 0.02, 0.005, 0.001),
        full=(0.1, 0.075, 0.05, 0.03, 0.02, 0.015, 0.01, 0.0075, 0.005, 0.002, 0.001, 0),
        disturb=_by_level(disturbances.thin),
    ),
    Perturbation(
        name="saturated",
        what="events are added up to a density",
        unit="share of entries with an event",
        levels=(0.15, 0.2, 0.3, 0.5, 1),
        full=(0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1),
        disturb=_by_level(disturbances.fill),
    ),
)

STATE: tuple[Perturbation, ...] = (
    Perturbation(
        name="warm_state",
        what="other recordings run before, without a reset between",
        unit="recordings before",
        levels=(1, 2),
        full=(1, 2, 3, 5, 10),
        least=1,
        most=100,
        whole=True,
    ),
    Perturbation(
        name="longer",
        what="the recording goes round again without a reset; decided on the last round alone",
        unit="times the length",
        levels=(2, 10),
        full=(2, 3, 5, 10, 20),
        seeded=False,
        least=1,
        most=100,
        whole=True,
    ),
)
"""What happens where recordings follow each other without a reset, see :mod:`stress.runs`."""
