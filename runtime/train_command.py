"""The command ``train``: one system, any number of seeds, reported by both protocols."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from compiler.errors import OptionError
from compiler.frontends.checkpoint import WEIGHTS
from compiler.frontends.systems import GRAPH_SYSTEMS, GRID_CNN, TACTILESGNET, TITLES, Grid
from models.graphs import CHOICES, Graph
from models.grasps import SYNTHETIC
from models.systems import PADDINGS, sensor_grid, taxels_alone
from runtime.inputs import asked_graph, asked_places, graph_words, progress, recordings, require_place, version
from runtime.training import PICTURES, Job, check_seeds, draw_training, output_of, summary, training_text

Json = dict[str, Any]


def train(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command: the report, how to print it, and the exit code."""
    from runtime.seeds import train_seeds  # processes, so only here

    check_seeds(arguments.seeds)
    require_place(arguments.output, "-o", arguments)
    if arguments.picture is not None:
        require_place(arguments.picture, "--picture", arguments)
        if Path(arguments.picture).suffix not in PICTURES:
            raise OptionError(f"--picture {arguments.picture}: allowed are {', '.join(PICTURES)}; name one of these")
    system = arguments.system or TACTILESGNET
    graph, grid = _sensor(arguments, system)
    progress("reading the recordings")
    shared: dict[str, Any] = {"taxels": graph.n_taxels, "bin_s": arguments.bin, "labels_for": "training"}
    training = recordings(arguments.data, "train", classes=None, **shared)
    test = recordings(arguments.data, "test", classes=int(training.labels.max()) + 1, **shared)
    progress("")
    data = arguments.data if arguments.data == SYNTHETIC else training.source
    words = [f"spikeloom train --data {data}", _system_words(arguments, system), graph_words(arguments)]
    command = " ".join(filter(None, [*words, f"--epochs {arguments.epochs}"]))
    keep = tuple(dict.fromkeys(arguments.keep or WEIGHTS))
    jobs = [
        Job(
            training=training,
            test=test,
            graph=graph,
            epochs=arguments.epochs,
            seed=seed,
            device=arguments.device,
            resume=arguments.resume,
            output=output_of(arguments.output, seed, arguments.seeds),
            keep=keep,
            command=f"{command} --seed {seed}",
            facts={"spikeloom": version(), "device": arguments.device},
            draws=arguments.picture is not None,
            position=position,
            system=system,
            grid=grid,
        )
        for position, seed in enumerate(range(arguments.seed, arguments.seed + arguments.seeds))
    ]
    results = train_seeds(jobs, resume=arguments.resume)
    records = [record for record, _ in results]
    if arguments.picture is not None:
        decided = [predicted for _, predicted in results if predicted is not None]
        draw_training(arguments.picture, records, test.labels, decided)
    return {"runs": records, "protocols": summary(records)}, training_text, 0


def _sensor(arguments: argparse.Namespace, system: str) -> tuple[Graph, Grid | None]:
    """Taxels, their graph, and the grid over them, as far as the system has these."""
    if arguments.padding is not None and system != GRID_CNN:
        raise OptionError(f"--padding: is for grid-cnn, {TITLES[system]} has no window; leave it away")
    graph = asked_graph(arguments, system)
    if system not in GRAPH_SYSTEMS:
        places = asked_places(arguments.taxels)
        grid = sensor_grid(places, arguments.padding or PADDINGS[0]) if system == GRID_CNN else None
        return taxels_alone(places), grid
    if graph is None:
        raise OptionError(f"train: no graph; name it with --graph: {CHOICES}, or give --edges")
    return graph, None


def _system_words(arguments: argparse.Namespace, system: str) -> str:
    """Options that name the system, as they would be typed; none for the usual one."""
    words = [] if system == TACTILESGNET else [f"--system {system}"]
    return " ".join([*words, *([f"--padding {arguments.padding}"] if arguments.padding else [])])
