"""The command ``chart``: accuracy against energy, time and size, for every configuration of a grid."""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from spikeloom import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.targets.base import CROSSBARS, Target, load_target
from spikeloom.runtime.commands.options import DATA_HELP, add_bin_option, add_model
from spikeloom.runtime.inputs.recordings import bin_words
from spikeloom.runtime.machines.truenorth.charted import time_title
from spikeloom.runtime.machines.truenorth.machine import TICK
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.studies import jobs as sweep
from spikeloom.runtime.studies.chart import networks as chart_networks
from spikeloom.runtime.studies.chart import plan as chart_plan
from spikeloom.runtime.studies.chart import points as chart_points
from spikeloom.runtime.studies.chart.budget import Budget, parse_budgets, pick
from spikeloom.runtime.studies.chart.grid import Grid, parse_grid
from spikeloom.runtime.studies.chart.networks import Given
from spikeloom.runtime.studies.chart.plan import Facts, Stored
from spikeloom.runtime.studies.chart.tasks import FORMAT, SPLITS, Data
from spikeloom.runtime.studies.chart.text import chart_text, csv_text

Json = dict[str, Any]

KIND = "chart"
STORE = "points.sqlite"

NOTES = """\
Axes of the grid: bits (2-6, 8, or one a layer as in 8+4+4+8), planes (1-3), groups (1-8), prune (0, 1), cores (cores,
energy, latency, or LAYER:N as in fc1:6+conv1:4), window (per cent of each recording, 25-100% is every quarter,
25-100%:5 every twentieth), graph (that a network was trained on: of those given, or shipped ones beside them). Choices
are made on the training split, the test split is reported. A chart that was interrupted goes on with the same command;
netlists and figures are kept in FOLDER. Networks that were trained for TrueNorth stand beside those for Loihi, by their
own prices: fronts and choices are among the points of the chip of the first network. The exit code is 1 if no point
fits a budget.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("checkpoints", nargs="+", metavar="CKPT", help="trained networks of one data set")
    add_model(parser)
    parser.add_argument("--data", required=True, metavar="PATH", help=DATA_HELP)
    add_bin_option(parser)
    parser.add_argument(
        "--grid",
        metavar="AXIS=V,V,…",
        help="configurations, as in bits=2-6,8,planes=1-2,window=25-100%% (default: bits=2-6,8,window=25-100%%)",
    )
    parser.add_argument(
        "--budget",
        action="append",
        default=[],
        metavar="WHAT=LIMIT",
        help="pick a point: energy=0.1mJ, latency=5ms or accuracy=88; may be repeated, all of them hold",
    )
    parser.add_argument("--table", metavar="NAME", help="energy table to choose and draw by (default: the first)")
    sweep.add_sweep_arguments(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command; exit code 1 if no point fits a budget.

    Raises
    ------
    SpikeloomError
        If an option, a checkpoint, the recordings or the folder's store cannot be used.
    KeyboardInterrupt
        On an interrupt; its text says what is kept.
    """
    from spikeloom.models.training.protocols import (
        data_digest,  # torch, and the engine: no other command waits for them
    )
    from spikeloom.runtime.studies.chart.work import both_splits

    stores = load_target(chart_networks.COMPARTMENT_CHIP)
    grid = Grid() if arguments.grid is None else parse_grid(arguments.grid, stores)
    budgets = parse_budgets(arguments.budget)
    folder = _folder(arguments.output)
    networks = chart_networks.given_networks(arguments, grid)
    targets = {network.target: _chip(network.target) for network in networks}
    target = targets[networks[0].target]
    tables = [table.name for table in target.energy]
    energy = tables[0] if arguments.table is None else arguments.table
    if energy not in tables:
        raise OptionError(f"--table {energy}: {target.title} has no such energy table; give {' or '.join(tables)}")
    data = Data(path=arguments.data, bin_s=arguments.bin)
    progress("reading the recordings")
    splits = both_splits(data, networks[0].taxels, networks[0].classes)
    digest = data_digest(splits["train"], splits["test"])
    chart_networks.require_suited(networks, splits, digest)
    chart_networks.require_grid(networks, grid, stores)
    facts = Facts(data=data, data_sha256=digest, targets=targets, folder=folder)
    folder.mkdir(exist_ok=True)
    points, refused, decided, rates = _measured(arguments, networks, grid, facts)
    labels = {split: splits[split].labels.tolist() for split in SPLITS}
    report = _report(networks, grid, facts, decided, labels, energy)
    report["command"] = _command(arguments)
    report["data"] |= {split: len(splits[split]) for split in SPLITS} | {"steps": splits["test"].steps}
    _conclude(report, points, refused, budgets, decided, labels)
    report["digest"] = hashlib.sha256(json.dumps(report, sort_keys=True).encode()).hexdigest()
    report["measured"] = {"recordings_per_s": rates}
    write_chart(folder, report)
    return report, lambda found: chart_text(found, str(folder)), _code(report)


def _chip(name: str) -> Target:
    return load_target(name, CROSSBARS) if name == chart_networks.CROSSBAR_CHIP else load_target(name)


def _code(report: Json) -> int:
    return 1 if report["budget"] is not None and not report["budget"]["fits"] else 0


def _command(arguments: argparse.Namespace) -> str:
    """The words that ask for the same chart."""
    words = ["spikeloom", "chart", *arguments.checkpoints, "--data", arguments.data]
    names = ("graph", "taxels", "edges", "system", "weights", "beta", "theta", "grid", "table")
    words += [
        word for name in names if (value := getattr(arguments, name)) is not None for word in (f"--{name}", str(value))
    ]
    words += ["--directed"] if arguments.directed else []
    words += ["--run", str(arguments.run)] if arguments.run else []
    words += bin_words(arguments.bin)
    words += [word for budget in arguments.budget for word in ("--budget", budget)]
    return shlex.join([*words, "-o", arguments.output])


def _folder(words: str) -> Path:
    """Folder of the chart.

    Raises
    ------
    OptionError
        If there cannot be one.
    """
    folder = Path(words)
    if folder.exists() and not folder.is_dir():
        raise OptionError(f"-o {words}: is not a folder; give the name of one")
    if not folder.absolute().parent.is_dir():
        raise OptionError(f"-o {words}: the folder that it shall be in does not exist; make it first")
    return folder


Measured = tuple[list[Json], list[Json], dict[str, Json], dict[str, float]]


def _measured(arguments: argparse.Namespace, networks: Sequence[Given], grid: Grid, facts: Facts) -> Measured:
    """Points, configurations that the chip refuses, float decisions by network, and simulated recordings a second."""
    stored = chart_plan.stored_networks(networks, grid, facts)
    floats = {network.name: chart_plan.decisions(network, grid, facts) for network in networks}
    first = _sweep(arguments, facts, [*floats.values(), *(each.point() for each in stored)], "compiling")
    planned: list[tuple[Stored, str, Json, int, sweep.Point]] = []
    refused = []
    for each in stored:
        for layout, found in first[each.key].items():
            if "refused" in found:
                refused.append(_named(each, layout) | {"why": found["refused"]})
                continue
            runs = chart_plan.runs(each, layout, found["sha256"], grid, facts)
            planned += [(each, layout, found, window, point) for window, point in runs.items()]
    if not planned:
        raise OptionError(
            f"--grid: the chip refuses all {len(refused)} configurations; the first: {refused[0]['why'][0]}"
        )
    second = _sweep(arguments, facts, [point for *_, point in planned], "measuring")
    points, rates = [], {}
    for number, (each, layout, found, window, point) in enumerate(planned, 1):
        ran = second[point.key]
        points.append(
            {"number": number}
            | _named(each, layout)
            | {"window": window, "n_cores": found["cores"], "neurons": found["neurons"], "synapses": found["synapses"]}
            | {"netlist": f"netlists/{each.build.files[layout].name}", "netlist_sha256": found["sha256"]}
            | {split: ran[split] for split in SPLITS}
            | {"commands": chart_plan.commands(each, layout, window, facts)}
        )
        rates[str(number)] = ran["recordings_per_s"]
    return points, refused, {name: first[point.key] for name, point in floats.items()}, rates


def _sweep(arguments: argparse.Namespace, facts: Facts, points: Sequence[sweep.Point], label: str) -> dict[str, Json]:
    from spikeloom.runtime.studies.chart import work as chart_work

    return sweep.sweep(
        points,
        chart_work.measure,
        facts.folder / STORE,
        kind=KIND,
        version=FORMAT,
        jobs=arguments.jobs,
        scheduler=arguments.scheduler,
        fresh=arguments.fresh
        and label == "compiling",  # what the first half found is not to be forgotten by the second
        label=label,
    )


def _named(each: Stored, layout: str) -> Json:
    """What a configuration is, by the axes of the grid."""
    storage = each.storage
    return {
        "network": each.network.name,
        "target": each.network.target,
        "graph": each.network.graph,
        "bits": list(storage.bits),
        "planes": storage.planes,
        "groups": storage.groups,
        "prune": storage.prune,
        "fine_tuned": storage.own,
        "storage": storage.label(),
        "cores": layout,
    }


def _report(
    networks: Sequence[Given],
    grid: Grid,
    facts: Facts,
    decided: Mapping[str, Json],
    labels: Mapping[str, list[int]],
    energy: str,
) -> Json:
    """All but the points and what follows from them."""
    target = facts.targets[networks[0].target]
    times = {chip.name: _times(chip) for chip in facts.targets.values()}
    described = []
    for network in networks:
        windows = {
            window: {split: _right(decided[network.name][split][window], labels[split]) for split in SPLITS}
            for window in decided[network.name]["test"]
        }
        described.append(chart_networks.network_json(network) | {"float": windows})
    return {
        "format": FORMAT,
        "spikeloom": __version__,
        "target": target.name,
        "data": {"path": facts.data.path, "bin_s": facts.data.bin_s, "sha256": facts.data_sha256},
        "tables": {
            "energy": {table.name: table.title for chip in facts.targets.values() for table in chip.energy},
            "time": {name: title for found in times.values() for name, title in found.items()},
        },
        "chosen_by": {"energy": energy, "time": next(iter(times[target.name]), None)},
        "grid": {name: list(getattr(grid, name)) for name in Grid.__slots__},
        "networks": described,
    }


def _times(chip: Target) -> dict[str, str]:
    """Titles of what a chip's time is known by."""
    if chip.cores == CROSSBARS:
        return {TICK: time_title(chip)}
    return {table.name: table.title for table in chip.time}


def _right(decisions: Sequence[int], labels: Sequence[int]) -> Json:
    return chart_points.share(sum(a == b for a, b in zip(decisions, labels, strict=True)), len(labels))


def _conclude(
    report: Json,
    points: list[Json],
    refused: list[Json],
    budgets: Sequence[Budget],
    decided: Mapping[str, Json],
    labels: Mapping[str, list[int]],
) -> None:
    """Figures of the points, fronts and choices; into the report."""
    energy, time = report["chosen_by"]["energy"], report["chosen_by"]["time"]
    for point in points:
        model = decided[point["network"]]
        for split in SPLITS:
            point[split] = chart_points.figures(point[split], model[split][str(point["window"])], labels[split])
    for network in report["networks"]:
        network["float_training"] = _whole(decided[network["name"]], labels)
    networks = report["networks"]
    own, others = chart_points.by_chip(points, report["target"])
    chosen_of, beside = chart_points.by_chip(networks, report["target"])
    if not own:
        raise OptionError(f"--grid: {report['target']} refuses all configurations; the first: {refused[0]['why'][0]}")
    report["expected"] = chart_points.with_expectations(own, chosen_of)
    chart_points.with_expectations(others, beside)
    chart_points.with_fronts(own, energy, time)
    for point in others:
        point["front"] = dict.fromkeys(own[0]["front"], False)
    bin_s = report["data"]["bin_s"]
    report |= {
        "points": points,
        "refused": refused,
        "recommended": chart_points.recommended(own, chosen_of, energy=energy, time=time, bin_s=bin_s),
        "saving": chart_points.saving(own, energy),
        "budget": pick(own, budgets, energy=energy, time=time),
    }


def _whole(decided: Json, labels: Mapping[str, list[int]]) -> float:
    """Share of training recordings that a float model decides right when all of each has passed."""
    longest = max(decided["train"], key=int)
    return float(_right(decided["train"][longest], labels["train"])["accuracy"])


def write_chart(folder: Path, report: Json) -> None:
    """Write the files of a chart: data, pictures and page."""
    from spikeloom.runtime.studies.chart.page import chart_page
    from spikeloom.runtime.studies.chart.picture import pictures

    files = {
        "chart.json": (json.dumps(report, indent=1, allow_nan=False) + "\n").encode(),
        "chart.csv": csv_text(report).encode(),
        "chart.html": chart_page(report).encode(),
        **pictures(report),
    }
    for name, content in files.items():
        with write_atomically(folder / name) as file:
            file.write(content)
