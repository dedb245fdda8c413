"""Points of a chart: accuracies with intervals, fronts, and which points to take.

*Choices* are made on the training split alone; test figures are reported beside. What a point is expected to reach is
what the network's training reached on the recordings that it had left out (its validation), times the share of the
float model's accuracy on whole training recordings that the point keeps. Where a checkpoint knows no validation, the
training split's own accuracy takes its place for all networks. *Fronts* are drawn on the test split: they describe.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from spikeloom.runtime.report.intervals import wilson

Json = dict[str, Any]

NEAR = 1e-9
"""Shares closer than this are equal."""

LOSS = 0.01
"""Accuracy that a saving may cost against the usual mapping: a point."""

VALIDATION = "what a training reached on recordings that it left out, times what a point keeps of training accuracy"
TRAINING = (
    "accuracy on the training split (not every checkpoint knows what its training reached on left-out recordings)"
)


def own_value(found: Mapping[str, float], table: str) -> float:
    """A cost by a table, or by the first of those of another chip, whose prices have other names.

    Examples
    --------
    >>> own_value({"davies": 1.0, "sanafe": 2.0}, "sanafe"), own_value({"all_in": 3.0, "marginal": 4.0}, "sanafe")
    (2.0, 3.0)
    """
    return float(found[table] if table in found else next(iter(found.values())))


def by_chip(entries: Sequence[Json], target: str) -> tuple[list[Json], list[Json]]:
    """Points or networks of a chip, and those of others; what does not say its chip is of this one."""
    own = [entry for entry in entries if entry.get("target", target) == target]
    return own, [entry for entry in entries if entry.get("target", target) != target]


# -- one point ---------------------------------------------------------------------------------------------------------


def figures(ran: Json, decided: Sequence[int], labels: Sequence[int]) -> Json:
    """Figures of a point on one split.

    Parameters
    ----------
    ran : dict
        Of :func:`work.measure`, of that split.
    decided : sequence of int
        Decisions of the float model on the same part of each recording.
    labels : sequence of int
        Classes.
    """
    chip, model, truth = np.array(ran["decisions"]), np.array(decided), np.array(labels)
    return {
        "samples": len(truth),
        **share(int(np.sum(chip == truth)), len(truth)),
        "float": share(int(np.sum(model == truth)), len(truth)),
        "equal": int(np.sum(chip == model)),
        **{key: ran[key] for key in ("energy_j", "time_s", "step_s", "synaptic_operations", "steps")},
    }


def share(correct: int, samples: int) -> Json:
    """An accuracy with its Wilson interval.

    Examples
    --------
    >>> share(3, 4)["accuracy"]
    0.75
    """
    low, high = wilson(correct, samples)
    return {"correct": correct, "accuracy": correct / samples, "low": low, "high": high}


def with_expectations(points: Sequence[Json], networks: Sequence[Json]) -> str:
    """Add to each point what it is expected to reach; return in words what that is.

    Parameters
    ----------
    points : sequence of dict
        With ``network``, ``train``; changed in place.
    networks : sequence of dict
        With ``name``, ``validation`` and ``float_training``, the float model's share on whole training recordings.
    """
    by_name = {network["name"]: network for network in networks}
    validated = all(network["validation"] is not None for network in networks)
    for network in networks:
        network["expected"] = network["validation"] if validated else network["float_training"]
    for point in points:
        network = by_name[point["network"]]
        whole = network["float_training"]
        point["expected"] = network["expected"] * point["train"]["accuracy"] / whole if whole else 0.0
    return VALIDATION if validated else TRAINING


# -- fronts ------------------------------------------------------------------------------------------------------------


def front(gains: Sequence[float], costs: Sequence[float]) -> list[bool]:
    """Which points no other one beats: at least as much gain for at most the cost, and better in one of them.

    Examples
    --------
    >>> front([0.9, 0.8, 0.7, 0.9], [3.0, 1.0, 2.0, 3.0])
    [True, True, False, True]
    """
    order = sorted(range(len(gains)), key=lambda i: (costs[i], -gains[i]))
    found = [False] * len(gains)
    best, best_cost = float("-inf"), float("nan")
    for i in order:
        found[i] = gains[i] > best or (gains[i] == best and costs[i] == best_cost)
        if gains[i] > best:
            best, best_cost = gains[i], costs[i]
    return found


def with_fronts(points: Sequence[Json], energy: str, time: str | None) -> None:
    """Mark the points on the fronts of test accuracy and energy, time, operations and cores; in place."""
    gains = [point["test"]["accuracy"] for point in points]
    on = {
        "energy": front(gains, [point["test"]["energy_j"][energy] for point in points]),
        "operations": front(gains, [point["test"]["synaptic_operations"] for point in points]),
        "cores": front(gains, [point["n_cores"] for point in points]),
    }
    if time is not None:
        on["latency"] = front(gains, [point["test"]["time_s"][time] for point in points])
    for i, point in enumerate(points):
        point["front"] = {name: marks[i] for name, marks in on.items()}


# -- choices -----------------------------------------------------------------------------------------------------------


def cost_of(energy: str) -> Callable[[Json], float]:
    """Energy of a mean training recording, by one table."""
    return lambda point: float(point["train"]["energy_j"][energy])


def time_of(time: str) -> Callable[[Json], float]:
    """Time of a mean training recording, by one table."""
    return lambda point: float(point["train"]["time_s"][time])


def best_of(points: Sequence[Json], energy: str) -> Json:
    """Highest expectation; of several the cheapest, then the first."""
    top = max(point["expected"] for point in points)
    return min((point for point in points if point["expected"] >= top - NEAR), key=cost_of(energy))


def recommended(
    points: Sequence[Json], networks: Sequence[Json], *, energy: str, time: str | None, bin_s: float
) -> dict[str, int | None]:
    """Points to take, by number; None where no point is good enough, or nothing is timed.

    Parameters
    ----------
    points, networks : sequence of dict
        With expectations.
    energy, time : str
        Tables to choose by.
    bin_s : float
        Seconds of a bin of the recordings; a step of a network may join several.
    """
    samples = points[0]["test"]["samples"]
    reference = max(network["expected"] for network in networks)
    good = [point for point in points if point["expected"] >= reference - 1 / samples - NEAR]
    cheapest = min(good, key=cost_of(energy), default=None)
    fastest = None
    if time is not None:
        bins = {network["name"]: network["bins"] for network in networks}
        keeping = [point for point in good if point["train"]["step_s"][time] <= bin_s * bins[point["network"]]]
        fastest = min(keeping, key=lambda point: (time_of(time)(point), cost_of(energy)(point)), default=None)
    chosen = {"cheapest": cheapest, "fastest": fastest, "best": best_of(points, energy)}
    return {name: None if point is None else point["number"] for name, point in chosen.items()}


def usual_point(points: Sequence[Json]) -> Json | None:
    """The mapping that others are held against: 8 bits, fewest cores, whole recordings; of the manual graph, if any."""

    def usual(point: Json) -> bool:
        found = tuple(point[name] for name in ("bits", "planes", "groups", "prune", "cores", "window", "fine_tuned"))
        return found == ([8], 1, 1, False, "cores", 100, False)

    own = [point for point in points if usual(point)]
    return next((point for point in own if point["graph"] == "manual"), own[0] if own else None)


def saving(points: Sequence[Json], energy: str) -> Json | None:
    """How much less energy than the usual mapping takes, for at most a point of accuracy.

    Returns
    -------
    dict or None
        ``usual``; ``chosen``, by expectations; ``seen``, by the test split, which is no choice but a description. Each
        with the point's number, how many times less energy it takes by each table, and its test accuracy less the
        usual one's. None where the usual mapping is not in the grid.
    """
    usual = usual_point(points)
    if usual is None:
        return None
    good = [point for point in points if point["expected"] >= usual["expected"] - LOSS - NEAR]
    seen = [point for point in points if point["test"]["accuracy"] >= usual["test"]["accuracy"] - LOSS - NEAR]
    picked = {
        "chosen": min(good, key=cost_of(energy)),
        "seen": min(seen, key=lambda point: float(point["test"]["energy_j"][energy])),
    }
    return {"usual": usual["number"]} | {name: against(point, usual) for name, point in picked.items()}


def against(point: Json, other: Json) -> Json:
    """A point beside another one: ratios of test energy and time, differences of accuracy."""
    test, base = point["test"], other["test"]
    return {
        "point": point["number"],
        "energy": _ratios(base["energy_j"], test["energy_j"]),
        "time": _ratios(base["time_s"], test["time_s"]),
        "accuracy": test["accuracy"] - base["accuracy"],
        "expected": point["expected"] - other["expected"],
    }


def _ratios(base: Mapping[str, float], own: Mapping[str, float]) -> dict[str, float | None]:
    return {name: base[name] / own[name] if own[name] else None for name in own if name in base}
