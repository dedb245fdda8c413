"""Write our own checkpoint format; :mod:`formats.checkpoint_reader` describes and reads it."""

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.archive import npy_bytes, zip_bytes
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import PLAIN, Dynamics
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.checkpoint_reader import FORMAT, VERSION, content_digest
from spikeloom.compiler.formats.tensors import arrays_of
from spikeloom.compiler.ir import Form
from spikeloom.compiler.systems import TACTILESGNET, Grid
from spikeloom.models.graphs import Graph

Tensors = Mapping[str, npt.NDArray[np.float32]]


def save_checkpoint(
    path: str | os.PathLike[str],
    weights: Mapping[str, Tensors],
    graph: Graph,
    *,
    beta: float,
    theta: float,
    training: Mapping[str, Any],
    forms: Sequence[Form] | None = None,
    system: str = TACTILESGNET,
    grid: Grid | None = None,
    dynamics: Dynamics = PLAIN,
    towers: int = 1,
    bins: int = 1,
) -> None:
    """Write a checkpoint, whole or not at all; equal input gives equal bytes.

    `weights` has the tensors of at least one of ``last``, ``best`` and ``clean``: ``conv1.hops`` (filters, features,
    channels), ``conv1.bias``, ``fc1.weight``, ``fc1.bias`` … float32. `training` are JSON values: how it was made and
    what it reached. `forms` say how the chip stores each layer, conv1 first, where the network was fine-tuned for it.
    `towers` lie side by side in the tensors, see :mod:`formats.tensors`; a step joins so many `bins` of the recordings.
    """
    tensors_of_one = next(iter(weights.values()))
    stages = sum(name.startswith("fc") and name.endswith(".weight") for name in tensors_of_one)
    arrays = {
        f"{which}/{name}": np.ascontiguousarray(array, "<f4")
        for which, tensors in weights.items()
        for name, array in sorted(tensors.items())
    }
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "architecture": system,
        "taxels": graph.n_taxels,
        "classes": len(tensors_of_one[f"fc{stages}.bias"]) // towers,
        "beta": beta,
        "theta": theta,
        "graph": {"name": graph.name, "edges": graph.edges.tolist()},
        "weights": list(weights),
        "training": dict(training),
    }
    if towers > 1:
        manifest["towers"] = towers
    if bins > 1:
        manifest["bins"] = bins
    if not dynamics.is_plain:
        manifest["dynamics"] = dynamics.to_json()
    if grid is not None:
        manifest["grid"] = grid.to_json()
    if forms is not None:
        layers = ["conv1", *(f"fc{stage}" for stage in range(1, stages + 1))]
        manifest["forms"] = [
            {"layer": layer, "bits": form.bits, "exponents": list(form.exponents), "threshold": form.threshold.tolist()}
            for layer, form in zip(layers, forms, strict=True)
        ]
    manifest["sha256"] = content_digest(manifest, arrays)
    members: dict[str, bytes | str] = {"manifest.json": json.dumps(manifest, indent=1, allow_nan=False)}
    content = zip_bytes(members | {f"{name}.npy": npy_bytes(array) for name, array in arrays.items()})
    with write_atomically(path) as file:
        file.write(content)


def save_again(path: str | os.PathLike[str], checkpoint: Checkpoint, *, training: Mapping[str, Any]) -> None:
    """Write a checkpoint that was read and changed, as its epoch ``last``; see `save_checkpoint`."""
    edges = np.zeros((0, 2), np.int64) if checkpoint.edges is None else checkpoint.edges
    coordinates = np.arange(float(checkpoint.taxels))[:, None]  # only edges are stored
    save_checkpoint(
        path,
        {"last": arrays_of(checkpoint)},
        Graph(name=str(checkpoint.graph), coordinates=coordinates, edges=edges),
        beta=checkpoint.beta,
        theta=checkpoint.theta,
        training=training,
        forms=checkpoint.forms,
        system=checkpoint.system,
        grid=checkpoint.grid,
        dynamics=checkpoint.dynamics,
        towers=checkpoint.towers,
        bins=checkpoint.bins,
    )
