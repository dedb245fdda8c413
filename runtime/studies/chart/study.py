"""A chart from networks and a grid: measure every configuration, find fronts, and choose which one to deploy.

The *choice* is made on the training split alone; test figures are reported beside. *Fronts* are drawn on the
test split: they describe.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.runtime.studies.chart import work
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile
from spikeloom.runtime.studies.chart.results import Chart, Pick, Point, Refused
from spikeloom.runtime.studies.jobs import sweep
from spikeloom.runtime.studies.search.budgets import Budget, parse_budgets
from spikeloom.runtime.studies.search.choice import NEAR, choose, front
from spikeloom.runtime.studies.search.results import ChosenBy, Data, titles_of

STORE = "points.sqlite"

LOSS = 0.01
"""Accuracy that may be given up for less energy: a point."""


def _point(
    number: int, axes: Mapping[str, Any], measured: work.Measurement, built: work.Built, window: Any
) -> Point:
    """A configuration that the chip holds, run on a share of the recordings."""
    layout = axes["cores"]
    return Point(
        number=number,
        **axes,
        window=window,
        n_cores=built.cores,
        neurons=built.neurons,
        synapses=built.synapses,
        netlist=f"netlists/{measured.files[layout].name}",
        netlist_sha256=built.sha256,
        train=built.figures[window]["train"],
        test=built.figures[window]["test"],
        commands=work.commands(measured, layout, window),
    )


def chart(
    networks: Sequence[NetworkFile],
    target: Target,
    data: Data,
    grid: Grid,
    budgets: Sequence[Budget],
    folder: Path,
    *,
    by: ChosenBy,
    command: str,
    groups: work.Groups,
    jobs: int | None = None,
) -> Chart:
    """Measure a grid, as far as a folder does not hold it, and choose by a table of energy.

    `command` repeats it; an OptionError says that the chip refuses all configurations.
    """
    certify = any(budget.what == "certified" for budget in budgets)
    works = [
        work.measurement(network, storage, grid, data, target, folder, groups, certify=certify)
        for network in networks
        for storage in network.storages(grid)
    ]
    kind = Mapping[str, work.Built]
    own = (folder, folder / "netlists")
    found = sweep(works, work.measure, folder / STORE, jobs=jobs, label="measuring", kind=kind, own=own)
    points: list[Point] = []
    refused: list[Refused] = []
    for each in works:
        for layout, built in found[each.key].items():
            axes: dict[str, Any] = {"network": each.network.name, "stored": each.storage, "cores": layout}
            if built.refused:
                refused.append(Refused(**axes, why=built.refused))
                continue
            for window in grid.window:
                if {"train", "test"} - built.figures.get(window, {}).keys():
                    raise DataError(
                        f"{folder / STORE}: its figures of {each.key} lack a split; give another -o"
                    )
                points.append(_point(len(points) + 1, axes, each, built, window))
    if not points:
        why = f"refuses all {len(refused)} configurations; the first: {refused[0].why[0]}"
        raise OptionError(f"--grid: {target.name} {why}")
    points = with_fronts(with_expectations(points, networks), by)
    return Chart(
        spikeloom=__version__,
        target=target.name,
        command=command,
        data=data,
        tables=titles_of(target),
        chosen_by=by,
        grid=grid,
        networks=tuple(networks),
        points=tuple(points),
        refused=tuple(refused),
        budget=pick(points, budgets, by),
        folder=str(folder),
    )


def with_expectations(points: Sequence[Point], networks: Sequence[NetworkFile]) -> list[Point]:
    """Points with the accuracy that is expected of them.

    That is what the network's training reached on the recordings that it had left out (its validation),
    times the share of the float model's training accuracy that the point keeps. If a checkpoint knows no
    validation, all points have their training accuracy instead.
    """
    reached = {network.name: network.validation for network in networks}
    whole = {
        name: max(
            (point for point in points if point.network == name), key=lambda point: point.window
        ).train.model
        for name in {point.network for point in points}
    }

    def expected(point: Point) -> float:
        if None in reached.values() or not whole[point.network].correct:
            return point.train.accuracy
        return (reached[point.network] or 0.0) * point.train.accuracy / whole[point.network].accuracy

    return [replace(point, expected=expected(point)) for point in points]


def with_fronts(points: Sequence[Point], by: ChosenBy) -> list[Point]:
    """Points that know on which fronts of test accuracy and a cost they are."""
    gains = [point.test.accuracy for point in points]
    costs = [by.of(point.test.costs) for point in points]
    on = {name: front(gains, [each[name] for each in costs]) for name in costs[0]}
    return [
        replace(point, front={name: marks[i] for name, marks in on.items()})
        for i, point in enumerate(points)
    ]


def pick(points: Sequence[Point], budgets: Sequence[Budget], by: ChosenBy) -> Pick:
    """The point to deploy, by training figures.

    It is the cheapest that fits the budgets and is expected to be at most a point less accurate than the
    best that fits; where an accuracy is wanted, the cheapest that fits. If nothing fits, the point that
    misses by the smallest factor.
    """
    choice = choose(points, partial(_values, by=by), _less_accurate, budgets)
    chosen = min(choice.allowed, key=lambda point: point.train.costs.energy_j[by.energy])
    words = tuple(budget.words for budget in budgets)
    return Pick(budgets=words, fits=bool(choice.fitting), fitting=len(choice.fitting), point=chosen.number)


def above_on_test(chart: Chart) -> list[Point]:
    """Points that fit the budgets and whose test intervals lie above the chosen one's: reported, never chosen by."""
    values = partial(_values, by=chart.chosen_by)
    fitting = choose(chart.points, values, _less_accurate, parse_budgets(chart.budget.budgets)).fitting
    return [point for point in fitting if point.test.low > chart.chosen.test.high]


def _values(point: Point, by: ChosenBy) -> dict[str, float]:
    """What budgets limit, on the training split."""
    return by.of(point.train.costs) | {"accuracy": point.expected, "certified": point.train.certified or 0.0}


def _less_accurate(best: Point, other: Point) -> bool:
    return best.expected - other.expected > LOSS + NEAR
