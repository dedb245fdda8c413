"""Our own checkpoints of all systems: a plain zip (members stored, not compressed) that needs neither pickle nor torch.

``manifest.json``
    ``format`` ("spikeloom-checkpoint"), ``version``, ``architecture`` ("tactilesgnet"), ``taxels``,
    ``classes``, ``beta``, ``theta``, ``graph`` (``name`` and ``edges``, pairs of source and target, repeats
    adding up), ``weights`` (the sets in the file, one at least: ``last``, ``best`` on the test split,
    ``clean`` on a part of the training split), ``training`` (how it was made and what it reached) and
    ``sha256`` over all of these and all arrays.
``last/NAME.npy``, ``best/NAME.npy``, ``clean/NAME.npy``
    float32: ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, ``weight`` and ``bias`` of ``fc1``,
    ``fc2`` …

The manifest may have, beside these,

``architecture``
    Of the other systems: "mlp", "gcn" or "grid-cnn". ``conv1.hops`` holds a filter for each taxel, one
    filter, or one for each cell of the window, row by row; ``grid`` says of the last where the taxels lie
    (``rows``, ``columns``, ``stride``, ``padding``, ``cells``).
``forms``
    How the chip stores each layer that the network was fine-tuned for: ``layer``, ``bits``, ``exponents``
    and ``threshold`` (one integer a neuron).
``dynamics``
    ``betas`` and ``alphas`` (one a layer, or none) and ``clocks`` (``channels`` and ``steps``), see
    :mod:`compiler.dynamics`; ``fc1`` has one more input for each clock, at the end.
``towers``
    How many networks of the same sizes lie side by side, see :mod:`formats.tensors`. Arrays hold one tower
    after the other: ``conv1.hops`` along its features, the others along their first axis, so that
    ``fc1.weight`` has the inputs of one tower. Neuron ``tower * classes + class`` of the last layer votes
    for that class.
``bins``
    How many bins of the recordings a step joins, with an event where one of them has any.

Versions 1 to 5 are those that lacked some of these entries.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.archive import (
    CLOCKS,
    GRAPH,
    Kind,
    arrays_digest,
    entry_faults,
    npy_bytes,
    read_npy,
    require_none,
    stored_members,
    write_archive,
    zip_bytes,
)
from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint, constant_faults, layers_of
from spikeloom.compiler.dynamics import MOST_STEPS, PLAIN, Clocks, Dynamics, dynamics_faults
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.files import FileFault
from spikeloom.compiler.formats.tensors import (
    Arrays,
    apart,
    arrays_of,
    faults_of,
    taxel_faults,
    tower_faults,
    wanted_dense,
)
from spikeloom.compiler.formats.torch_checkpoint import NOT_A_CHECKPOINT
from spikeloom.compiler.ir import Form
from spikeloom.compiler.systems import (
    GRAPH_SYSTEMS,
    GRID_CNN,
    SMALL_GRID,
    SYSTEMS,
    TACTILESGNET,
    TITLES,
    Grid,
    shape_faults,
)
from spikeloom.compiler.targets.loihi1.registers import THRESHOLD_MANTISSA_MAX, plane_distance
from spikeloom.compiler.types import AnyArray, IntArray, JsonObject

FORMAT = "spikeloom-checkpoint"
VERSION = 6

ENTRIES: dict[str, Kind] = {
    "architecture": frozenset(SYSTEMS),
    **dict.fromkeys(("taxels", "classes"), (1, 2**31)),
    **dict.fromkeys(("beta", "theta"), float),
    "graph": GRAPH,
    "weights": [frozenset(WEIGHTS), ...],
    "training": dict,
}
MORE: dict[str, Kind] = {
    "towers": (2, MOST_STEPS),
    "bins": (2, MOST_STEPS),
    "grid": {
        **dict.fromkeys(("rows", "columns", "stride"), (1, SMALL_GRID)),
        "padding": (0, SMALL_GRID),
        "cells": [[(0, SMALL_GRID), 2], ...],
    },
    "dynamics": {"betas": [float], "alphas": [float], "clocks": CLOCKS},
    "forms": [
        {
            "layer": str,
            "bits": (2, 8),
            "exponents": [(-1, 7), ...],
            "threshold": [(1, THRESHOLD_MANTISSA_MAX)],
        }
    ],
}
"""What a manifest may leave out."""


Tensors = Mapping[str, npt.NDArray[np.float32]]


def save_checkpoint(
    path: str | os.PathLike[str],
    weights: Mapping[str, Tensors],
    *,
    taxels: int,
    graph: str,
    edges: IntArray,
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

    `weights` has the tensors of at least one of ``last``, ``best`` and ``clean``: ``conv1.hops`` (filters,
    features, channels), ``conv1.bias``, ``fc1.weight``, ``fc1.bias`` … float32. `graph` is the name of the
    taxel graph, `edges` (edges, 2) int64 are the source and the target of each of its edges. `training` are
    JSON values: how it was made and what it reached. `forms` say how the chip stores each layer, conv1
    first, of a fine-tuned network. `towers` lie side by side in the tensors, see :mod:`formats.tensors`; a
    step joins so many `bins` of the recordings.
    """
    tensors_of_one = next(iter(weights.values()))
    stages = _dense_stages(tensors_of_one)
    arrays = {
        f"{which}/{name}": np.ascontiguousarray(array, "<f4")
        for which, tensors in weights.items()
        for name, array in sorted(tensors.items())
    }
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "architecture": system,
        "taxels": taxels,
        "classes": len(tensors_of_one[f"fc{stages}.bias"]) // towers,
        "beta": beta,
        "theta": theta,
        "graph": {"name": graph, "edges": edges.tolist()},
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
        manifest["forms"] = _form_entries(forms)
    manifest["sha256"] = content_digest(manifest, arrays)
    members: dict[str, bytes | str] = {"manifest.json": json.dumps(manifest, indent=1, allow_nan=False)}
    members |= {f"{name}.npy": npy_bytes(array) for name, array in arrays.items()}
    write_archive(zip_bytes(members), path)


def _form_entries(forms: Sequence[Form]) -> list[JsonObject]:
    """How the layers are stored, conv1 first, as JSON values."""
    layers = ("conv1", *(f"fc{stage}" for stage in range(1, len(forms))))
    return [
        {"layer": layer} | asdict(form) | {"threshold": form.threshold.tolist()}
        for layer, form in zip(layers, forms, strict=True)
    ]


def _dense_stages(names: Iterable[str]) -> int:
    """Number of fully connected stages, from the names of tensors."""
    return sum(re.fullmatch(r"fc\d+\.weight", name) is not None for name in names)


def save_again(path: str | os.PathLike[str], checkpoint: Checkpoint, *, training: Mapping[str, Any]) -> None:
    """Write a checkpoint that was read and changed, as its epoch ``last``; see `save_checkpoint`."""
    edges = np.zeros((0, 2), np.int64) if checkpoint.edges is None else checkpoint.edges
    save_checkpoint(
        path,
        {"last": arrays_of(checkpoint)},
        taxels=checkpoint.taxels,
        graph=str(checkpoint.graph),
        edges=edges,
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


def content_digest(manifest: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> str:
    """Hash that a manifest states: over its other entries and all arrays."""
    stated = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(
        f"{json.dumps(stated, sort_keys=True)}\n{arrays_digest(arrays)}".encode()
    ).hexdigest()


def is_own(content: bytes) -> bool:
    """Whether a file is a zip with our manifest; no zip may claim more than it has."""
    return content[:2] == b"PK" and "manifest.json" in stored_members(content)


def read_own(content: bytes, weights: str | None) -> Checkpoint:
    """Check a file of our own format, and take one set of weights from its members."""
    manifest, arrays = _signed_content(stored_members(content))
    kinds = ENTRIES | {name: kind for name, kind in MORE.items() if name in manifest}
    require_none(entry_faults(manifest, kinds) or constant_faults(manifest["beta"], manifest["theta"]))
    faults: list[str] = []
    sets = tuple(name for name in WEIGHTS if name in manifest["weights"])
    weights = sets[0] if weights is None else weights
    if weights not in sets:
        raise ModelError(f"--weights {weights}: the file holds {', '.join(sets)}; choose one that it holds")
    chosen = {
        name.removeprefix(f"{weights}/"): a for name, a in arrays.items() if name.startswith(f"{weights}/")
    }
    system = manifest["architecture"]
    towers = manifest.get("towers", 1)
    edges = read_only(np.array(manifest["graph"]["edges"], np.int64).reshape(-1, 2))
    grid = None
    dynamics = PLAIN
    if system == GRID_CNN and (said := manifest.get("grid")):
        grid = Grid(**said | {"cells": read_only(said["cells"])})
        if np.any(grid.cells >= (grid.rows, grid.columns)):
            faults.append("the manifest has an unusable grid or dynamics (taxels outside the grid)")
    if said := manifest.get("dynamics"):
        decays = {name: tuple(map(float, said[name])) for name in ("betas", "alphas")}
        dynamics = Dynamics(**decays, clocks=Clocks(**said["clocks"]))
        if wrong := dynamics_faults(dynamics, 1 + _dense_stages(chosen)):
            faults.append(f"the manifest has an unusable grid or dynamics ({'; '.join(wrong)})")
    faults += tower_faults(chosen, towers)
    for tower in () if faults else apart(chosen, towers):
        faults = faults or _tower_faults(
            tower, manifest["taxels"], manifest["classes"], (system, grid, dynamics)
        )
    if edges.size and edges.max() >= manifest["taxels"]:
        faults.append(f"the graph joins taxels outside 0..{manifest['taxels'] - 1}")
    require_none(faults)
    checkpoint = Checkpoint(
        **layers_of(chosen),
        beta=float(manifest["beta"]),
        theta=float(manifest["theta"]),
        layout="spikeloom",
        graph=manifest["graph"]["name"],
        edges=edges,
        weights=weights,
        sets=sets,
        training=manifest["training"],
        sha256=hashlib.sha256(content).hexdigest(),
        system=system,
        grid=grid,
        dynamics=dynamics,
        towers=towers,
        bins=manifest.get("bins", 1),
    )
    return (
        replace(checkpoint, forms=_forms(manifest["forms"], checkpoint))
        if "forms" in manifest
        else checkpoint
    )


def _signed_content(members: Mapping[str, bytes]) -> tuple[dict[str, Any], Arrays]:
    """Manifest and arrays that match the hash which the manifest states."""
    manifest = json.loads(members["manifest.json"])
    arrays = {
        name.removesuffix(".npy"): read_npy(data) for name, data in members.items() if name.endswith(".npy")
    }
    if len(arrays) + 1 != len(members) or any(array.dtype != "<f4" for array in arrays.values()):
        raise FileFault("has members that are no arrays of float32")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError(NOT_A_CHECKPOINT)
    version = manifest.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise ModelError(
            f"has format version {version!r:.40}, this program reads up to {VERSION}; update spikeloom"
        )
    if content_digest(manifest, arrays) != manifest.get("sha256"):
        raise FileFault("its content does not match its hash, so it was altered")
    return manifest, arrays


def _forms(entries: list[dict[str, Any]], checkpoint: Checkpoint) -> tuple[Form, ...]:
    """Storage of every layer of a fine-tuned network."""
    fits = [(entry["layer"], len(entry["threshold"])) for entry in entries] == [*checkpoint.neurons.items()]
    gaps = [(entry["bits"], b - a) for entry in entries for a, b in pairwise(entry["exponents"])]
    if not fits or not all(0 < gap <= plane_distance(bits) for bits, gap in gaps):
        raise FileFault("the manifest has no usable forms")
    return tuple(
        Form(
            bits=entry["bits"], exponents=tuple(entry["exponents"]), threshold=read_only(entry["threshold"])
        )
        for entry in entries
    )


def _tower_faults(
    arrays: Arrays, taxels: int, classes: int, kind: tuple[str, Grid | None, Dynamics]
) -> list[str]:
    system, grid, dynamics = kind
    stages = max(
        (int(m[1]) for key in arrays if (m := re.fullmatch(r"fc([1-9]\d?)\.weight", key))), default=1
    )
    wanted = {"conv1.hops": ("K + 1", "features", "channels"), "conv1.bias": ("features",)} | wanted_dense(
        stages
    )
    faults = faults_of(arrays, wanted, TITLES[system])
    if not faults:
        features = len(arrays["conv1.bias"])
        faults = taxel_faults(arrays, features, dynamics.clocks.channels)
        received = arrays["fc1.weight"].shape[1] - dynamics.clocks.channels
        places = received // features
        made_classes = len(arrays[f"fc{stages}.bias"])
        faults = faults or shape_faults(system, len(arrays["conv1.hops"]), places, taxels, grid)
        made_for = places if system in GRAPH_SYSTEMS else taxels, made_classes
        if not faults and made_for != (taxels, classes):
            faults = [
                f"made for {made_for[0]} taxels and {made_for[1]} classes, "
                f"the manifest says {taxels} taxels and {classes} classes"
            ]
    return faults
