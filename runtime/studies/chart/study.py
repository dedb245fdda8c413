"""A chart from networks and a grid: measure every configuration, then find fronts and the points to take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.report.encode import decode
from spikeloom.runtime.studies.chart import choices, work
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile
from spikeloom.runtime.studies.chart.results import Chart, ChartedNetwork, ChosenBy, Data, Point, Refused
from spikeloom.runtime.studies.fronts import Budget
from spikeloom.runtime.studies.jobs import sweep

STORE = "points.sqlite"


def chart(
    networks: Sequence[NetworkFile],
    target: Target,
    data: Data,
    grid: Grid,
    budgets: Sequence[Budget],
    folder: Path,
    *,
    energy: str,
    command: str,
    jobs: int | None = None,
    fresh: bool = False,
) -> Chart:
    """Measure a grid, as far as a folder does not hold it, and choose by a table of energy.

    `command` repeats it; an OptionError says that the chip refuses all configurations.
    """
    windows = tuple(sorted(grid.window))
    works = [
        work.measurement(network, storage, grid.cores, windows, data, target, folder)
        for network in networks
        for storage in network.storages(grid)
    ]
    found = sweep(works, work.measure, folder / STORE, jobs=jobs, fresh=fresh, label="measuring")
    measured = [(each, decode(work.Measured, found[each.key])) for each in works]
    points: list[Point] = []
    refused: list[Refused] = []
    for each, (layout, built) in ((each, built) for each, result in measured for built in result.built.items()):
        if built.refused:
            refused.append(Refused(**_configuration(each, layout), why=built.refused))
            continue
        points += [
            Point(
                number=number,
                **_configuration(each, layout),
                window=window,
                n_cores=built.cores,
                neurons=built.neurons,
                synapses=built.synapses,
                netlist=f"netlists/{each.files[layout].name}",
                netlist_sha256=built.sha256,
                train=built.figures[window]["train"],
                test=built.figures[window]["test"],
                commands=work.commands(each, layout, window),
            )
            for number, window in enumerate(grid.window, len(points) + 1)
        ]
    if not points:
        raise OptionError(
            f"--grid: {target.name} refuses all {len(refused)} configurations; the first: {refused[0].why[0]}"
        )
    times = {table.name: table.title for table in target.time}
    by = ChosenBy(energy=energy, time=next(iter(times), None))
    models = {each.network.name: result.model for each, result in measured}
    charted = [ChartedNetwork(file=network, model=models[network.name]) for network in networks]
    points, charted, expected = choices.with_expectations(points, charted)
    points = choices.with_fronts(points, by)
    return Chart(
        spikeloom=__version__,
        target=target.name,
        command=command,
        data=data,
        tables={"energy": {table.name: table.title for table in target.energy}, "time": times},
        chosen_by=by,
        grid=grid,
        networks=tuple(charted),
        expected=expected,
        points=tuple(points),
        refused=tuple(refused),
        recommended=choices.recommended(points, charted, by, bin_s=data.bin_s),
        saving=choices.saving(points, by),
        budget=choices.pick(points, budgets, by),
    )


def _configuration(each: work.Measurement, layout: str) -> JsonObject:
    """Fields of a :class:`results.Configuration`."""
    network, storage = each.network, each.storage
    return {
        "network": network.name,
        "target": network.target,
        "graph": network.graph,
        "bits": storage.bits,
        "planes": storage.planes,
        "groups": storage.groups,
        "prune": storage.prune,
        "fine_tuned": storage.own,
        "storage": storage.label(),
        "cores": layout,
    }
