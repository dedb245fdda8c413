"""What the page shows beside a single recording: decisions, cores and their traffic, taxels, and where all is from."""

from __future__ import annotations

import argparse
import hashlib
import platform
import shlex
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.fixedpoint import FloatArray, IntArray
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_of_core, chip_tiles
from spikeloom.compiler.targets.loihi1.layout.core_graph import core_map
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.version import __version__
from spikeloom.models.graphs import NEUTOUCH
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.inputs.network import LoadedNetwork, sensor_places
from spikeloom.runtime.machines.loihi1.trace import Counts

Json = dict[str, Any]

FILLS = ("core.compartments", "core.synapse_words", "core.axons_in", "core.axons_out")
"""Limits of which the fullest says how full a core is: those that a larger network uses up."""

PACKAGES = ("numpy", "scipy", "torch", "numba", "networkx")
"""Packages whose versions may move a float spike."""


# -- decisions ---------------------------------------------------------------------------------------------------------


def decisions_json(verdict: Verdict, classes: int) -> Json:
    """Confusion matrices of both sides, and every recording's decisions.

    Returns
    -------
    dict
        ``matrices``: by side, rows are labels and columns decisions.
    """

    def matrix(decided: IntArray) -> list[list[int]]:
        counts = np.zeros((classes, classes), np.int64)
        np.add.at(counts, (verdict.labels, decided), 1)
        rows: list[list[int]] = counts.tolist()
        return rows

    return {
        "classes": classes,
        "matrices": {"float": matrix(verdict.float_predictions), "chip": matrix(verdict.chip_predictions)},
        "files": list(verdict.files),
        "labels": verdict.labels.tolist(),
        "float": verdict.float_predictions.tolist(),
        "chip": verdict.chip_predictions.tolist(),
    }


# -- cores -------------------------------------------------------------------------------------------------------------


def cores_json(netlist: Netlist, target: Target, counts: Counts) -> Json:
    """Where the cores lie, how full each is of everything, and who sends how much to whom.

    Parameters
    ----------
    netlist, target : Netlist, Target
        What ran, on which chip.
    counts : Counts
        Of a batch of recordings; traffic is that of the mean one.
    """
    width, chip = target.limit("mesh.width"), chip_of_core(netlist.core_tile, target)
    fill: dict[int, dict[str, Json]] = {core: {} for core in range(netlist.n_cores)}
    for use in measure(netlist, target):
        if use.core is not None and use.allowed:
            fill[use.core][use.name] = {"used": use.used, "allowed": use.allowed, "share": use.used / use.allowed}
    graph = core_map(netlist, target)
    cores = []
    for core, tile in enumerate(netlist.core_tile.tolist()):
        y, x = divmod(tile % chip_tiles(target), width)
        fullest = max(FILLS, key=lambda name: fill[core][name]["share"])
        place = {"core": core, "chip": int(chip[core]), "tile": tile, "x": x, "y": y}
        held = {"layers": list(graph.nodes[core]["layers"]), "compartments": graph.nodes[core]["compartments"]}
        cores.append(place | held | {"fullest": fullest, "fill": fill[core]})
    packets = _packets(netlist, counts)
    traffic = [
        {
            "from": None if pre == "input" else pre,
            "to": post,
            "packets": float(packets[-1 if pre == "input" else pre, post]),
            "axons": edge["axons"],
            "hops": edge["hops"],
        }
        for pre, post, edge in graph.edges(data=True)
    ]
    traffic.sort(key=lambda way: (-1 if way["from"] is None else way["from"], way["to"]))
    mesh = {"width": width, "height": target.limit("mesh.height"), "tile_cores": target.limit("mesh.tile_cores")}
    return {"mesh": mesh, "cores": cores, "traffic": traffic}


def _packets(netlist: Netlist, counts: Counts) -> FloatArray:
    """Packets of a mean recording from each core, and in the last row from the input, to each core."""
    fired = np.concatenate([counts.inputs, counts.spikes], axis=1).mean(axis=0)
    home = np.append(np.full(netlist.n_inputs, netlist.n_cores), netlist.core_of_compartment())
    packets = np.zeros((netlist.n_cores + 1, netlist.n_cores))
    np.add.at(packets, (home[netlist.axon_source], netlist.core_of_axon()), fired[netlist.axon_source])
    return packets


# -- taxels ------------------------------------------------------------------------------------------------------------


def taxels_json(netlist: Netlist, asked: LoadedNetwork, data: Recordings, counts: Counts, taxels: str | None) -> Json:
    """Taxels, the graph over them where there is one, and what each sends and its neurons fire in a mean recording.

    Parameters
    ----------
    netlist, asked : Netlist, LoadedNetwork
        What ran on the chip, and the float model.
    data : Recordings
        What was run.
    counts : Counts
        Of the chip on all of it.
    taxels : str or None
        The sensor that the user named.
    """
    places = sensor_places(taxels)
    known = len(places) == netlist.taxels and places.shape[1] > 1
    events: IntArray = data.events.sum(axis=(2, 3), dtype=np.int64)
    checkpoint = asked.checkpoint
    edges: IntArray = np.zeros((0, 2), np.int64)
    spikes: FloatArray | None = None
    has_graph = checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS
    if checkpoint is not None and asked.adjacency is not None and has_graph:
        seen = asked.adjacency.reshape(-1, netlist.taxels, netlist.taxels)[0]
        target, source = np.nonzero(seen)
        edges = np.stack([source, target], axis=1)[source != target]
        ids = netlist.compartments_of(0)
        taxel = netlist.neuron[ids] // checkpoint.hops.shape[1]  # those of clocks come after the last
        fired = np.bincount(taxel, counts.spikes[:, ids].mean(axis=0), netlist.taxels)
        spikes = fired[: netlist.taxels].astype(np.float64)
    return {
        "sensor": "NeuTouch" if taxels is None and known and np.array_equal(places, NEUTOUCH) else None,
        "positions_mm": places[:, :2].tolist() if known else None,
        "graph": asked.graph if has_graph else None,
        "edges": edges.tolist(),
        "events": events.mean(axis=0).tolist(),
        "layer": netlist.layers[0].name,
        "spikes": None if spikes is None else spikes.tolist(),
    }


# -- where it is from --------------------------------------------------------------------------------------------------


def provenance_json(
    arguments: argparse.Namespace,
    netlist: Netlist,
    target: Target,
    asked: LoadedNetwork,
    data: Recordings,
    recording: str,
) -> Json:
    """Files and their hashes, versions, seeds and options, and the commands that repeat the page.

    File names are those of the files, without their folders; the page is always called ``report.html``.
    """
    checkpoint = asked.checkpoint
    digest = hashlib.sha256()
    for name, array in data.identity().items():
        digest.update(f"{name} {array.shape} {array.dtype.str}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return {
        "netlist": {
            "file": Path(arguments.netlist).name,
            "sha256": hashlib.sha256(Path(arguments.netlist).read_bytes()).hexdigest(),
            "compiled": dict(netlist.provenance),
        },
        "checkpoint": {
            "file": Path(arguments.checkpoint).name,
            "sha256": asked.sha256,
            "system": None if checkpoint is None else checkpoint.system,
            "weights": None if checkpoint is None else checkpoint.weights,
            "graph": asked.graph,
            "dynamics": None if checkpoint is None or checkpoint.dynamics.is_plain else checkpoint.dynamics.to_json(),
            "bins": netlist.bins,
            "training": None if checkpoint is None or checkpoint.training is None else dict(checkpoint.training),
        },
        "data": {
            "name": Path(data.source).name,
            "split": data.split,
            "samples": len(data),
            "bin_s": arguments.bin,
            "sha256": digest.hexdigest(),
        },
        "chip": {
            "name": target.name,
            "energy_tables": {table.name: table.title for table in target.energy},
            "time_tables": {table.name: table.title for table in target.time},
        },
        "versions": {"spikeloom": __version__, "python": platform.python_version()}
        | {name: metadata.version(name) for name in PACKAGES},
        "commands": _commands(arguments, netlist, recording),
    }


def _commands(arguments: argparse.Namespace, netlist: Netlist, recording: str) -> list[Json]:
    """What to type, and what each is for."""
    net, checkpoint = _name(arguments.netlist), _name(arguments.checkpoint)
    model, data = _model_words(arguments), ["--data", _name(arguments.data), *_data_words(arguments)]
    lines: list[tuple[str, list[str]]] = []
    if "weight_bits" in netlist.provenance:
        words = ["compile", checkpoint, *model, *_compile_words(netlist.provenance, data[1]), "-o", net]
        lines.append(("the netlist", words))
    both = [net, "--checkpoint", checkpoint, *model, *data]
    spec = ["--spec-samples", str(arguments.spec_samples)] if arguments.spec_samples != 3 else []
    lines += [
        ("verdict and ladder", ["verify", *both, *spec]),
        ("energy and time", ["estimate", net, *data]),
        ("why this recording differs", ["explain", *both, "--sample", recording]),
        ("this page", ["report", *both, *spec, "--recording", recording, "-o", "report.html"]),
    ]
    return [{"for": what, "command": shlex.join(["spikeloom", *words])} for what, words in lines]


def _name(path: str) -> str:
    path = str(getattr(path, "source", path))  # recordings that Python handed over
    return Path(path).name or path


def _model_words(arguments: argparse.Namespace) -> list[str]:
    """Options that say how the float model was read."""
    words: list[str] = []
    for name in ("graph", "taxels", "edges", "system", "weights", "beta", "theta", "polarities"):
        value = getattr(arguments, name)
        if value is not None:
            words += [f"--{name}", _name(value) if name in ("taxels", "edges") else str(value)]
    words += ["--directed"] if arguments.directed else []
    words += ["--run", str(arguments.run)] if arguments.run else []
    if arguments.polarities_first is not None:
        words.append("--polarities-first" if arguments.polarities_first else "--polarities-last")
    return words


def _data_words(arguments: argparse.Namespace) -> list[str]:
    """Options that say what was read of the recordings, where they are not the usual."""
    words = ["--split", arguments.split] if arguments.split != "test" else []
    words += ["--limit", str(arguments.limit)] if arguments.limit is not None else []
    return words + (["--bin", str(arguments.bin)] if arguments.bin != BIN_S else [])


def _compile_words(made: Any, data: str) -> list[str]:
    """Options of the compilation as far as the netlist remembers them."""

    def listed(value: Any) -> str:
        return ",".join(map(str, value)) if isinstance(value, list) else str(value)

    words: list[str] = []
    for key, usual in (("weight_bits", 8), ("planes", 1), ("scale_groups", 1)):
        if made.get(key, usual) != usual and not made.get("fine_tuned"):
            words += [f"--{key.replace('_', '-')}", listed(made[key])]
    words += [f"--{key.replace('_', '-')}" for key in ("spike_exact", "keep_all", "prune_unused") if made.get(key)]
    if made.get("ranges", "proven") != "proven":
        words += ["--ranges", made["ranges"], "--margin", f"{made['margin']:g}"]
    if made.get("cores_for"):
        words += ["--cores-for", ",".join(f"{name}={count}" for name, count in made["cores_for"].items())]
    words += [word for key in ("chips", "optimize") if key in made for word in (f"--{key}", str(made[key]))]
    return words + (["--calibrate", data] if made.get("calibrated") else [])
