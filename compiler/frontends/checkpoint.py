"""Read trained checkpoints of all systems: our own files, the released layout and bare state dicts.

Our own format is a plain zip (members stored, not compressed) that needs neither pickle nor torch:

``manifest.json``
    ``format`` ("spikeloom-checkpoint"), ``version``, ``architecture`` ("tactilesgnet"), ``taxels``, ``classes``,
    ``beta``, ``theta``, ``graph`` (``name`` and ``edges``, pairs of source and target, repeats adding up),
    ``weights`` (the sets in the file: ``last``, and ``best`` where the epoch that did best on the test split was
    kept), ``training`` (how it was made and what it reached) and ``sha256`` over all of these and all arrays.
``last/NAME.npy``, ``best/NAME.npy``
    float32: ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, ``weight`` and ``bias`` of ``fc1``, ``fc2`` …

Version 2 adds ``forms`` to the manifest: how the chip stores each layer that the network was fine-tuned for, an
object per layer with ``layer``, ``bits``, ``exponents`` and ``threshold`` (one integer a neuron).

Version 3 is for the other systems: ``architecture`` is "mlp", "gcn" or "grid-cnn", and ``conv1.hops`` holds a filter
for each taxel, one filter, or one for each cell of the window, row by row; ``grid`` says of the last where the taxels
lie (``rows``, ``columns``, ``stride``, ``padding``, ``cells``). ``forms`` may be there or not.

Version 4 is for networks with decays of single layers or with clocks, of any system: ``dynamics`` holds ``betas`` and
``alphas`` (one a layer, or none) and ``clocks`` (``channels`` and ``steps``), see :mod:`compiler.dynamics`; ``fc1`` has
one more input for each clock, at the end. ``forms`` may be there or not.

Version 5 is for networks joined of several, of any system: ``towers`` says how many lie side by side, all of the same
sizes. Arrays hold one tower after the other: ``conv1.hops`` along its features, the others along their first axis, so
that ``fc1.weight`` has the inputs of one tower. Neuron ``tower * classes + class`` of the last layer votes for that
class; ``classes`` counts classes. ``dynamics`` and ``forms`` may be there or not; see :mod:`compiler.frontends.towers`.

Files of ``torch.save`` are read by :mod:`compiler.frontends.released`.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from compiler.dynamics import PLAIN, Dynamics, dynamics_from_json
from compiler.errors import ModelError, OptionError
from compiler.fixedpoint import THRESHOLD_MANTISSA_MAX, IntArray
from compiler.forms import Form, plane_distance
from compiler.frontends.released import DAMAGED, GIVE, NOT_A_CHECKPOINT, read_released
from compiler.frontends.systems import (
    GRAPH_SYSTEMS,
    GRID_CNN,
    MLP,
    SYSTEMS,
    TACTILESGNET,
    TITLES,
    Grid,
    grid_from_json,
    kernel_of,
    shape_faults,
    window_forms,
)
from compiler.frontends.tensors import Arrays, apart, faults_of, size, taxel_faults, tower_faults, wanted_dense
from compiler.ir import Readout

FORMAT = "spikeloom-checkpoint"
VERSIONS = (1, 2, 3, 4, 5)
"""Of a plain file of a TactileSGNet, of one that holds the forms of a fine-tuning, of another system's, of one with
decays of single layers or with clocks, and of several joined ones."""

BETA, THETA = 0.2, 0.5
"""Decay and threshold of the released code; files in its layout do not hold them."""

SIZE_LIMIT = 2**28
"""Bytes that a checkpoint may have: 256 MiB, a hundred times the released ones."""

WEIGHTS = ("last", "best", "clean")
"""Sets that our own format can hold."""

Float32Array = npt.NDArray[np.float32]

_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '<f4', 'fortran_order': False, 'shape': \(([\d, ]{0,80})\), \} *\n", re.DOTALL
)
_AGAIN = "copy or train it again"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dense:
    """A fully connected stage.

    Parameters
    ----------
    name : str
        ``fc1`` …
    weight : (outputs, inputs) float32
        Of a joined network with the inputs of one tower: no row has weights from another one.
    bias : (outputs,) float32
    """

    name: str
    weight: Float32Array
    bias: Float32Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint:
    """Trained weights, and what is known about them.

    Parameters
    ----------
    system : str
        One of ``SYSTEMS``.
    hops : (filters, features, channels) float32
        Filters of the first layer: of a TactileSGNet K + 1, one for each hop.
    conv_bias : (features,) float32
    dense : tuple of Dense
        Fully connected stages in order.
    beta, theta : float
        Membrane decay and threshold.
    assumed : tuple of str
        Which of ``beta`` and ``theta`` neither the file nor the user gave.
    graph : str or None
        Name of the graph that it was trained on.
    edges : (edges, 2) int64 or None
        Its edge list, (source, target).
    layout : {"spikeloom", "released", "state_dict"}
        Kind of file.
    weights : {"last", "best", "clean"}
        Epoch that the weights are from.
    runs : int
        Trainings that the file holds; this is one of them.
    training : mapping or None
        JSON values: how it was made and what it reached.
    forms : tuple of Form, or None
        How the chip stores each layer, where the network was fine-tuned for it.
    sha256 : str
        Of the file.
    grid : Grid or None
        Of a grid-based CNN.
    dynamics : Dynamics
        Decays of single layers, and clocks.
    towers : int
        Networks that lie side by side and vote together, see :mod:`compiler.frontends.towers`.
    """

    hops: Float32Array
    conv_bias: Float32Array
    dense: tuple[Dense, ...]
    beta: float
    theta: float
    assumed: tuple[str, ...]
    graph: str | None
    edges: IntArray | None
    layout: str
    weights: str
    runs: int
    training: Mapping[str, Any] | None
    forms: tuple[Form, ...] | None
    sha256: str
    system: str = TACTILESGNET
    grid: Grid | None = None
    dynamics: Dynamics = PLAIN
    towers: int = 1

    @property
    def places(self) -> int:
        """Number of places that the first fully connected stage was trained on."""
        heard = self.dense[0].weight.shape[1] - self.dynamics.clocks.channels
        return int(heard * self.towers // self.hops.shape[1])

    @property
    def taxels(self) -> int:
        """Number of taxels of the sensor."""
        if self.grid is not None:
            return len(self.grid.cells)
        return len(self.hops) if self.system == MLP else self.places

    @property
    def classes(self) -> int:
        """Number of classes."""
        return len(self.dense[-1].bias) // self.towers

    @property
    def neurons(self) -> dict[str, int]:
        """Neurons of each layer, the relays of clocks among those of the first."""
        first = self.places * self.hops.shape[1] + self.dynamics.clocks.channels
        return {"conv1": int(first)} | {dense.name: len(dense.bias) for dense in self.dense}

    @property
    def readout(self) -> Readout:
        """The vote: each tower has one neuron for each class."""
        label = np.arange(len(self.dense[-1].bias)) % self.classes
        return Readout(population=len(self.dense), label=label)


def arrays_digest(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Hash over names, types, shapes and bytes of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}\n".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def content_digest(manifest: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Hash that a manifest states: over its other entries and all arrays."""
    stated = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(f"{json.dumps(stated, sort_keys=True)}\n{arrays_digest(arrays)}".encode()).hexdigest()


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str | None = None,
    beta: float | None = None,
    theta: float | None = None,
    system: str | None = None,
    cells: IntArray | None = None,
) -> Checkpoint:
    """Read a checkpoint of any known layout.

    Parameters
    ----------
    path : path
        File.
    run : int
        Which run of a released file.
    weights : {"last", "best", "clean"}, optional
        Which epoch, where the file holds several; the first of these that it holds without. The best one was chosen
        on the test split, the clean one on a part of the training split.
    beta, theta : float, optional
        Decay and threshold; taken from the file, or from the released code where the file does not say.
    system : str, optional
        Which system it is; the file tells by itself.
    cells : (taxels, 2) int64, optional
        Row and column of each taxel on the grid of a grid-based CNN, where the file does not say.

    Raises
    ------
    ModelError
        If the file is no checkpoint, holds code, is damaged or altered, does not hold what is asked for, or its
        tensors do not make the system; every fault of the tensors is listed.
    OptionError
        If `system` is another than the file's, or `weights`, `beta` or `theta` has a value that does not exist, or a
        fine-tuned network had another one.
    """
    if weights is not None and weights not in WEIGHTS:
        raise OptionError(f"--weights {weights}: unknown; choose from {', '.join(WEIGHTS)}")
    if system is not None and system not in SYSTEMS:
        raise OptionError(f"--system {system}: unknown; choose from {', '.join(SYSTEMS)}")
    _require_constants("", OptionError, beta, theta)
    where, path = str(path), Path(path)
    content = _content(where, path)
    members = _own_members(where, content)
    given = {"beta": beta, "theta": theta}
    if members is None:
        arrays, layout, runs, training, found = read_released(where, content, run, system)
        grid = _released_grid(where, arrays, cells) if found == GRID_CNN else None
        if weights not in (None, "last"):
            raise ModelError(f"{where}: --weights {weights}: the file holds the last epoch only; leave --weights away")
        graph, edges, chosen, held = None, None, "last", {"beta": BETA, "theta": THETA}
        forms, dynamics, towers = None, PLAIN, 1
        assumed = tuple(name for name, value in given.items() if value is None)
    else:
        if run != 0:
            raise ModelError(f"{where}: --run {run}: the file holds only run 0; leave --run away")
        arrays, chosen, (graph, edges, held, training), (found, grid, dynamics), (forms, towers) = _own_arrays(
            where, members, weights
        )
        if system not in (None, found):
            raise OptionError(f"--system {system}: {where} holds a {found}; leave --system away")
        layout, runs, assumed = "spikeloom", 1, ()
        for name, value in given.items():
            if forms is not None and value not in (None, held[name]):
                raise OptionError(
                    f"--{name} {value:g}: {where} was fine-tuned with {held[name]:g}; leave --{name} away"
                )
        if beta is not None and dynamics.betas:
            raise OptionError(
                f"--beta {beta:g}: {where} has a decay for each layer, {', '.join(f'{b:g}' for b in dynamics.betas)}; "
                "leave --beta away"
            )
    stages = sorted({key.split(".")[0] for key in arrays if key.startswith("fc")}, key=lambda name: int(name[2:]))
    return Checkpoint(
        hops=_plain(arrays["conv1.hops"]),
        conv_bias=_plain(arrays["conv1.bias"]),
        dense=tuple(
            Dense(name=name, weight=_plain(arrays[f"{name}.weight"]), bias=_plain(arrays[f"{name}.bias"]))
            for name in stages
        ),
        beta=held["beta"] if beta is None else beta,
        theta=held["theta"] if theta is None else theta,
        assumed=assumed,
        graph=graph,
        edges=edges,
        layout=layout,
        weights=chosen,
        runs=runs,
        training=training,
        forms=forms,
        sha256=hashlib.sha256(content).hexdigest(),
        system=found,
        grid=grid,
        dynamics=dynamics,
        towers=towers,
    )


def _released_grid(where: str, arrays: Arrays, cells: IntArray | None) -> Grid:
    """Grid of a file that does not say what it is: which of the two forms, the number of places tells."""
    if cells is None:
        raise ModelError(f"{where}: where the taxels lie on the grid is not in this file; name the sensor")
    filters, features, _ = arrays["conv1.hops"].shape
    places = arrays["fc1.weight"].shape[1] // features
    forms = window_forms(cells, kernel_of(filters))
    counts = {form: math.prod(grid.places(kernel_of(filters))) for form, grid in forms.items()}
    for form, count in counts.items():
        if count == places:
            return forms[form]
    sizes = " or ".join(f"{count} (padding {form})" for form, count in counts.items())
    raise ModelError(
        f"{where}: fc1 was trained on {places} places, a window of {kernel_of(filters)} * {kernel_of(filters)} on this "
        f"sensor has {sizes}; give the sensor that it was trained on"
    )


def _plain(array: npt.NDArray[Any]) -> Float32Array:
    copy = np.array(array, np.float32, order="C")
    copy.flags.writeable = False
    return copy


def _require_constants(
    where: str, error: type[ModelError] | type[OptionError], beta: float | None, theta: float | None
) -> None:
    if beta is not None and not 0 <= beta < 1:
        raise error(
            f"{where}beta {beta:g}: allowed are 0 <= beta < 1; it is the share of the membrane that a step keeps"
        )
    if theta is not None and not 0 < theta < math.inf:
        raise error(f"{where}theta {theta:g}: allowed are numbers above 0; it is the threshold of a spike")


def _content(where: str, path: Path) -> bytes:
    """Bytes of the file."""
    if not path.is_file():
        raise ModelError(f"{where}: no such file; {GIVE}")
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise ModelError(f"{where}: cannot be read ({error.strerror or error}); check its permissions") from error
    if len(content) > SIZE_LIMIT:
        raise ModelError(f"{where}: more than {SIZE_LIMIT} bytes, the limit of a checkpoint; {GIVE}")
    return content


def _own_members(where: str, content: bytes) -> dict[str, bytes] | None:
    """Members of a file in our own format, or None if it is something else; no zip may claim more than it has."""
    if content[:2] != b"PK":
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            declared = sum(info.file_size for info in infos)
            if declared > len(content):
                raise ModelError(
                    f"{where}: {len(content)} bytes claim to hold {declared}, checkpoints are not compressed; "
                    "do not trust this file"
                )
            if "manifest.json" not in archive.namelist():
                return None
            return {info.filename: archive.read(info) for info in infos}
    except (zipfile.BadZipFile, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ModelError(f"{where}: {DAMAGED}") from error


def _manifest(where: str, content: bytes) -> dict[str, Any]:
    try:
        manifest = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{where}: {DAMAGED}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError(f"{where}: {NOT_A_CHECKPOINT}")
    if manifest.get("version") not in VERSIONS:
        raise ModelError(
            f"{where}: has format version {manifest.get('version')!r}, this program reads up to {VERSIONS[-1]}; "
            "update spikeloom"
        )
    return manifest


def _own_arrays(
    where: str, members: dict[str, bytes], weights: str | None
) -> tuple[
    Arrays,
    str,
    tuple[str, IntArray, dict[str, float], dict[str, Any]],
    tuple[str, Grid | None, Dynamics],
    tuple[tuple[Form, ...] | None, int],
]:
    """Arrays of one set, its name; graph, edges, constants, training record; system, grid, dynamics; forms, towers."""
    manifest = _manifest(where, members.pop("manifest.json"))
    try:
        arrays: Arrays = {name.removesuffix(".npy"): _read_npy(content) for name, content in members.items()}
    except ValueError as error:
        raise ModelError(f"{where}: {DAMAGED}") from error
    if content_digest(manifest, arrays) != manifest.get("sha256"):
        raise ModelError(f"{where}: its content does not match its hash, so it was altered; {_AGAIN}")
    try:
        sets = [name for name in WEIGHTS if name in manifest["weights"]]
        graph = manifest["graph"]
        edges = np.array(graph["edges"], np.int64).reshape(-1, 2)
        edges.flags.writeable = False
        held = {name: float(manifest[name]) for name in ("beta", "theta")}
        taxels, classes = int(manifest["taxels"]), int(manifest["classes"])
        facts = str(graph["name"]), edges, held, dict(manifest["training"])
        system = str(manifest["architecture"]) if manifest["version"] >= VERSIONS[2] else TACTILESGNET
        if system not in SYSTEMS:
            raise ValueError(f"architecture {system}")
        grid = grid_from_json(manifest["grid"]) if system == GRID_CNN else None
        dynamics, towers = PLAIN, 1
        if manifest["version"] == VERSIONS[4]:
            towers = manifest["towers"]
            if type(towers) is not int or towers < 2:
                raise ValueError(f"{towers} towers")
        if manifest["version"] == VERSIONS[3] or (towers > 1 and "dynamics" in manifest):
            stages = sum(re.fullmatch(r"[a-z]+/fc\d+\.weight", name) is not None for name in arrays) // len(sets)
            dynamics = dynamics_from_json(manifest["dynamics"], 1 + stages)
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise ModelError(f"{where}: has an incomplete manifest ({error!r}); {_AGAIN}") from error
    _require_constants(f"{where}: ", ModelError, held["beta"], held["theta"])
    if weights is None and sets:
        weights = sets[0]
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
    forms = _forms(where, manifest, chosen, towers, dynamics.clocks.channels)
    return chosen, weights, facts, (system, grid, dynamics), (forms, towers)


def _forms(where: str, manifest: dict[str, Any], arrays: Arrays, towers: int, clocks: int) -> tuple[Form, ...] | None:
    """Storage of every layer of a fine-tuned network; None for a plain file."""
    if manifest["version"] == VERSIONS[0] or (manifest["version"] >= VERSIONS[2] and "forms" not in manifest):
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
        heard = arrays["fc1.weight"].shape[1] - dynamics.clocks.channels
        places, made_classes = heard // features, len(arrays[f"fc{stages}.bias"])
        faults = faults or shape_faults(system, len(arrays["conv1.hops"]), places, taxels, grid)
        made_for = places if system in GRAPH_SYSTEMS else taxels, made_classes
        if not faults and made_for != (taxels, classes):
            faults = [
                f"made for {made_for[0]} taxels and {made_for[1]} classes, "
                f"the manifest says {taxels} taxels and {classes} classes"
            ]
    return faults


def _read_npy(content: bytes) -> Float32Array:
    """Parse the one kind of npy file that we write (version 1.0, float32, C order), trusting no size in it."""
    header = _NPY.match(content)
    if header is None or header.end() != 10 + int.from_bytes(content[8:10], "little"):
        raise ValueError("not an npy file of float32 in C order")
    shape = tuple(int(length) for length in re.findall(rb"\d+", header[1]))
    return np.frombuffer(content, "<f4", offset=header.end()).reshape(shape)
