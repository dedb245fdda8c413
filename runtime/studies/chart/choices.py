"""Fronts, points to take, and ``--budget``: which point fits what a user can spend or must reach.

*Choices* are made on the training split alone; test figures are reported beside. What a point is expected to reach is
what the network's training reached on the recordings that it had left out (its validation), times the share of the
float model's accuracy on whole training recordings that the point keeps. Where a checkpoint knows no validation, the
training split's own accuracy takes its place for all networks. *Fronts* are drawn on the test split: they describe.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.studies.chart.results import (
    Against,
    ChartedNetwork,
    ChosenBy,
    Pick,
    Point,
    Saving,
)
from spikeloom.runtime.studies.fronts import Budget, front

NEAR = 1e-9
"""Shares closer than this are equal."""

LOSS = 0.01
"""Accuracy that a saving may cost against the usual mapping: a point."""

VALIDATION = "what a training reached on recordings that it left out, times what a point keeps of training accuracy"
TRAINING = (
    "accuracy on the training split (not every checkpoint knows what its training reached on left-out recordings)"
)


def with_expectations(
    points: Sequence[Point], networks: Sequence[ChartedNetwork]
) -> tuple[list[Point], list[ChartedNetwork], str]:
    """Points and networks with what they are expected to reach, and in words what that is."""
    validated = all(network.file.validation is not None for network in networks)
    reached = [network.file.validation if validated else network.float_training for network in networks]
    known = [replace(network, expected=value or 0.0) for network, value in zip(networks, reached, strict=True)]
    by_name = {network.file.name: network for network in known}

    def reach(point: Point) -> float:
        network = by_name[point.network]
        whole = network.float_training
        return network.expected * point.train.accuracy / whole if whole else 0.0

    return [replace(point, expected=reach(point)) for point in points], known, VALIDATION if validated else TRAINING


# -- fronts ------------------------------------------------------------------------------------------------------------


def with_fronts(points: Sequence[Point], by: ChosenBy) -> list[Point]:
    """Points that know on which fronts of test accuracy and energy, time, operations and cores they are."""
    gains = [point.test.accuracy for point in points]
    on = {
        "energy": front(gains, [point.test.energy_j[by.energy] for point in points]),
        "operations": front(gains, [point.test.synaptic_operations for point in points]),
        "cores": front(gains, [point.n_cores for point in points]),
    }
    if by.time is not None:
        on["latency"] = front(gains, [point.test.time_s[by.time] for point in points])
    return [replace(point, front={name: marks[i] for name, marks in on.items()}) for i, point in enumerate(points)]


# -- choices -----------------------------------------------------------------------------------------------------------

Cost = Callable[[Point], float]


def _energy(by: ChosenBy) -> Cost:
    return lambda point: point.train.energy_j[by.energy]


def best_of(points: Sequence[Point], by: ChosenBy) -> Point:
    """Highest expectation; of several the cheapest, then the first."""
    top = max(point.expected for point in points)
    return min((point for point in points if point.expected >= top - NEAR), key=_energy(by))


def recommended(
    points: Sequence[Point], networks: Sequence[ChartedNetwork], by: ChosenBy, *, bin_s: float
) -> dict[str, int | None]:
    """Points to take, by number; None where no point is good enough, or nothing is timed.

    `bin_s` is the seconds of a bin of the recordings, of which a step of a network may join several.
    """
    reference = max(network.expected for network in networks)
    good = [point for point in points if point.expected >= reference - 1 / points[0].test.samples - NEAR]
    cheapest, fastest, time = min(good, key=_energy(by), default=None), None, by.time
    if time is not None:
        bins = {network.file.name: network.file.bins for network in networks}
        keeping = [point for point in good if point.train.step_s[time] <= bin_s * bins[point.network]]
        fastest = min(keeping, key=lambda point: (point.train.time_s[time], _energy(by)(point)), default=None)
    chosen = {"cheapest": cheapest, "fastest": fastest, "best": best_of(points, by)}
    return {name: None if point is None else point.number for name, point in chosen.items()}


def usual_point(points: Sequence[Point]) -> Point | None:
    """The mapping that others are held against: 8 bits, fewest cores, whole recordings; of the manual graph, if any."""
    usual = [
        p
        for p in points
        if (p.bits, p.planes, p.groups, p.cores, p.window) == ((8,), 1, 1, "cores", 100)
        and not (p.prune or p.fine_tuned)
    ]
    return next((point for point in usual if point.graph == "manual"), usual[0] if usual else None)


def saving(points: Sequence[Point], by: ChosenBy) -> Saving | None:
    """How much less energy than the usual mapping takes, for at most a point of accuracy; None if that is not there."""
    usual = usual_point(points)
    if usual is None:
        return None
    good = [point for point in points if point.expected >= usual.expected - LOSS - NEAR]
    seen = [point for point in points if point.test.accuracy >= usual.test.accuracy - LOSS - NEAR]
    return Saving(
        usual=usual.number,
        chosen=against(min(good, key=_energy(by)), usual),
        seen=against(min(seen, key=lambda point: point.test.energy_j[by.energy]), usual),
    )


def against(point: Point, other: Point) -> Against:
    """A point beside another one."""

    def ratios(base: Mapping[str, float], costs: Mapping[str, float]) -> dict[str, float | None]:
        return {name: base[name] / costs[name] if costs[name] else None for name in costs if name in base}

    return Against(
        point=point.number,
        energy=ratios(other.test.energy_j, point.test.energy_j),
        time=ratios(other.test.time_s, point.test.time_s),
        accuracy=point.test.accuracy - other.test.accuracy,
        expected=point.expected - other.expected,
    )


# -- budgets -----------------------------------------------------------------------------------------------------------


def pick(points: Sequence[Point], budgets: Sequence[Budget], by: ChosenBy) -> Pick | None:
    """The point for a user, chosen by training figures; None without a budget.

    Where an accuracy is wanted, the cheapest point that fits; else the one that is expected to be right most often. If
    nothing fits, the point that misses by the smallest factor.
    """
    if not budgets:
        return None
    if by.time is None and any(budget.what == "latency" for budget in budgets):
        raise OptionError("--budget latency: the chip has no time table, nothing is timed; omit it")

    def excess(point: Point, budget: Budget) -> float:
        """Factor by which a point misses a budget; at most 1 where it fits."""
        reached = _value(point, budget, by)
        if budget.what == "accuracy":
            return budget.limit / reached if reached > 0 else float("inf")
        return reached / budget.limit

    fitting = [point for point in points if all(excess(point, budget) <= 1 + NEAR for budget in budgets)]
    if not fitting:
        chosen = min(points, key=lambda point: (max(excess(point, b) for b in budgets), _energy(by)(point)))
    elif any(budget.what == "accuracy" for budget in budgets):
        chosen = min(fitting, key=_energy(by))
    else:
        chosen = best_of(fitting, by)
    best = best_of(points, by)
    return Pick(
        budgets=tuple(budget.words for budget in budgets),
        fits=bool(fitting),
        fitting=len(fitting),
        point=chosen.number,
        misses={
            budget.what: {"limit": budget.limit, "found": _value(chosen, budget, by)}
            for budget in budgets
            if excess(chosen, budget) > 1 + NEAR
        },
        best=best.number,
        given_up=against(chosen, best),
    )


def _value(point: Point, budget: Budget, by: ChosenBy) -> float:
    if budget.what == "latency":
        return point.train.time_s[str(by.time)]
    return point.expected if budget.what == "accuracy" else _energy(by)(point)
