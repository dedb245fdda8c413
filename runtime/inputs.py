"""What a user names on the command line: checkpoints, graphs, recordings, and places to write; checked here."""

from __future__ import annotations

import argparse
import sys
from importlib import resources
from pathlib import Path

import numpy as np

from compiler.errors import DataError, ModelError, OptionError
from compiler.fixedpoint import FloatArray
from compiler.frontends.checkpoint import Checkpoint
from models.events import BIN_S, load_data, need_labels
from models.evtouch import Recordings
from models.graphs import CHOICES, Graph, normalised_adjacency
from models.grasps import synthetic_split
from models.sensors import sensor_graph
from runtime.data_commands import show_counts

PRETRAINED = "pretrained:"
SYNTHETIC = "synthetic"


def shipped(path: str) -> str:
    """Resolve ``pretrained:NAME`` to the file that the package ships.

    Raises
    ------
    OptionError
        If there is no such checkpoint.
    """
    if not path.startswith(PRETRAINED):
        return path
    folder = Path(str(resources.files("models") / "pretrained"))
    known = {file.stem: file for file in sorted(folder.glob("*.pt"), key=lambda file: file.stem)}
    name = path.removeprefix(PRETRAINED)
    if name not in known:
        raise OptionError(f"{path}: no such shipped checkpoint; allowed: {', '.join(PRETRAINED + n for n in known)}")
    return str(known[name])


def recordings(
    path: str,
    split: str,
    *,
    limit: int | None = None,
    classes: int | None,
    taxels: int | None,
    bin_s: float = BIN_S,
    labels_for: str | None = None,
) -> Recordings:
    """Read recordings of any form, or make the package's own synthetic ones; hold both against the network.

    Counts of disorder in event files go to stderr. `labels_for` names what needs the label of every recording.

    Raises
    ------
    DataError, OptionError
        If they cannot be used, or do not suit the network.
    """
    if path != SYNTHETIC:
        data, counts = load_data(path, split, bin_s=bin_s, limit=limit, classes=classes, taxels=taxels)
        show_counts(data, counts)
        if labels_for is not None:
            need_labels(data, labels_for)
        return data
    grasps = synthetic_split(split, limit=limit)
    if taxels is not None and grasps.taxels != taxels:
        raise DataError(
            f"{SYNTHETIC}: has {grasps.taxels} taxels, the network has {taxels}; use recordings of its sensor"
        )
    if classes is not None and grasps.labels.max() >= classes:
        raise DataError(
            f"{SYNTHETIC}: label {grasps.labels.max()}, the network has {classes} classes (0..{classes - 1}); "
            "use the network that was trained on these objects"
        )
    return grasps


def asked_graph(arguments: argparse.Namespace) -> Graph | None:
    """Graph that the options name, or None if they name none; warnings go to stderr.

    Raises
    ------
    OptionError, ModelError
        If there is no such graph, or its files are wrong.
    """
    if not (arguments.graph or arguments.taxels or arguments.edges or arguments.directed):
        return None
    graph, warnings = sensor_graph(
        graph=arguments.graph, taxels=arguments.taxels, edges=arguments.edges, directed=arguments.directed
    )
    sys.stderr.writelines(f"spikeloom: warning: {warning}\n" for warning in warnings)
    return graph


def graph_words(arguments: argparse.Namespace) -> str:
    """Options that name the graph, as they would be typed beside the files."""
    files = {"--taxels": arguments.taxels, "--edges": arguments.edges}
    words = [f"--graph {arguments.graph}"] if arguments.graph else []
    words += [f"{option} {Path(name).name}" for option, name in files.items() if name]
    return " ".join([*words, *(["--directed"] if arguments.directed else [])])


def propagation(checkpoint: Checkpoint, asked: Graph | None, where: str) -> tuple[str, FloatArray]:
    """Name and propagation matrix of the graph that was asked for, or of the one in the checkpoint.

    Raises
    ------
    ModelError
        If no graph is known, or another one than the checkpoint was trained on is asked for.
    """
    if asked is None:
        if checkpoint.edges is None:
            raise ModelError(f"{where}: the graph is not in this file; name it with --graph: {CHOICES}")
        return str(checkpoint.graph), normalised_adjacency(checkpoint.edges, checkpoint.taxels)
    adjacency = normalised_adjacency(asked.edges, asked.n_taxels)
    if checkpoint.edges is not None:
        trained = normalised_adjacency(checkpoint.edges, checkpoint.taxels)
        if not np.array_equal(trained, adjacency):
            raise ModelError(
                f"{where}: graph and weights disagree: it was trained on {checkpoint.graph}, --graph says "
                f"{asked.name}; leave --graph away"
            )
    return asked.name, adjacency


def require_place(path: str, option: str) -> None:
    """Refuse, before any work is done, a place where a result could not be written.

    Raises
    ------
    OptionError
        If the folder does not exist, or the path is a folder or a device.
    """
    place = Path(path)
    if not place.absolute().parent.is_dir():
        raise OptionError(f"{option} {path}: the folder does not exist; make it first")
    if place.exists() and not place.is_file():
        raise OptionError(f"{option} {path}: is not a regular file; give the name of a file to write")
