"""A chart from networks and a grid: measure every configuration, then find fronts and the points to take."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import IntArray, JsonObject
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import NO_GRAPH
from spikeloom.runtime.machines.base import chip_chart
from spikeloom.runtime.report.encode import decode, encode
from spikeloom.runtime.studies.chart import choices
from spikeloom.runtime.studies.chart.choices import Budget
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import Given
from spikeloom.runtime.studies.chart.requests import (
    SPLITS,
    Build,
    Decide,
    Facts,
    Run,
    Storage,
    compile_command,
    run_command,
)
from spikeloom.runtime.studies.chart.results import (
    Chart,
    ChartedData,
    ChartedNetwork,
    ChosenBy,
    Figures,
    Measured,
    Point,
    Refused,
    Tables,
    by_chip,
    share,
)
from spikeloom.runtime.studies.chart.work import Built, Decisions, Ran, RanBoth
from spikeloom.runtime.studies.jobs import Point as Job

Sweep = Callable[[Sequence[Job], str], Mapping[str, Any]]
"""Measures jobs under a heading; their JSON by key."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored:
    """A network in one storage, in all layouts of the grid, and the work that compiles it."""

    network: Given
    storage: Storage
    build: Build
    job: Job

    def named(self, layout: str) -> JsonObject:
        """Fields of a :class:`results.Configuration`."""
        network, storage = self.network, self.storage
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Planned:
    """A netlist on a part of every recording."""

    stored: Stored
    layout: str
    built: Built
    window: int
    job: Job


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
    """Measure a grid and choose.

    Parameters
    ----------
    networks : sequence of Given
        The chip of the first is the one that points are chosen for.
    grid, budgets
        What was asked for.
    splits : mapping of str to Recordings
        ``train`` and ``test``.
    facts : Facts
    energy : str
        Table of prices to choose by.
    command : str
        What to type for the same chart.
    sweep : callable
        Where the work is done.

    Raises
    ------
    OptionError
        If the chip refuses all configurations.
    """
    target = networks[0].target
    times = {name: _times(facts, name) for name in facts.targets}
    by = ChosenBy(energy=energy, time=next(iter(times[target]), None))
    floats = {network.name: _decisions(network, grid, facts) for network in networks}
    stored = [_stored(network, storage, grid, facts) for network in networks for storage in network.storages(grid)]
    first = sweep([*floats.values(), *(each.job for each in stored)], "compiling")
    planned, refused = _plan(stored, first, grid, facts)
    if not any(each.stored.network.target == target for each in planned):
        raise OptionError(f"--grid: {target} refuses all {len(refused)} configurations; the first: {refused[0].why[0]}")
    second = sweep([each.job for each in planned], "measuring")
    labels = {split: splits[split].labels for split in SPLITS}
    decided: dict[str, Decisions] = {name: first[job.key] for name, job in floats.items()}
    ran = [decode(RanBoth, second[each.job.key]) for each in planned]
    points = [
        _point(number, each, both, decided[each.stored.network.name], labels, facts)
        for number, (each, both) in enumerate(zip(planned, ran, strict=True), 1)
    ]
    charted = [_network(network, decided[network.name], labels) for network in networks]
    (own, others), (chosen_of, beside) = by_chip(points, target), by_chip(charted, target)
    own, chosen_of, expected = choices.with_expectations(own, chosen_of)
    others, beside, _ = choices.with_expectations(others, beside)
    own = choices.with_fronts(own, by)
    others = [replace(point, front=dict.fromkeys(own[0].front, False)) for point in others]
    names = [network.name for network in networks]
    report = Chart(
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
        tables=Tables(
            energy={table.name: table.title for chip in facts.targets.values() for table in chip.energy},
            time={name: title for titles in times.values() for name, title in titles.items()},
        ),
        chosen_by=by,
        grid=grid,
        networks=tuple(sorted([*chosen_of, *beside], key=lambda network: names.index(network.name))),
        expected=expected,
        points=tuple(sorted([*own, *others], key=lambda point: point.number)),
        refused=tuple(refused),
        recommended=choices.recommended(own, chosen_of, by, bin_s=facts.data.bin_s),
        saving=choices.saving(own, by),
        budget=choices.pick(own, budgets, by),
        measured=Measured(recordings_per_s={str(n): both.recordings_per_s for n, both in enumerate(ran, 1)}),
    )
    content = {name: value for name, value in encode(report).items() if name not in ("digest", "measured")}
    return replace(report, digest=hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest())


def _times(facts: Facts, target: str) -> dict[str, str]:
    """Titles of what a chip's time is known by."""
    chip, chart = facts.targets[target], chip_chart(target)
    if chart is not None:
        titles: dict[str, str] = chart.times(chip)
        return titles
    return {table.name: table.title for table in chip.time}


# -- work --------------------------------------------------------------------------------------------------------------


def _identity(network: Given) -> JsonObject:
    """What tells a network from others, wherever its file is."""
    about = {"checkpoint": network.sha256, "weights": network.weights, "sees": network.sees}
    return about | {"options": encode(network.source.options())}


def _decisions(network: Given, grid: Grid, facts: Facts) -> Job:
    """Work that finds the decisions of a float network."""
    source = network.source.from_anywhere()
    work = Decide(source=source, sha256=network.sha256, data=facts.data_anywhere, windows=tuple(sorted(grid.window)))
    key = facts.key(network.target, what="float", **_identity(network), windows=work.windows)
    return Job(key=key, label=f"{network.name} float", payload=work)


def _stored(network: Given, storage: Storage, grid: Grid, facts: Facts) -> Stored:
    """A network in a storage, with the work that compiles it."""
    layouts = network.layouts(grid)
    about = _identity(network) | {"storage": storage}
    keys = {layout: facts.key(network.target, what="netlist", **about, layout=layout) for layout in layouts}
    files = {layout: facts.folder.resolve() / "netlists" / f"{key}.loom" for layout, key in keys.items()}
    build = Build(
        source=network.source.from_anywhere(),
        sha256=network.sha256,
        storage=storage,
        files=files,
        data=facts.data_anywhere,
    )
    key = facts.key(network.target, what="build", **about, layouts=layouts)
    job = Job(key=key, label=f"{network.name} {storage.label()}", payload=build)
    return Stored(network=network, storage=storage, build=build, job=job)


def _plan(
    stored: Sequence[Stored], first: Mapping[str, Any], grid: Grid, facts: Facts
) -> tuple[list[Planned], list[Refused]]:
    """What is to be run, and what the chip refuses."""
    planned, refused = [], []
    for each in stored:
        for layout, value in first[each.job.key].items():
            built = decode(Built, value)
            if built.refused:
                refused.append(Refused(**each.named(layout), why=built.refused))
                continue
            for window in grid.window:
                key = facts.key(each.network.target, what="run", netlist=built.sha256, window=window)
                run = Run(build=each.build, layout=layout, sha256=built.sha256, window=window)
                job = Job(key=key, label=f"{each.job.label} {layout} {window}%", payload=run)
                planned.append(Planned(stored=each, layout=layout, built=built, window=window, job=job))
    return planned, refused


# -- results -----------------------------------------------------------------------------------------------------------


def _point(
    number: int, planned: Planned, ran: RanBoth, decided: Decisions, labels: Mapping[str, IntArray], facts: Facts
) -> Point:
    each, built, window = planned.stored, planned.built, str(planned.window)
    compiled, file = compile_command(each.network.name, each.network.source, each.storage, planned.layout, facts.data)
    return Point(
        number=number,
        **each.named(planned.layout),
        window=planned.window,
        n_cores=built.cores,
        neurons=built.neurons,
        synapses=built.synapses,
        netlist=f"netlists/{each.build.files[planned.layout].name}",
        netlist_sha256=built.sha256,
        train=_figures(ran.train, decided["train"][window], labels["train"]),
        test=_figures(ran.test, decided["test"][window], labels["test"]),
        commands=(compiled, run_command(file, planned.window, facts.data)),
    )


def _figures(ran: Ran, decided: Sequence[int], labels: IntArray) -> Figures:
    right = share(_same(ran.decisions, labels.tolist()), len(labels))
    return Figures(
        correct=right.correct,
        accuracy=right.accuracy,
        low=right.low,
        high=right.high,
        samples=len(labels),
        model=share(_same(decided, labels.tolist()), len(labels)),
        equal=_same(ran.decisions, decided),
        energy_j=ran.energy_j,
        time_s=ran.time_s,
        step_s=ran.step_s,
        synaptic_operations=ran.synaptic_operations,
        steps=ran.steps,
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
        has_graph=network.graph != NO_GRAPH,
        weights=network.weights,
        fine_tuned=network.forms is not None,
        trained_by=network.training.get("command"),
        validation=network.validation,
        bins=network.bins,
        model=model,
        float_training=model[max(model, key=int)]["train"].accuracy,
    )
