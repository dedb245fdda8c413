"""What a user names on the command line: checkpoints, graphs, recordings, and places to write; checked here."""

from __future__ import annotations

import argparse
import math
import sys
import zipfile
from importlib import resources
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.formats.checkpoint import Checkpoint, read_checkpoint
from spikeloom.compiler.systems import GRAPH_SYSTEMS, TACTILESGNET, TITLES
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.truenorth.native_file import is_trained
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.models.graphs import CHOICES, NEUTOUCH, Graph
from spikeloom.models.recordings.events import BIN_S, MAX_STEPS, joined_bins, load_data, need_labels, require_events
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.found import show_counts
from spikeloom.models.recordings.grasps import SYNTHETIC, synthetic_split
from spikeloom.models.recordings.windows import first_part, window_asked
from spikeloom.models.sensors import read_layout, sensor_graph
from spikeloom.models.systems import NO_GRAPH, grid_cells, propagation_of
from spikeloom.runtime.report.console import progress

_RECORDINGS = "recordings are shown by spikeloom data describe"

PRETRAINED = "pretrained:"


def shipped(path: str) -> str:
    """Resolve ``pretrained:NAME`` to the file that the package ships.

    Raises
    ------
    OptionError
        If there is no such checkpoint.
    """
    if not path.startswith(PRETRAINED):
        return path
    folder = Path(str(resources.files("spikeloom.models") / "pretrained"))
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
    bins: int = 1,
    labels_for: str | None = None,
) -> Recordings:
    """Read recordings of any form, or make the package's own synthetic ones; hold both against the network.

    Counts of disorder in event files go to stderr. `bins` of them make a step of the network. `labels_for` names what
    needs the label of every recording.

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
        return joined_bins(data, bins)
    require_events(SYNTHETIC, bin_s)
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
    return joined_bins(grasps, bins)


def require_bins(bins: int) -> None:
    """Refuse a number of bins to join that is none.

    Raises
    ------
    OptionError
        If it is below 1, or more than a recording may have.
    """
    if not 1 <= bins <= MAX_STEPS:
        raise OptionError(f"--join {bins}: allowed are 1 to {MAX_STEPS}; choose another")


def asked_recordings(
    arguments: argparse.Namespace,
    netlist: Netlist | CrossbarNetlist,
    *,
    labels_for: str | None = None,
    joined: bool = True,
) -> Recordings:
    """Recordings that the options of a command name, held against a netlist; as `recordings` otherwise.

    In steps of the network if `joined`, else in their own bins.
    """
    progress("reading the recordings")
    return recordings(
        arguments.data,
        arguments.split,
        limit=arguments.limit,
        classes=netlist.classes,
        taxels=netlist.taxels,
        bin_s=arguments.bin,
        bins=netlist.bins if joined and isinstance(netlist, Netlist) else 1,
        labels_for=labels_for,
    )


def asked_graph(arguments: argparse.Namespace, system: str = TACTILESGNET) -> Graph | None:
    """Graph that the options name, or None if they name none; warnings go to stderr.

    Raises
    ------
    OptionError, ModelError
        If there is no such graph, its files are wrong, or the system has no graph at all.
    """
    if system not in GRAPH_SYSTEMS:
        for option in ("graph", "edges", "directed"):
            if getattr(arguments, option):
                raise OptionError(f"--{option}: is for taxel graphs, {TITLES[system]} has none; leave it away")
        return None
    if not (arguments.graph or arguments.taxels or arguments.edges or arguments.directed):
        return None
    graph, warnings = sensor_graph(
        graph=arguments.graph, taxels=arguments.taxels, edges=arguments.edges, directed=arguments.directed
    )
    sys.stderr.writelines(f"spikeloom: warning: {warning}\n" for warning in warnings)
    return graph


def asked_places(taxels: str | None) -> FloatArray:
    """Positions of the taxels in millimetres: of ``--taxels``, where a number lines them up, or of the built-in sensor.

    Raises
    ------
    OptionError, DataError
        If there is no such sensor.
    """
    if taxels is None:
        return NEUTOUCH
    count, places = read_layout(taxels)
    return np.arange(float(count))[:, None] if places is None else places


def graph_words(arguments: argparse.Namespace) -> str:
    """Options that name the graph, as they would be typed beside the files."""
    files = {"--taxels": arguments.taxels, "--edges": arguments.edges}
    words = [f"--graph {arguments.graph}"] if arguments.graph else []
    words += [f"{option} {Path(name).name}" for option, name in files.items() if name]
    return " ".join([*words, *(["--directed"] if arguments.directed else [])])


def bin_words(bin_s: float) -> list[str]:
    """Words that ask for a width of a time bin; none for the usual one."""
    return [] if math.isclose(bin_s, BIN_S) else ["--bin", f"{bin_s:g}"]


def propagation(checkpoint: Checkpoint, asked: Graph | None, where: str) -> tuple[str, FloatArray]:
    """Name of the graph that was asked for, or of the one in the checkpoint, and what the first layer sees.

    Raises
    ------
    ModelError
        If no graph is known, or another one than the checkpoint was trained on is asked for.
    """

    def seen(edges: IntArray, taxels: int) -> FloatArray:
        return propagation_of(checkpoint.system, edges, taxels, checkpoint.grid, len(checkpoint.hops))

    if checkpoint.system not in GRAPH_SYSTEMS:
        return NO_GRAPH, seen(np.zeros((0, 2), np.int64), checkpoint.taxels)
    if asked is None:
        if checkpoint.edges is None:
            raise ModelError(f"{where}: the graph is not in this file; name it with --graph: {CHOICES}")
        return str(checkpoint.graph), seen(checkpoint.edges, checkpoint.taxels)
    found = seen(asked.edges, asked.n_taxels)
    if checkpoint.edges is not None and not np.array_equal(seen(checkpoint.edges, checkpoint.taxels), found):
        raise ModelError(
            f"{where}: graph and weights disagree: it was trained on {checkpoint.graph}, --graph says "
            f"{asked.name}; leave --graph away"
        )
    return asked.name, found


INPUTS = ("checkpoint", "original", "against", "netlist", "data", "calibrate", "source", "taxels", "edges", "stress")
"""Arguments that may name a file to read."""


def require_place(path: str, option: str, arguments: argparse.Namespace | None = None) -> None:
    """Refuse, before any work is done, a place where a result could not be written.

    Parameters
    ----------
    path, option : str
        The place, and what names it.
    arguments : Namespace, optional
        Whose `INPUTS` must not be overwritten.

    Raises
    ------
    OptionError
        If the folder does not exist, the path is a folder or a device, or it is one of the inputs.
    """
    place = Path(path)
    if not place.absolute().parent.is_dir():
        raise OptionError(f"{option} {path}: the folder does not exist; make it first")
    if place.exists() and not place.is_file():
        raise OptionError(f"{option} {path}: is not a regular file; give the name of a file to write")
    for name in INPUTS:
        given = getattr(arguments, name, None)
        if isinstance(given, str) and place.exists():
            read = Path(shipped(given))
            if read.exists() and place.samefile(read):
                raise OptionError(f"{option} {path}: is an input of this command ({given}); give another name")


def require_inspectable(path: str) -> None:
    """Refuse what is neither a netlist nor a checkpoint, by what it is instead.

    Raises
    ------
    OptionError
        If it is a folder, or a zip or npz of something else.
    """
    if Path(path).is_dir():
        raise OptionError(f"{path}: is a folder, not a netlist or a checkpoint; {_RECORDINGS}")
    try:
        with zipfile.ZipFile(path) as archive:
            names = {Path(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError, ValueError):
        return  # a released checkpoint is no zip; what else there is, its reader says
    ours = {"manifest.json", "manifest.npy"} & {name.name for name in names}
    torch = any(name.suffix == ".pkl" for name in names)
    if ours or torch or path.endswith(".loom"):
        return
    shown = ", ".join(sorted(name.as_posix() for name in names)[:3]) or "nothing"
    raise OptionError(f"{path}: holds {shown}, not a netlist or a checkpoint; {_RECORDINGS}")


def asked_checkpoint(path: str, arguments: argparse.Namespace) -> Checkpoint:
    """Read a checkpoint as the options say.

    Raises
    ------
    OptionError, ModelError
        If it is not there, or not as they say.
    """
    progress("reading the checkpoint")
    if is_trained(shipped(path)):
        raise ModelError(
            f"{path}: is a network for TrueNorth, which compile, verify, inspect and join take; this is for others"
        )
    places = asked_places(getattr(arguments, "taxels", None))
    return read_checkpoint(
        shipped(path),
        run=arguments.run,
        weights=arguments.weights,
        beta=arguments.beta,
        theta=arguments.theta,
        system=arguments.system,
        cells=grid_cells(places) if places.shape[1] == 2 else None,
    )


def netlist_recordings(arguments: argparse.Namespace, netlist: Netlist, *, labels_for: str | None = None) -> Recordings:
    """Recordings that a netlist can take, as long a part of each as ``--window`` says."""
    percent = window_asked(arguments.window)
    return first_part(asked_recordings(arguments, netlist, labels_for=labels_for), percent)
