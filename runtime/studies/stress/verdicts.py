"""What the runs of a battery say: curves with intervals, where they break, whether on both sides, and why.

*Intervals.* Over several seeds the 95 % interval of Student for the mean; of a single run Wilson's. *Leaves*: the first
level at which the mean accuracy is below Wilson's interval of the clean one. *Chance*: the first of these at which
Wilson's interval, for as many recordings as there are, holds one in as many as there are classes. *Verdict*, from the
chip: *robust* if it never leaves, *breaks* if it comes down to chance, else *degrades*. Both sides break at the *same
place* if the second has left, or has an interval that overlaps the other's, at the first level at which one leaves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.equivalence.breakdowns import OFTEN
from spikeloom.runtime.report.intervals import of_mean, wilson
from spikeloom.runtime.studies.stress.battery import NAMES, level_of
from spikeloom.runtime.studies.stress.perturbation import Level

Json = dict[str, Any]

SIDES = ("float", "chip")

ROBUST, DEGRADES, BREAKS = VERDICTS = ("robust", "degrades", "breaks")

FULL = 0.5
"""Share of all entries (neuron, step) from which on a layer is called saturated."""

MOSTLY = 0.8
"""Share of the decisions from which on one class is worth naming."""

WITHOUT = 0.2
"""Share of the recordings from which on missing votes, or an overflow, are named."""

TWICE = 2.0
"""Factor by which a layer must fire more or less often to be named."""

REASONS = 2
"""Reasons that are named at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """What the chip must reach: ``name:level>=share``."""

    name: str
    level: Level
    share: float

    def __str__(self) -> str:
        return f"{self.name}:{shown(self.level)}>={self.share:g}"


def shown(level: Level) -> str:
    """A level as it is typed.

    Examples
    --------
    >>> shown(3), shown(0.25), shown(1e-4), shown("knn:4")
    ('3', '0.25', '0.0001', 'knn:4')
    """
    return level if isinstance(level, str) else f"{level:g}"


def parse_requirement(words: str) -> Requirement:
    """Read ``taxels_dead:3>=0.85``.

    Raises
    ------
    OptionError
        If it is none.

    Examples
    --------
    >>> str(parse_requirement("taxels_dead:3 >= 0.85"))
    'taxels_dead:3>=0.85'
    """
    left, given, right = words.partition(">=")
    name, named, level = (part.strip() for part in left.partition(":"))
    if not (given and named):
        raise OptionError(f"--require {words}: is not NAME:LEVEL>=SHARE; write for example taxels_dead:3>=0.85")
    if name not in NAMES:
        raise OptionError(f"--require {words}: {name!r} is no perturbation; choose from {', '.join(NAMES)}")
    try:
        share = float(right)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 1:
        raise OptionError(f"--require {words}: {right.strip()!r} is no share; give a number from 0 to 1")
    return Requirement(name=name, level=level_of(name, level), share=share)


def unmet(requirements: Sequence[Requirement], curves: Mapping[str, Json]) -> list[str]:
    """Say which requirements the chip misses."""
    missed = []
    for wanted in requirements:
        point = next(p for p in curves[wanted.name]["levels"] if p["level"] == wanted.level)
        if point["chip"]["mean"] < wanted.share:
            missed.append(f"{wanted}: {point['chip']['mean']:.4f} reached")
    return missed


def spread(right: Sequence[int], recordings: int) -> Json:
    """Mean accuracy over seeds, and its interval."""
    values = [count / recordings for count in right]
    mean = fmean(values)
    low, high = wilson(right[0], recordings) if len(right) == 1 else of_mean(values)
    return {"mean": mean, "low": max(low, 0.0), "high": min(high, 1.0), "values": values}


def curve(runs: Sequence[tuple[Level, Sequence[Json]]], clean: Json, recordings: int, classes: int) -> Json:
    """Curve, breakdown and verdict of one perturbation.

    Parameters
    ----------
    runs : sequence of (level, runs of each seed)
        From mild to harsh, see :func:`runs.measure`.
    clean : dict
        Run of the clean recordings.
    recordings, classes : int

    Returns
    -------
    dict
        ``levels``, ``breaks`` by side (``leaves`` and ``chance``, levels or None), ``same_place`` and ``verdict``.
    """
    levels = [_point(level, every, clean, recordings) for level, every in runs]
    breaks: Json = {}
    for side in SIDES:
        floor = wilson(clean["right"][side], recordings)[0]
        out = [point for point in levels if point[side]["mean"] < floor]
        lost = [point for point in out if wilson(round(point[side]["mean"] * recordings), recordings)[0] <= 1 / classes]
        breaks[side] = {
            "leaves": out[0]["level"] if out else None,
            "chance": lost[0]["level"] if lost else None,
        }
    chip = breaks["chip"]
    verdict = ROBUST if chip["leaves"] is None else DEGRADES if chip["chance"] is None else BREAKS
    first = [point for point in levels if point["level"] in {breaks[side]["leaves"] for side in SIDES}][:1]
    together = all(breaks[side]["leaves"] == point["level"] or _overlap(point) for point in first for side in SIDES)
    return {"levels": levels, "breaks": breaks, "same_place": together, "verdict": verdict}


def _overlap(point: Json) -> bool:
    """Whether the intervals of both sides do."""
    return bool(max(point[side]["low"] for side in SIDES) <= min(point[side]["high"] for side in SIDES))


def _point(level: Level, runs: Sequence[Json], clean: Json, recordings: int) -> Json:
    """One level: accuracy of both sides, equal decisions, spikes in common, and what is to be seen."""
    total = recordings * len(runs)
    layers = {name: [sum(run["layers"][name][i] for run in runs) for i in range(4)] for name in clean["layers"]}
    return {
        "level": level,
        "seeds": [run["seed"] for run in runs],
        **{side: spread([run["right"][side] for run in runs], recordings) for side in SIDES},
        "equal": sum(run["equal"] for run in runs) / total,
        "common": {name: _common(*counts[:3]) for name, counts in layers.items()},
        "stopped": sum(run["stopped"] for run in runs),
        "saturated": sum(run["saturated"] for run in runs),
        "why": {side: reasons(side, runs, layers, clean, recordings) for side in SIDES},
    }


def _common(model: int, chip: int, different: int) -> float:
    """Share of spikes in common, as ``verify`` counts it."""
    return 1 - different / (model + chip) if model + chip else 1.0


def reasons(
    side: str, runs: Sequence[Json], layers: Mapping[str, Sequence[int]], clean: Json, recordings: int
) -> list[str]:
    """What is to be seen on one side, worst first: overflow, layers, decisions; rates where nothing else is.

    Parameters
    ----------
    side : {"float", "chip"}
    runs : sequence of dict
        Of each seed.
    layers : mapping of str to sequence of int
        Spikes of the float network and of the chip, different ones, entries; over all seeds.
    clean : dict
        Run of the clean recordings.
    recordings : int
        Of one run.
    """
    total, column = recordings * len(runs), SIDES.index(side)
    found = []
    stopped = sum(run["stopped"] for run in runs)
    if side == "chip" and stopped >= WITHOUT * total:
        found.append(f"a register overflows in {stopped} of {total} recordings")
    ratio: dict[str, float] = {}
    for name, counts in layers.items():
        before, after = clean["layers"][name][column] * len(runs), counts[column]
        ratio[name] = (after + 1) / (before + 1)
        if before >= OFTEN and not after:
            found.append(f"{name} is silent")
        elif after >= FULL * counts[3] and after >= TWICE * before:
            found.append(f"{name} is saturated: fires in {100 * after / max(counts[3], 1):.0f} % of all steps")
    signs = [run["signs"][side] for run in runs]
    without = sum(sign.get("no vote", 0) for sign in signs)
    if without >= WITHOUT * total:
        found.append(f"no vote in {without} of {total}")
    if 2 * sum("one class" in sign for sign in signs) > len(runs):
        found.append("one class for every recording")
    else:
        often = [run["most"][side] for run in runs]
        share = sum(count for _, count in often) / total
        if share >= MOSTLY:
            found.append(f"one class in {100 * share:.0f} % of the decisions")
    if not found:
        name = max(ratio, key=lambda layer: abs(math.log(ratio[layer])))
        if not 1 / TWICE < ratio[name] < TWICE:
            found.append(f"{name} fires {ratio[name]:.2g} times as often")
    return found[:REASONS]
