"""A checkpoint on the graph that the options name."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import COUNTERS, FORMATS, TRAINED, is_netlist, stated
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, SpikeloomError
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET, TITLES
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import CHOICES, NEUTOUCH, Graph
from spikeloom.models.sensors import read_layout, sensor_graph
from spikeloom.models.systems import NO_GRAPH, propagation_of
from spikeloom.runtime.inputs.files import is_recordings, shipped
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.report.console import progress, tell
from spikeloom.runtime.requests.choices import CheckpointChoice, SensorChoice


def graph_of(checkpoint: Checkpoint, request: CheckpointChoice, made: Mapping[str, Any]) -> Graph | None:
    """Graph that the options name, or the one that a netlist was compiled for, if it is built in; None for neither."""
    named = load_graph(request, checkpoint.system)
    if named is not None or checkpoint.edges is not None or not isinstance(made.get("graph"), str):
        return named
    try:
        return load_graph(replace(request, graph=made["graph"]), checkpoint.system)
    except SpikeloomError:
        return None  # one of the user's own


def load_graph(request: SensorChoice, system: str = TACTILESGNET) -> Graph | None:
    """Graph that the options name, or None if they name none; a warning goes to stderr.

    Raises OptionError or ModelError if there is no such graph, its files are wrong, or the system has no
    graph at all.
    """
    if system not in GRAPH_SYSTEMS:
        refuse(request, ("graph", "edges", "directed"), f"is for taxel graphs, {TITLES[system]} has none")
        return None
    if not (request.graph or request.taxels or request.edges or request.directed):
        return None
    graph, warning = sensor_graph(
        graph=request.graph, taxels=request.taxels, edges=request.edges, directed=request.directed
    )
    if warning is not None:
        tell(f"warning: {warning}")
    return graph


def sensor_places(taxels: str | None) -> FloatArray:
    """Positions of the taxels in millimetres: of ``--taxels``, where a number lines them up, or of the built-in sensor.

    Raises OptionError or DataError if there is no such sensor.
    """
    if taxels is None:
        return NEUTOUCH
    count, places = read_layout(taxels)
    return np.arange(float(count))[:, None] if places is None else places


def given_places(taxels: str | None) -> list[list[float]] | None:
    """Positions that ``--taxels`` gives, for the record of a training; None where it gives none."""
    places = None if taxels is None else read_layout(taxels)[1]
    return None if places is None else places.tolist()


def places_of(taxels: str | None, origin: Mapping[str, Any], count: int) -> FloatArray | None:
    """Positions (count, 2 or 3) in millimetres: of ``--taxels``, of the training, of the built-in sensor, or None."""
    if taxels is not None:
        return read_layout(taxels)[1]
    if "positions_mm" not in origin:
        return NEUTOUCH if count == len(NEUTOUCH) else None
    with suppress(ValueError, TypeError, OverflowError):  # of a file that says something else
        known = np.array(origin["positions_mm"], np.float64)
        if known.shape in ((count, 2), (count, 3)) and np.isfinite(known).all():
            return known
    return None


def propagation(checkpoint: Checkpoint, asked: Graph | None, where: str) -> tuple[str, FloatArray]:
    """Name of the graph that was asked for, or of the one in the checkpoint, and what the first layer sees.

    Raises ModelError if no graph is known, or another one than the checkpoint was trained on is asked for.
    """

    def seen(edges: IntArray, taxels: int) -> FloatArray:
        return propagation_of(checkpoint.system, edges, taxels, checkpoint.grid, len(checkpoint.hops))

    if checkpoint.system not in GRAPH_SYSTEMS:
        return NO_GRAPH, seen(np.zeros((0, 2), np.int64), checkpoint.taxels)
    if asked is None:
        if checkpoint.edges is None:
            raise ModelError(f"{where}: the graph is not in this file; name it with --graph: {CHOICES}")
        return str(checkpoint.graph), seen(checkpoint.edges, checkpoint.taxels)
    sees = seen(asked.edges, asked.n_taxels)
    if checkpoint.edges is not None and not np.array_equal(seen(checkpoint.edges, checkpoint.taxels), sees):
        raise ModelError(
            f"{where}: graph and weights disagree: it was trained on {checkpoint.graph}, --graph says "
            f"{asked.name}; omit --graph"
        )
    return asked.name, sees


def load_checkpoint(path: str, request: CheckpointChoice) -> Checkpoint:
    """Read a checkpoint as the options say; OptionError or ModelError if it is not there, or not as they say."""
    progress("reading the checkpoint")
    if (kind := stated(Path(shipped(path)), "format")) in (TRAINED, COUNTERS):
        raise ModelError(f"{path}: is {FORMATS[kind]}; only compile, verify and inspect take one")
    if Path(shipped(path)).is_file() and is_netlist(shipped(path)):
        raise ModelError(
            f"{path}: is a netlist, its weights are rounded; give the checkpoint that it was made from"
        )
    if is_recordings(path):
        raise ModelError(
            f"{path}: holds recordings; give the network here, and these as --calibrate or --data"
        )
    return read_checkpoint(
        shipped(path), run=request.run, weights=request.weights, beta=request.beta, theta=request.theta
    )
