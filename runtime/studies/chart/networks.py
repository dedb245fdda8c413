"""The networks of a chart."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spikeloom.compiler import Recipe
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats.archive import is_netlist
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.formats.checkpoint_file import arrays_digest
from spikeloom.compiler.formats.onnx.reader import SUFFIX
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.options import check_recipes
from spikeloom.compiler.targets.loihi1.storage.weight_storage import Form
from spikeloom.compiler.targets.truenorth.native import SYSTEM, highest_level
from spikeloom.compiler.targets.truenorth.native_file import is_trained, read_trained
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.systems import NO_GRAPH
from spikeloom.runtime.inputs.files import PRETRAINED, shipped
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.studies.chart.grid import Grid

Json = dict[str, Any]

COMPARTMENT_CHIP, CROSSBAR_CHIP = "loihi1", "truenorth"
"""Chips of a chart: of checkpoints, and of networks in whole numbers."""

GRAPH_EPOCHS = "60"
"""Of a training on another graph: most best epochs come before."""

LOIHI_AXES = ("bits", "planes", "groups", "prune", "cores")
"""Axes of the grid that networks in whole numbers do not have."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Given:
    """A network of a chart.

    Parameters
    ----------
    path : str
        As typed.
    name : str
        Short, and no other network of the chart has it.
    target : str
        Chip that it is compiled for.
    graph : str
        That it was trained on; ``none`` of systems without.
    words : tuple of str
        Of a ``compile`` command that names the network and nothing else.
    sees : str
        Hash over what its first layer sees.
    sha256, weights, system : str
        Of the file, and what of it is taken.
    taxels, classes : int
    layers : tuple of str
        Names.
    training : mapping
        JSON values, as far as the file knows them.
    forms : tuple of Form, optional
        Storage that it was fine-tuned for.
    levels : int, optional
        Levels of its weights, of a network that was trained in whole numbers.
    bins : int
        Bins of the recordings that a step joins.
    """

    path: str
    name: str
    target: str
    graph: str
    words: tuple[str, ...]
    sees: str
    sha256: str
    weights: str
    system: str
    taxels: int
    classes: int
    layers: tuple[str, ...]
    training: Mapping[str, Any]
    forms: tuple[Form, ...] | None = None
    levels: int | None = None
    bins: int = 1

    @property
    def validation(self) -> float | None:
        """Share of recordings that its training left out and then decided right, where the file says so."""
        found = self.training.get("validation")
        if not isinstance(found, Mapping) or not found.get("samples"):
            return None
        return float(found["correct"] / found["samples"])


def given_networks(arguments: argparse.Namespace, grid: Grid) -> tuple[Given, ...]:
    """Networks of a chart, those of graphs that the grid leaves out not among them.

    Parameters
    ----------
    arguments : Namespace
        ``checkpoints``, ``data`` and the options of :func:`options.add_model`.
    grid : Grid
        Whose graphs choose.

    Raises
    ------
    OptionError, ModelError
        If a checkpoint cannot be used, is given twice, or a graph has none.
    """
    paths: list[str] = arguments.checkpoints
    for path in paths:
        if paths.count(path) > 1:
            raise OptionError(f"{path}: is given twice; give each checkpoint once")
    read = [_read(path, arguments) for path in paths]
    for graph in grid.graph:
        if all(_plain(graph) != _plain(own.graph) for own in read):
            raise _untrained(graph, read, arguments.data)
    if grid.graph:
        wanted = [_plain(graph) for graph in grid.graph]
        read = [own for own in read if _plain(own.graph) in wanted]
    return _named(read)


def _read(path: str, arguments: argparse.Namespace) -> Given:
    if path.endswith(SUFFIX):
        raise ModelError(f"{path}: is an ONNX file, a chart takes checkpoints; give the checkpoint that it was made of")
    file = shipped(path)
    if Path(file).is_file() and is_trained(file):
        return _read_native(path, arguments)
    if Path(file).is_file() and is_netlist(file):
        raise ModelError(f"{path}: is a netlist, a chart compiles its own; give the checkpoint that it was made from")
    checkpoint = load_checkpoint(path, arguments)
    own = argparse.Namespace(**vars(arguments))
    if checkpoint.edges is not None:  # one that knows its graph needs no option; others of the same call may
        own.graph, own.edges, own.directed = None, None, False
    graph, sees = propagation(checkpoint, load_graph(own, checkpoint.system), path)
    return Given(
        path=path,
        name=Path(path.removeprefix(PRETRAINED)).stem,
        target=COMPARTMENT_CHIP,
        graph=graph,
        words=("compile", path, *_model_words(own, checkpoint)),
        sees=arrays_digest({"propagation": sees}),
        sha256=checkpoint.sha256,
        weights=checkpoint.weights,
        system=checkpoint.system,
        taxels=checkpoint.taxels,
        classes=checkpoint.classes,
        layers=tuple(checkpoint.neurons),
        training=checkpoint.training or {},
        forms=checkpoint.forms,
        bins=checkpoint.bins,
    )


def _read_native(path: str, arguments: argparse.Namespace) -> Given:
    """A network that was trained for TrueNorth, which says everything but its weights itself."""
    trained = read_trained(shipped(path), weights=arguments.weights)
    network = trained.network
    weights = ("--weights", arguments.weights) if arguments.weights else ()
    return Given(
        path=path,
        name=Path(path.removeprefix(PRETRAINED)).stem,
        target=CROSSBAR_CHIP,
        graph=trained.graph,
        words=("compile", path, *weights, "--target", CROSSBAR_CHIP),
        sees="",
        sha256=trained.sha256,
        weights=trained.weights,
        system=SYSTEM,
        taxels=network.taxels,
        classes=network.classes,
        layers=tuple(network.neurons),
        training=trained.training,
        levels=2 * highest_level(network.copies) + 1,
    )


def _model_words(arguments: argparse.Namespace, checkpoint: Checkpoint) -> tuple[str, ...]:
    """Options that say how a checkpoint is read."""
    given = {name: getattr(arguments, name) for name in ("graph", "taxels", "edges", "system", "weights")}
    given |= {"beta": arguments.beta, "theta": arguments.theta, "run": arguments.run or None}
    if checkpoint.edges is not None:
        given["taxels"] = None
    words = [word for name, value in given.items() if value is not None for word in (f"--{name}", str(value))]
    return (*words, *(["--directed"] if arguments.directed else []))


def _plain(graph: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "", graph)


def _untrained(graph: str, there: Sequence[Given], data: str) -> OptionError:
    """Error of a graph that no checkpoint was trained on; says which command trains one."""
    command = ["spikeloom", "train", "--data", data, "--graph", graph, "--epochs", GRAPH_EPOCHS]
    command += ["--join", str(there[0].bins)] if there[0].bins > 1 else []
    others = ", ".join(dict.fromkeys(own.graph for own in there))
    return OptionError(
        f"--grid graph={graph}: no checkpoint was trained on that graph, those given on {others}; train one and "
        f"name it: {shlex.join([*command, '-o', f'{_plain(graph)}.pt'])}"
    )


def _named(read: Sequence[Given]) -> tuple[Given, ...]:
    """Networks with names of their own: files of one name in different folders are counted."""
    found: dict[str, Given] = {}
    for own in read:
        name, again = own.name, 1
        while name in found:
            again += 1
            name = f"{own.name}-{again}"
        found[name] = replace(own, name=name)
    return tuple(found.values())


def require_suited(networks: Sequence[Given], splits: Mapping[str, Recordings], digest: str) -> None:
    """Refuse networks that do not belong together, or were trained on other recordings.

    Parameters
    ----------
    networks : sequence of Given
        Of the chart.
    splits : mapping of str to Recordings
        Its data, by split.
    digest : str
        Hash over both, as trainings note it.

    Raises
    ------
    ModelError
        Naming both.
    """
    first = networks[0]
    for own in networks:
        sizes = [(each.taxels, each.classes) for each in (first, own)]
        if sizes[0] != sizes[1]:
            raise ModelError(
                f"{own.path}: has {sizes[1][0]} taxels and {sizes[1][1]} classes, {first.path} has {sizes[0][0]} and "
                f"{sizes[0][1]}; chart networks of one data set at a time"
            )
        made = own.training.get("data_sha256")
        if made not in (None, digest):
            told = own.training.get("data", "others")
            raise ModelError(
                f"{own.path}: was trained on other recordings ({told}) than {splits['test'].source}; give those, or a "
                "checkpoint that was trained on these"
            )


def require_grid(networks: Sequence[Given], grid: Grid, target: Target) -> None:
    """Refuse widths and layouts by layer that do not suit a network's layers, and those that no network has.

    Raises
    ------
    OptionError
        Naming the network, or the axis.
    """
    if all(own.levels is not None for own in networks):
        axes = [axis for axis in LOIHI_AXES if getattr(grid, axis) != getattr(Grid(), axis)]
        if axes:
            raise OptionError(
                f"--grid {axes[0]}: is for {COMPARTMENT_CHIP}, networks for {CROSSBAR_CHIP} have a storage and a "
                "layout of their own; leave it away"
            )
    for own in networks:
        if own.levels is not None:
            continue
        for bits in grid.bits if own.forms is None else ():
            if len(bits) not in (1, len(own.layers)):
                raise OptionError(
                    f"--grid bits={'+'.join(map(str, bits))}: {len(bits)} widths, {own.path} has {len(own.layers)} "
                    f"layers ({', '.join(own.layers)}); give one width, or one for each layer"
                )
            check_recipes([Recipe(bits=width) for width in bits], len(own.layers), target)
        for layout in grid.cores:
            for part in layout.split("+") if ":" in layout else ():
                layer = part.partition(":")[0]
                if layer not in own.layers:
                    raise OptionError(
                        f"--grid cores={layout}: {own.path} has no layer {layer}; it has {', '.join(own.layers)}"
                    )


def network_json(own: Given) -> Json:
    """A network for the chart's files."""
    return {
        "name": own.name,
        "path": own.path,
        "target": own.target,
        "sha256": own.sha256,
        "system": own.system,
        "graph": own.graph,
        "has_graph": own.graph != NO_GRAPH,
        "weights": own.weights,
        "fine_tuned": own.forms is not None,
        "trained_by": own.training.get("command"),
        "validation": own.validation,
        "bins": own.bins,
    }
