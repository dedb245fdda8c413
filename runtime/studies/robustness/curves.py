"""What the runs of a battery say: curves with intervals, where they break, whether on both sides, and why.

*Intervals.* Over several seeds the 95 % interval of Student for the mean; of a single run Wilson's.
*Leaves*: the first level at which the mean accuracy is below Wilson's interval of the clean one.
*Chance*: the first of these at which Wilson's interval, for as many recordings as there are, holds one in as many as
there are classes.
*Verdict*, from the chip: *robust* if it never leaves, *breaks* if it comes down to chance, else *degrades*.
Both sides break at the *same place* if the second has left, or has an interval that overlaps the other's, at the first
level at which one leaves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.equivalence.breakdowns import OFTEN
from spikeloom.runtime.report.numbers import of_mean, wilson
from spikeloom.runtime.studies.robustness.definition import Level
from spikeloom.runtime.studies.robustness.pair import SIDES
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED
from spikeloom.runtime.studies.robustness.results import Breaks, Curve, Point, Run, Spread, shown

ROBUST = "robust"
DEGRADES = "degrades"
BREAKS = "breaks"

# From what on something is named as a reason:
FULL = 0.5  # Share of all entries (neuron, step): a layer is saturated
MOSTLY = 0.8  # Share of the decisions: one class
WITHOUT = 0.2  # Share of the recordings: missing votes, or an overflow
TWICE = 2.0  # Factor by which a layer fires more or less often
REASONS = 2  # So many are named at most


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """What the chip must reach: ``name:level>=share``."""

    name: str
    level: Level
    share: float

    def __str__(self) -> str:
        return f"{self.name}:{shown(self.level)}>={self.share:g}"


def parse_requirement(words: str) -> Requirement:
    """Read ``taxels_dead:3>=0.85``; an OptionError says why it is none.

    >>> str(parse_requirement("taxels_dead:3 >= 0.85"))
    'taxels_dead:3>=0.85'
    """
    left, given, right = words.partition(">=")
    name, named, level = (part.strip() for part in left.partition(":"))
    if not (given and named):
        raise OptionError(
            f"--require {words}: is not NAME:LEVEL>=SHARE; write for example taxels_dead:3>=0.85"
        )
    if name not in SAMPLED:
        raise OptionError(
            f"--require {words}: {name!r} is no perturbation; choose from {', '.join(SAMPLED)}"
        )
    try:
        share = float(right)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 1:
        raise OptionError(f"--require {words}: {right.strip()!r} is no share; give a number from 0 to 1")
    return Requirement(name=name, level=SAMPLED[name].level_of(level), share=share)


def unmet(requirements: Sequence[Requirement], curves: Mapping[str, Curve]) -> tuple[str, ...]:
    """Say which requirements the chip misses."""
    reached = [
        next(point.chip.mean for point in curves[wanted.name].levels if point.level == wanted.level)
        for wanted in requirements
    ]
    return tuple(
        f"{wanted}: {mean:.4f} reached"
        for wanted, mean in zip(requirements, reached, strict=True)
        if mean < wanted.share
    )


def spread(right: Sequence[int], recordings: int) -> Spread:
    """Mean accuracy over seeds, and its interval."""
    values = tuple(count / recordings for count in right)
    low, high = wilson(right[0], recordings) if len(right) == 1 else of_mean(values)
    return Spread(mean=fmean(values), low=max(low, 0.0), high=min(high, 1.0), values=values)


def curve(
    name: str, runs: Mapping[Level, Sequence[Run]], clean: Run, recordings: int, classes: int
) -> Curve:
    """Curve and verdict of one perturbation, from the runs of each seed by level, from mild to harsh."""
    levels = tuple(_point(level, every, clean, recordings) for level, every in runs.items())
    breaks = {}
    for side in SIDES:
        floor = wilson(clean.right[side], recordings)[0]
        below = {point.level: point.spread(side).mean for point in levels if point.spread(side).mean < floor}
        chance = (
            level
            for level, mean in below.items()
            if wilson(round(mean * recordings), recordings)[0] <= 1 / classes
        )
        breaks[side] = Breaks(leaves=next(iter(below), None), chance=next(chance, None))
    chip = breaks["chip"]
    left = {each.leaves for each in breaks.values()}
    first = next((point for point in levels if point.level in left), None)
    overlap = first is not None and _overlap(first.model, first.chip)
    return Curve(
        what=SAMPLED[name].what,
        unit=SAMPLED[name].unit,
        seeded=SAMPLED[name].seeded,
        levels=levels,
        breaks=breaks,
        same_place=first is None or left == {first.level} or overlap,
        verdict=ROBUST if chip.leaves is None else DEGRADES if chip.chance is None else BREAKS,
    )


def _overlap(one: Spread, other: Spread) -> bool:
    """Whether two intervals have anything in common."""
    return max(one.low, other.low) <= min(one.high, other.high)


def _point(level: Level, runs: Sequence[Run], clean: Run, recordings: int) -> Point:
    layers = {
        name: tuple(map(sum, zip(*(run.layers[name] for run in runs), strict=True))) for name in clean.layers
    }
    accuracy = {side: spread([run.right[side] for run in runs], recordings) for side in SIDES}
    return Point(
        level=level,
        seeds=tuple(run.seed for run in runs if run.seed is not None),
        model=accuracy["float"],
        chip=accuracy["chip"],
        equal=sum(run.equal for run in runs) / (recordings * len(runs)),
        # as ``verify`` counts it
        common={name: 1 - moved / (a + b) if a + b else 1.0 for name, (a, b, moved, _) in layers.items()},
        stopped=sum(run.stopped for run in runs),
        saturated=sum(run.saturated for run in runs),
        why={side: reasons(side, runs, layers, clean, recordings) for side in SIDES},
    )


def reasons(
    side: str, runs: Sequence[Run], layers: Mapping[str, Sequence[int]], clean: Run, recordings: int
) -> tuple[str, ...]:
    """What is to be seen on one side, worst first: overflow, layers, decisions; rates where nothing else is.

    Counts of `layers` are as in a run, over all seeds; `recordings` are those of one run.
    """
    total = recordings * len(runs)
    column = SIDES.index(side)
    seen = []
    stopped = sum(run.stopped for run in runs)
    if side == "chip" and stopped >= WITHOUT * total:
        seen.append(f"a register overflows in {stopped} of {total} recordings")
    ratio: dict[str, float] = {}
    for name, counts in layers.items():
        before = clean.layers[name][column] * len(runs)
        after = counts[column]
        ratio[name] = (after + 1) / (before + 1)
        if before >= OFTEN and not after:
            seen.append(f"{name} is silent")
        elif after >= FULL * counts[3] and after >= TWICE * before:
            share = 100 * after / max(counts[3], 1)
            seen.append(f"{name} is saturated: fires in {share:.0f} % of all steps")
    without = sum(run.signs[side].get("no vote", 0) for run in runs)
    if without >= WITHOUT * total:
        seen.append(f"no vote in {without} of {total}")
    most = sum(run.most[side][1] for run in runs) / total
    if 2 * sum("one class" in run.signs[side] for run in runs) > len(runs):
        seen.append("one class for every recording")
    elif most >= MOSTLY:
        seen.append(f"one class in {100 * most:.0f} % of the decisions")
    if not seen:
        name = max(ratio, key=lambda layer: abs(math.log(ratio[layer])))
        if not 1 / TWICE < ratio[name] < TWICE:
            seen.append(f"{name} fires {ratio[name]:.2g} times as often")
    return tuple(seen[:REASONS])
