"""A chart from networks and a grid: measure every configuration, then find fronts and the points to take."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import chip_chart
from spikeloom.runtime.report.encode import decode
from spikeloom.runtime.studies.chart import choices
from spikeloom.runtime.studies.chart.choices import Budget
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import Given
from spikeloom.runtime.studies.chart.results import (
    Chart,
    ChartedData,
    ChartedNetwork,
    ChosenBy,
    Figures,
    Point,
    Refused,
    by_chip,
    share,
)
from spikeloom.runtime.studies.chart.work import SPLITS, Build, Built, Decisions, Facts, Ran, Work, commands

Sweep = Callable[[Sequence[Work], str], Mapping[str, Any]]
"""Measures jobs under a heading; their JSON by key."""


def chart(
    networks: Sequence[Given],
    grid: Grid,
    budgets: Sequence[Budget],
    splits: Mapping[str, Recordings],
    facts: Facts,
    *,
    energy: str,
    command: str,
    sweep: Sweep,
) -> Chart:
    """Measure a grid and choose, by a table of energy, among points of the chip of the first network.

    `command` repeats it; an OptionError says that the chip refuses all configurations.
    """
    target = networks[0].target
    times = {name: _times(facts, name) for name in facts.targets}
    by = ChosenBy(energy=energy, time=next(iter(times[target]), None))
    windows = tuple(sorted(grid.window))
    floats = {network.name: facts.decide(network, windows) for network in networks}
    builds = [
        facts.build(network, storage, network.layouts(grid))
        for network in networks
        for storage in network.storages(grid)
    ]
    first = sweep([*floats.values(), *builds], "compiling")
    built = [(build, layout, decode(Built, found)) for build in builds for layout, found in first[build.key].items()]
    runs = [facts.run(*each, window) for each in built if not each[2].refused for window in grid.window]
    refused = [
        Refused(**_configuration(build, layout), why=found.refused) for build, layout, found in built if found.refused
    ]
    if not any(run.build.network.target == target for run in runs):
        raise OptionError(f"--grid: {target} refuses all {len(refused)} configurations; the first: {refused[0].why[0]}")
    second = sweep(runs, "measuring")
    labels = {split: splits[split].labels for split in SPLITS}
    decided: dict[str, Decisions] = {name: first[job.key] for name, job in floats.items()}
    known = {network.name: network for network in networks}
    points = []
    for number, run in enumerate(runs, 1):
        name, window = run.build.network.name, str(run.window)
        figures = {
            split: _figures(decode(Ran, ran), decided[name][split][window], labels[split])
            for split, ran in second[run.key].items()
        }
        point = Point(
            number=number,
            **_configuration(run.build, run.layout),
            window=run.window,
            n_cores=run.built.cores,
            neurons=run.built.neurons,
            synapses=run.built.synapses,
            netlist=f"netlists/{run.build.files[run.layout].name}",
            netlist_sha256=run.built.sha256,
            train=figures["train"],
            test=figures["test"],
            commands=commands(known[name], run.build.storage, run.layout, run.window, facts.data),
        )
        points.append(point)
    charted = [_network(network, decided[network.name], labels) for network in networks]
    (own, others), (chosen_of, beside) = by_chip(points, target), by_chip(charted, target)
    own, chosen_of, expected = choices.with_expectations(own, chosen_of)
    others, beside, _ = choices.with_expectations(others, beside)
    own = choices.with_fronts(own, by)
    others = [replace(point, front=dict.fromkeys(own[0].front, False)) for point in others]
    names = [network.name for network in networks]
    return Chart(
        spikeloom=__version__,
        target=target,
        command=command,
        data=ChartedData(
            path=facts.data.path,
            bin_s=facts.data.bin_s,
            sha256=str(facts.data.sha256),
            train=len(splits["train"]),
            test=len(splits["test"]),
            steps=splits["test"].steps,
        ),
        tables={
            "energy": {table.name: table.title for chip in facts.targets.values() for table in chip.energy},
            "time": {name: title for titles in times.values() for name, title in titles.items()},
        },
        chosen_by=by,
        grid=grid,
        networks=tuple(sorted([*chosen_of, *beside], key=lambda network: names.index(network.name))),
        expected=expected,
        points=tuple(sorted([*own, *others], key=lambda point: point.number)),
        refused=tuple(refused),
        recommended=choices.recommended(own, chosen_of, by, bin_s=facts.data.bin_s),
        saving=choices.saving(own, by),
        budget=choices.pick(own, budgets, by),
    )


def _times(facts: Facts, target: str) -> dict[str, str]:
    """Titles of what a chip's time is known by."""
    chip, chart = facts.targets[target], chip_chart(target)
    if chart is not None:
        titles: dict[str, str] = chart.times(chip)
        return titles
    return {table.name: table.title for table in chip.time}


# -- results -----------------------------------------------------------------------------------------------------------


def _configuration(build: Build, layout: str) -> JsonObject:
    """Fields of a :class:`results.Configuration`."""
    network, storage = build.network, build.storage
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


def _figures(ran: Ran, decided: Sequence[int], labels: IntArray) -> Figures:
    costs = asdict(ran)
    decisions, right = costs.pop("decisions"), labels.tolist()
    return Figures(
        **asdict(share(_same(ran.decisions, right), len(right))),
        **costs,
        samples=len(right),
        model=share(_same(decided, right), len(right)),
        equal=_same(decisions, decided),
    )


def _same(decisions: Sequence[int], others: Sequence[int]) -> int:
    return sum(a == b for a, b in zip(decisions, others, strict=True))


def _network(network: Given, decided: Decisions, labels: Mapping[str, IntArray]) -> ChartedNetwork:
    model = {
        window: {
            split: share(_same(decided[split][window], labels[split].tolist()), len(labels[split])) for split in SPLITS
        }
        for window in decided["test"]
    }
    return ChartedNetwork(
        name=network.name,
        path=network.source.path,
        target=network.target,
        sha256=network.sha256,
        system=network.system,
        graph=network.graph,
        weights=network.weights,
        fine_tuned=network.forms is not None,
        trained_by=network.training.get("command"),
        validation=network.validation,
        bins=network.bins,
        model=model,
        float_training=model[max(model, key=int)]["train"].accuracy,
    )
