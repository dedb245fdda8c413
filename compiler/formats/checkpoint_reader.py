"""Read trained checkpoints of all systems, from our own files, see below, and from files of ``torch.save``.

Our own format is a plain zip (members stored, not compressed) that needs neither pickle nor torch:

``manifest.json``
    ``format`` ("spikeloom-checkpoint"), ``version``, ``architecture`` ("tactilesgnet"), ``taxels``, ``classes``,
    ``beta``, ``theta``, ``graph`` (``name`` and ``edges``, pairs of source and target, repeats adding up),
    ``weights`` (the sets in the file, one at least: ``last``, ``best`` on the test split, ``clean`` on a part of the
    training split), ``training`` (how it was made and what it reached) and ``sha256`` over all of these and all arrays.
``last/NAME.npy``, ``best/NAME.npy``, ``clean/NAME.npy``
    float32: ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, ``weight`` and ``bias`` of ``fc1``, ``fc2`` …

The manifest may have, beside these,

``architecture``
    Of the other systems: "mlp", "gcn" or "grid-cnn". ``conv1.hops`` holds a filter for each taxel, one filter, or one
    for each cell of the window, row by row; ``grid`` says of the last where the taxels lie (``rows``, ``columns``,
    ``stride``, ``padding``, ``cells``).
``forms``
    How the chip stores each layer that the network was fine-tuned for: ``layer``, ``bits``, ``exponents`` and
    ``threshold`` (one integer a neuron).
``dynamics``
    ``betas`` and ``alphas`` (one a layer, or none) and ``clocks`` (``channels`` and ``steps``), see
    :mod:`compiler.dynamics`; ``fc1`` has one more input for each clock, at the end.
``towers``
    How many networks of the same sizes lie side by side, see :mod:`formats.tensors`. Arrays hold one tower after the
    other: ``conv1.hops`` along its features, the others along their first axis, so that ``fc1.weight`` has the inputs
    of one tower. Neuron ``tower * classes + class`` of the last layer votes for that class.
``bins``
    How many bins of the recordings a step joins, with an event where one of them has any.

Versions 1 to 5 are those that lacked some of these entries.
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.archive import AGAIN, CLOCKS, GRAPH, Kind, arrays_digest, entry_faults, read_npy, stored_members
from spikeloom.compiler.checkpoint import WEIGHTS, Checkpoint, constant_faults, layers_of
from spikeloom.compiler.dynamics import MOST_STEPS, PLAIN, Clocks, Dynamics, dynamics_faults
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import FileFault, read_whole, reading
from spikeloom.compiler.fixedpoint import THRESHOLD_MANTISSA_MAX, plane_distance, read_only
from spikeloom.compiler.formats.tensors import Arrays, apart, faults_of, taxel_faults, tower_faults, wanted_dense
from spikeloom.compiler.formats.torch_checkpoint import NOT_A_CHECKPOINT, read_torch
from spikeloom.compiler.ir import Form
from spikeloom.compiler.systems import GRAPH_SYSTEMS, GRID_CNN, SMALL_GRID, SYSTEMS, TITLES, Grid, shape_faults
from spikeloom.compiler.types import AnyArray

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
    "forms": [{"layer": str, "bits": (2, 8), "exponents": [(-1, 7), ...], "threshold": [(1, THRESHOLD_MANTISSA_MAX)]}],
}
"""What a manifest may leave out."""


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
) -> Checkpoint:
    """Read a checkpoint of any known layout; `run` is one of those of a released file.

    weights: which epoch, ``last``, ``best`` (on the test split) or ``clean`` (on a part of the training split), where
    the file holds several; the first of these that it holds by default.
    beta, theta: decay and threshold, where the file does not say; those of the released code by default.
    Files in the released layout hold a TactileSGNet.

    Raises ModelError if the file is no checkpoint, holds code, is damaged or altered, lacks the set or run, or its
    tensors do not make the system, with every fault of them; OptionError if an option contradicts the file, or has a
    value that does not exist.
    """
    if weights is not None and weights not in WEIGHTS:
        raise OptionError(f"--weights {weights}: unknown; choose from {', '.join(WEIGHTS)}")
    if faults := constant_faults(beta, theta):
        raise OptionError(faults[0])
    with reading(path, ModelError, AGAIN):
        found = _read(read_whole(Path(path), "checkpoint"), run, weights)
    _require_fit(str(path), found, beta, theta)
    given = [name for name, value in (("beta", beta), ("theta", theta)) if value is not None]
    return replace(
        found,
        beta=found.beta if beta is None else beta,
        theta=found.theta if theta is None else theta,
        assumed=tuple(name for name in found.assumed if name not in given),
    )


def _require_fit(where: str, found: Checkpoint, beta: float | None, theta: float | None) -> None:
    """Refuse what contradicts the file."""
    for name, value, held in (("beta", beta, found.beta), ("theta", theta, found.theta)):
        if found.forms is not None and value not in (None, held):
            raise OptionError(f"--{name} {value:g}: {where} was fine-tuned with {held:g}; omit --{name}")
    if beta is not None and found.dynamics.betas:
        decays = ", ".join(f"{each:g}" for each in found.dynamics.betas)
        raise OptionError(f"--beta {beta:g}: {where} has a decay for each layer, {decays}; omit --beta")


def content_digest(manifest: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> str:
    """Hash that a manifest states: over its other entries and all arrays."""
    stated = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(f"{json.dumps(stated, sort_keys=True)}\n{arrays_digest(arrays)}".encode()).hexdigest()


def _read(content: bytes, run: int, weights: str | None) -> Checkpoint:
    """Checkpoint of any layout; no zip may claim more than it has."""
    members = stored_members(content) if content[:2] == b"PK" else {}
    if "manifest.json" in members:
        if run != 0:
            raise ModelError(f"--run {run}: the file holds only run 0; omit --run")
        return _read_own(content, members, weights)
    found = read_torch(content, run)
    if weights not in (None, "last"):
        raise ModelError(f"--weights {weights}: the file holds the last epoch only; omit --weights")
    return found


def _read_own(content: bytes, members: dict[str, bytes], weights: str | None) -> Checkpoint:
    """Check a file of our own format, and take one set of weights from its members."""
    manifest, arrays = _signed_content(members)
    kinds = ENTRIES | {name: kind for name, kind in MORE.items() if name in manifest}
    if faults := entry_faults(manifest, kinds) or constant_faults(manifest["beta"], manifest["theta"]):
        raise FileFault("; ".join(faults))
    sets = tuple(name for name in WEIGHTS if name in manifest["weights"])
    weights = sets[0] if weights is None else weights
    if weights not in sets:
        raise ModelError(f"--weights {weights}: the file holds {', '.join(sets)}; choose one that it holds")
    chosen = {name.removeprefix(f"{weights}/"): a for name, a in arrays.items() if name.startswith(f"{weights}/")}
    system, towers = manifest["architecture"], manifest.get("towers", 1)
    edges = read_only(np.array(manifest["graph"]["edges"], np.int64).reshape(-1, 2))
    grid, dynamics = None, PLAIN
    if system == GRID_CNN and (said := manifest.get("grid")):
        grid = Grid(**said | {"cells": read_only(said["cells"])})
        if np.any(grid.cells >= (grid.rows, grid.columns)):
            faults.append("the manifest has an unusable grid or dynamics (taxels outside the grid)")
    if said := manifest.get("dynamics"):
        decays = {name: tuple(map(float, said[name])) for name in ("betas", "alphas")}
        dynamics = Dynamics(**decays, clocks=Clocks(**said["clocks"]))
        stages = sum(re.fullmatch(r"fc\d+\.weight", name) is not None for name in chosen)
        if wrong := dynamics_faults(dynamics, 1 + stages):
            faults.append(f"the manifest has an unusable grid or dynamics ({'; '.join(wrong)})")
    faults += tower_faults(chosen, towers)
    for tower in () if faults else apart(chosen, towers):
        faults = faults or _tower_faults(tower, manifest["taxels"], manifest["classes"], (system, grid, dynamics))
    if edges.size and edges.max() >= manifest["taxels"]:
        faults.append(f"the graph joins taxels outside 0..{manifest['taxels'] - 1}")
    if faults:
        raise FileFault("; ".join(faults))
    found = Checkpoint(
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
    return replace(found, forms=_forms(manifest["forms"], found)) if "forms" in manifest else found


def _signed_content(members: Mapping[str, bytes]) -> tuple[dict[str, Any], Arrays]:
    """Manifest and arrays that match the hash which the manifest states."""
    manifest = json.loads(members["manifest.json"])
    arrays = {name.removesuffix(".npy"): read_npy(data) for name, data in members.items() if name.endswith(".npy")}
    if len(arrays) + 1 != len(members) or any(array.dtype != "<f4" for array in arrays.values()):
        raise FileFault("has members that are no arrays of float32")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError(NOT_A_CHECKPOINT)
    version = manifest.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise ModelError(f"has format version {version!r:.40}, this program reads up to {VERSION}; update spikeloom")
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
        Form(bits=entry["bits"], exponents=tuple(entry["exponents"]), threshold=read_only(entry["threshold"]))
        for entry in entries
    )


def _tower_faults(arrays: Arrays, taxels: int, classes: int, kind: tuple[str, Grid | None, Dynamics]) -> list[str]:
    system, grid, dynamics = kind
    stages = max((int(m[1]) for key in arrays if (m := re.fullmatch(r"fc([1-9]\d?)\.weight", key))), default=1)
    wanted = {"conv1.hops": ("K + 1", "features", "channels"), "conv1.bias": ("features",)} | wanted_dense(stages)
    faults = faults_of(arrays, wanted, TITLES[system])
    if not faults:
        features = len(arrays["conv1.bias"])
        faults = taxel_faults(arrays, features, dynamics.clocks.channels)
        received = arrays["fc1.weight"].shape[1] - dynamics.clocks.channels
        places, made_classes = received // features, len(arrays[f"fc{stages}.bias"])
        faults = faults or shape_faults(system, len(arrays["conv1.hops"]), places, taxels, grid)
        made_for = places if system in GRAPH_SYSTEMS else taxels, made_classes
        if not faults and made_for != (taxels, classes):
            faults = [
                f"made for {made_for[0]} taxels and {made_for[1]} classes, "
                f"the manifest says {taxels} taxels and {classes} classes"
            ]
    return faults
