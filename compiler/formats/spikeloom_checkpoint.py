"""Our own checkpoint format, read and checked.

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
    How many networks of the same sizes lie side by side, see :mod:`formats.towers`. Arrays hold one tower after the
    other: ``conv1.hops`` along its features, the others along their first axis, so that ``fc1.weight`` has the inputs
    of one tower. Neuron ``tower * classes + class`` of the last layer votes for that class.
``bins``
    How many bins of the recordings a step joins, with an event where one of them has any.

Versions 1 to 5 are those that lacked some of these entries.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.archive import arrays_digest, read_npy, stored_members
from spikeloom.compiler.checkpoint import WEIGHTS, Float32Array
from spikeloom.compiler.dynamics import MOST_STEPS, PLAIN, Dynamics, dynamics_from_json
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.fixedpoint import THRESHOLD_MANTISSA_MAX, plane_distance
from spikeloom.compiler.formats.tensors import (
    Arrays,
    Contents,
    apart,
    faults_of,
    size,
    taxel_faults,
    tower_faults,
    wanted_dense,
)
from spikeloom.compiler.formats.torch_checkpoint import DAMAGED, NOT_A_CHECKPOINT
from spikeloom.compiler.ir import Form
from spikeloom.compiler.systems import (
    GRAPH_SYSTEMS,
    GRID_CNN,
    SYSTEMS,
    TITLES,
    Grid,
    grid_from_json,
    shape_faults,
)
from spikeloom.compiler.types import JsonObject

FORMAT = "spikeloom-checkpoint"
VERSION = 6


_AGAIN = "copy or train it again"


def content_digest(manifest: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Hash that a manifest states: over its other entries and all arrays."""
    stated = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(f"{json.dumps(stated, sort_keys=True)}\n{arrays_digest(arrays)}".encode()).hexdigest()


def require_constants(
    where: str, error: type[ModelError] | type[OptionError], beta: float | None, theta: float | None
) -> None:
    """Refuse a decay or a threshold that no neuron has, as an error of the given kind."""
    if beta is not None and not 0 <= beta < 1:
        raise error(
            f"{where}beta {beta:g}: allowed are 0 <= beta < 1; it is the share of the membrane that a step keeps"
        )
    if theta is not None and not 0 < theta < math.inf:
        raise error(f"{where}theta {theta:g}: allowed are numbers above 0; it is the threshold of a spike")


def own_members(where: str, content: bytes) -> dict[str, bytes] | None:
    """Members of a file in our own format, or None if it is something else; no zip may claim more than it has."""
    if content[:2] != b"PK":
        return None
    try:
        members = stored_members(content)
    except ValueError as error:
        raise ModelError(f"{where}: is truncated or damaged ({error}); copy it again") from error
    return members if "manifest.json" in members else None


def _manifest(where: str, content: bytes) -> JsonObject:
    try:
        manifest = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{where}: {DAMAGED}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError(f"{where}: {NOT_A_CHECKPOINT}")
    version = manifest.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise ModelError(
            f"{where}: has format version {version!r}, this program reads up to {VERSION}; update spikeloom"
        )
    return manifest


def own_contents(where: str, members: dict[str, bytes], weights: str | None) -> Contents:
    """Check a file of our own format and take it apart.

    Parameters
    ----------
    where : str
        For messages.
    members : dict of str to bytes
        Of the file; the manifest is taken out.
    weights : str, optional
        Which set; by default the first of ``WEIGHTS`` that the file holds.

    Raises
    ------
    ModelError
        As :func:`checkpoint.read_checkpoint` says.
    """
    manifest = _manifest(where, members.pop("manifest.json"))
    try:
        arrays: Arrays = {name.removesuffix(".npy"): _read_float32(content) for name, content in members.items()}
    except ValueError as error:
        raise ModelError(f"{where}: {DAMAGED}") from error
    if content_digest(manifest, arrays) != manifest.get("sha256"):
        raise ModelError(f"{where}: its content does not match its hash, so it was altered; {_AGAIN}")
    try:
        sets = tuple(name for name in WEIGHTS if name in manifest["weights"])
        graph, beta, theta = str(manifest["graph"]["name"]), float(manifest["beta"]), float(manifest["theta"])
        edges = np.array(manifest["graph"]["edges"], np.int64).reshape(-1, 2)
        edges.flags.writeable = False
        taxels, classes, training = int(manifest["taxels"]), int(manifest["classes"]), dict(manifest["training"])
        system = str(manifest["architecture"])
        if system not in SYSTEMS:
            raise ValueError(f"architecture {system}")
        grid = grid_from_json(manifest["grid"]) if system == GRID_CNN else None
        towers, bins = (_count(manifest, name) for name in ("towers", "bins"))
        dynamics = PLAIN
        if "dynamics" in manifest:
            stages = sum(re.fullmatch(r"[a-z]+/fc\d+\.weight", name) is not None for name in arrays) // len(sets)
            dynamics = dynamics_from_json(manifest["dynamics"], 1 + stages)
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise ModelError(f"{where}: has an incomplete manifest ({error!r}); {_AGAIN}") from error
    require_constants(f"{where}: ", ModelError, beta, theta)
    weights = sets[0] if weights is None and sets else weights
    if weights not in sets:
        raise ModelError(f"{where}: --weights {weights}: the file holds {', '.join(sets)}; choose one that it holds")
    chosen = {name.removeprefix(f"{weights}/"): a for name, a in arrays.items() if name.startswith(f"{weights}/")}
    faults = tower_faults(chosen, towers)
    for tower in () if faults else apart(chosen, towers):
        faults = faults or _own_faults(tower, taxels, classes, (system, grid, dynamics))
    if edges.size and (edges.min() < 0 or edges.max() >= taxels):
        faults.append(f"the graph joins taxels outside 0..{taxels - 1}")
    if faults:
        raise ModelError(f"{where}: {'; '.join(faults)}; {_AGAIN}")
    return Contents(
        arrays=chosen,
        layout="spikeloom",
        system=system,
        beta=beta,
        theta=theta,
        graph=graph,
        edges=edges,
        weights=weights,
        sets=sets,
        training=training,
        forms=_forms(where, manifest, chosen, towers, dynamics.clocks.channels),
        grid=grid,
        dynamics=dynamics,
        towers=towers,
        bins=bins,
    )


def _count(manifest: dict[str, Any], name: str) -> int:
    """A number above 1; 1 where it is not there."""
    count = manifest.get(name, 2)
    if type(count) is not int or not 2 <= count <= MOST_STEPS:
        raise ValueError(f"{count} {name}")
    return count if name in manifest else 1


def _forms(where: str, manifest: dict[str, Any], arrays: Arrays, towers: int, clocks: int) -> tuple[Form, ...] | None:
    """Storage of every layer of a fine-tuned network; None for a plain file."""
    if "forms" not in manifest:
        return None
    sizes = {"conv1": (arrays["fc1.weight"].shape[1] - clocks) * towers + clocks}
    stages = sum(key.endswith(".weight") for key in arrays)
    sizes |= {f"fc{stage}": len(arrays[f"fc{stage}.bias"]) for stage in range(1, stages + 1)}
    found = []
    try:
        for name, size, entry in zip(sizes, sizes.values(), manifest["forms"], strict=True):
            bits, exponents, thresholds = entry["bits"], entry["exponents"], entry["threshold"]
            good = (
                entry["layer"] == name
                and all(type(number) is int for number in (bits, *exponents, *thresholds))
                and len(thresholds) == size
                and all(1 <= threshold <= THRESHOLD_MANTISSA_MAX for threshold in thresholds)
                and bits in range(2, 9)
                and bool(exponents)
                and all(-1 <= e <= 7 for e in exponents)
                and all(0 < b - a <= plane_distance(bits) for a, b in pairwise(exponents))
            )
            if not good:
                raise ValueError(f"layer {name}")
            threshold = np.array(thresholds, np.int64)
            threshold.flags.writeable = False
            found.append(Form(bits=bits, exponents=tuple(exponents), threshold=threshold))
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{where}: has unusable forms of a fine-tuning ({error}); {_AGAIN}") from error
    return tuple(found)


def _own_faults(arrays: Arrays, taxels: int, classes: int, kind: tuple[str, Grid | None, Dynamics]) -> list[str]:
    system, grid, dynamics = kind
    stages = max((int(m[1]) for key in arrays if (m := re.fullmatch(r"fc([1-9]\d?)\.weight", key))), default=1)
    features = size(arrays, "conv1.hops", 3, 1, "features")
    wanted = {"conv1.hops": ("K + 1", features, "channels"), "conv1.bias": (features,)} | wanted_dense(arrays, stages)
    faults = faults_of(arrays, wanted, TITLES[system])
    if not faults:
        assert isinstance(features, int)
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


def _read_float32(content: bytes) -> Float32Array:
    array = read_npy(content)
    if array.dtype != "<f4":
        raise ValueError(f"an array of {array.dtype}")
    return array
