"""Read trained TactileSGNet checkpoints: our own files, the released layout and bare state dicts.

Our own format, version 1, is a plain zip that needs neither pickle nor torch:

``manifest.json``
    ``format`` ("spikeloom-checkpoint"), ``version``, ``architecture`` ("tactilesgnet"), ``taxels``, ``classes``,
    ``beta``, ``theta``, ``graph`` (``name`` and ``edges``, pairs of source and target, repeats adding up),
    ``weights`` (the sets in the file: ``last``, and ``best`` where the epoch that did best on the test split was
    kept), ``training`` (how it was made and what it reached) and ``sha256`` over all arrays.
``last/NAME.npy``, ``best/NAME.npy``
    ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, and ``weight`` and ``bias`` of ``fc1``, ``fc2`` …

The released layout is a ``.t7`` file of ``torch.save``: a dict whose ``net_list`` holds one state dict per run, with
the weights of the *last* epoch, while ``best_acc`` belongs to the best one. It holds no graph, no decay and no threshold.
torch is imported only to read that one, always with ``weights_only=True``.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from compiler.errors import ModelError
from compiler.fixedpoint import IntArray

FORMAT = "spikeloom-checkpoint"
VERSION = 1
BETA, THETA = 0.2, 0.5
"""Decay and threshold of the released code; files in its layout do not hold them."""

SIZE_LIMIT = 2**28
"""Bytes that a checkpoint may have, packed or unpacked: 256 MiB, a hundred times the released ones."""

WEIGHTS = ("last", "best")

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dense:
    """A fully connected stage.

    Parameters
    ----------
    name : str
        ``fc1`` …
    weight : (outputs, inputs) float32
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
    hops : (K + 1, features, channels) float32
        Filters of the graph convolution.
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
    training : mapping or None
        JSON values: how it was made and what it reached.
    sha256 : str
        Of the file.
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
    training: Mapping[str, Any] | None
    sha256: str

    @property
    def taxels(self) -> int:
        """Number of taxels that the first fully connected stage was trained on."""
        return int(self.dense[0].weight.shape[1] // self.hops.shape[1])

    @property
    def classes(self) -> int:
        """Number of classes."""
        return len(self.dense[-1].bias)


def arrays_digest(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Hash over names, types, shapes and bytes of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}\n".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def read_checkpoint(
    path: str | os.PathLike[str],
    *,
    run: int = 0,
    weights: str = "last",
    beta: float | None = None,
    theta: float | None = None,
) -> Checkpoint:
    """Read a checkpoint of any known layout.

    Parameters
    ----------
    path : path
        File.
    run : int
        Which run of a released file.
    weights : {"last", "best"}
        Which epoch, where the file holds both.
    beta, theta : float, optional
        Decay and threshold; taken from the file, or from the released code where the file does not say.

    Raises
    ------
    ModelError
        If the file is no checkpoint, holds code, is damaged, or its tensors do not make a TactileSGNet.
    """
    where = str(path)
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{where}: no such file; give a checkpoint (.pt, .t7)")
    if path.stat().st_size > SIZE_LIMIT:
        raise ModelError(
            f"{where}: {path.stat().st_size} bytes, {SIZE_LIMIT} allowed; this is no TactileSGNet checkpoint"
        )
    content = path.read_bytes()
    declared = _declared_size(content)
    if declared > SIZE_LIMIT:
        raise ModelError(f"{where}: unpacks to {declared} bytes, {SIZE_LIMIT} allowed; refused")
    manifest = _read_manifest(where, content)
    if manifest is not None:
        tensors = _own_tensors(where, content, manifest, weights)
        layout, training = "spikeloom", manifest.get("training")
        if run != 0:
            raise ModelError(f"{where}: --run {run}: the file holds one run; leave --run away")
    else:
        loaded = _torch_load(where, content)
        tensors, layout, training = _released_tensors(where, loaded, run)
        if weights != "last":
            raise ModelError(f"{where}: --weights {weights}: the file holds the last epoch only; leave --weights away")
    hops, bias, dense = _assemble(where, tensors)
    graph = (manifest or {}).get("graph") or {}
    values = {"beta": (beta, BETA), "theta": (theta, THETA)}
    found = {name: given if given is not None else (manifest or {}).get(name) for name, (given, _) in values.items()}
    checkpoint = Checkpoint(
        hops=hops,
        conv_bias=bias,
        dense=dense,
        beta=float(BETA if found["beta"] is None else found["beta"]),
        theta=float(THETA if found["theta"] is None else found["theta"]),
        assumed=tuple(name for name, value in found.items() if value is None),
        graph=graph.get("name"),
        edges=np.array(graph["edges"], np.int64).reshape(-1, 2) if "edges" in graph else None,
        layout=layout,
        training=training,
        sha256=hashlib.sha256(content).hexdigest(),
    )
    if not (0 <= checkpoint.beta < 1 and 0 < checkpoint.theta < np.inf):
        raise ModelError(
            f"{where}: beta {checkpoint.beta:g}, theta {checkpoint.theta:g}: allowed are 0 <= beta < 1 and theta > 0; "
            "correct --beta or --theta"
        )
    return checkpoint


def _declared_size(content: bytes) -> int:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return sum(info.file_size for info in archive.infolist())
    except zipfile.BadZipFile:
        return 0


def _read_manifest(where: str, content: bytes) -> dict[str, Any] | None:
    """Manifest of our own format, or None if the file is something else."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if "manifest.json" not in archive.namelist():
                return None
            manifest = json.loads(archive.read("manifest.json"))
    except zipfile.BadZipFile:
        return None
    except ValueError as error:
        raise ModelError(f"{where}: has an unreadable manifest; the file is damaged") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ModelError(f"{where}: is an archive but not a checkpoint; give a checkpoint (.pt, .t7)")
    if manifest.get("version") != VERSION:
        raise ModelError(
            f"{where}: has format version {manifest.get('version')}, this program reads {VERSION}; update spikeloom"
        )
    return manifest


def _own_tensors(where: str, content: bytes, manifest: dict[str, Any], weights: str) -> dict[str, npt.NDArray[Any]]:
    held = manifest.get("weights", [])
    if weights not in held:
        raise ModelError(f"{where}: --weights {weights}: the file holds {', '.join(held)}; choose one of these")
    arrays: dict[str, npt.NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for name in archive.namelist():
                if name.endswith(".npy"):
                    member = io.BytesIO(archive.read(name))
                    arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
    except (zipfile.BadZipFile, ValueError, EOFError) as error:
        raise ModelError(f"{where}: is truncated or damaged ({error}); copy or train it again") from error
    if arrays_digest(arrays) != manifest.get("sha256"):
        raise ModelError(f"{where}: its arrays do not match its hash, so it was altered; copy or train it again")
    return {name.removeprefix(f"{weights}/"): array for name, array in arrays.items() if name.startswith(f"{weights}/")}


def _torch_load(where: str, content: bytes) -> Any:
    import pickle

    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # old files make torch warn about its own storage classes
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        unsafe = (
            "Unsupported global" in str(error) or "Unsupported class" in str(error) or "WeightsUnpickler" in str(error)
        )
        if unsafe:
            raise ModelError(
                f"{where}: holds code or objects beside weights and is not loaded; save its state_dict instead"
            ) from error
        raise ModelError(f"{where}: is not a checkpoint or is damaged; give a checkpoint (.pt, .t7)") from error
    except (
        RuntimeError,
        EOFError,
        ValueError,
        KeyError,
        IndexError,
        AttributeError,
        TypeError,
        OSError,
        AssertionError,
    ) as e:
        raise ModelError(f"{where}: is not a checkpoint or is damaged; give a checkpoint (.pt, .t7)") from e


def _released_tensors(
    where: str, loaded: Any, run: int
) -> tuple[dict[str, npt.NDArray[Any]], str, dict[str, Any] | None]:
    import torch

    layout, training = "state_dict", None
    state = loaded
    if isinstance(loaded, dict) and "net_list" in loaded:
        runs = loaded["net_list"]
        if not isinstance(runs, list) or not runs:
            raise ModelError(f"{where}: net_list holds no run; give another file")
        if not 0 <= run < len(runs):
            raise ModelError(f"{where}: --run {run}: the file holds runs 0 to {len(runs) - 1}; choose one of these")
        layout, state = "released", runs[run]
        training = {"runs": len(runs), "epoch": "last", "epochs": _plain(loaded.get("num_epochs"))}
        best = loaded.get("best_acc")
        if isinstance(best, torch.Tensor) and best.numel() > run:
            training["best_acc"] = round(float(best.flatten()[run]), 4)
            training["best_acc_note"] = "of the best epoch on the test split, not of these weights"
    elif run != 0:
        raise ModelError(f"{where}: --run {run}: the file holds one run; leave --run away")
    if not isinstance(state, Mapping) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise ModelError(f"{where}: holds no state dict of tensors; give a checkpoint (.pt, .t7)")
    tensors = {str(name): tensor.detach().cpu().float().numpy() for name, tensor in state.items()}
    return _unify_convolution(tensors), layout, training


def _plain(value: Any) -> Any:
    return value if isinstance(value, int | float | str) else None


def _unify_convolution(tensors: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Bring both key styles of torch_geometric's TAGConv to ``conv1.hops`` and ``conv1.bias``."""
    found = dict(tensors)
    old = found.pop("conv1.lin.weight", None)
    if old is not None:
        # old releases: one linear map on the concatenated hops, (features, (K + 1) * channels), two channels
        if old.ndim == 2 and old.shape[1] % 2 == 0:
            found["conv1.hops"] = old.reshape(len(old), -1, 2).transpose(1, 0, 2)
        if "conv1.lin.bias" in found:
            found["conv1.bias"] = found.pop("conv1.lin.bias")
        return found
    hops = {int(key.split(".")[2]): key for key in found if re.fullmatch(r"conv1\.lins\.\d+\.weight", key)}
    if hops and sorted(hops) == list(range(len(hops))):
        parts = [found.pop(hops[k]) for k in range(len(hops))]
        if all(part.ndim == 2 and part.shape == parts[0].shape for part in parts):
            found["conv1.hops"] = np.stack(parts)
    return found


def _assemble(where: str, tensors: dict[str, npt.NDArray[Any]]) -> tuple[Float32Array, Float32Array, tuple[Dense, ...]]:
    """Check names, shapes and values; every fault is listed."""
    stages = sorted({int(m[1]) for key in tensors if (m := re.fullmatch(r"fc([1-9])\.(?:weight|bias)", key))})
    last = max([3, *stages])
    expected = ["conv1.hops", "conv1.bias"]
    expected += [f"fc{i}.{part}" for i in range(1, last + 1) for part in ("weight", "bias")]
    shown = {"conv1.hops": "conv1.lins.0.weight … (or conv1.lin.weight)"}
    faults = [f"{shown.get(name, name)} is missing" for name in expected if name not in tensors]
    faults += [f"{name} is not part of a TactileSGNet" for name in sorted(set(tensors) - set(expected))]
    for name in expected:
        array = tensors.get(name)
        if array is not None:
            dims = 3 if name == "conv1.hops" else 2 if name.endswith("weight") else 1
            if array.dtype.kind not in "fiu" or array.ndim != dims or not array.size:
                faults.append(f"{name} has shape {array.shape}, {dims} dimensions are needed")
            elif bad := int(np.count_nonzero(~np.isfinite(array))):
                faults.append(f"{name} has {bad} values that are NaN or infinite")
    if not faults:
        faults = _shape_faults(tensors, last)
    if faults:
        raise ModelError(f"{where}: {'; '.join(faults)}; give the state dict of a TactileSGNet")
    dense = tuple(
        Dense(
            name=f"fc{i}",
            weight=tensors[f"fc{i}.weight"].astype(np.float32),
            bias=tensors[f"fc{i}.bias"].astype(np.float32),
        )
        for i in range(1, last + 1)
    )
    return tensors["conv1.hops"].astype(np.float32), tensors["conv1.bias"].astype(np.float32), dense


def _shape_faults(tensors: dict[str, npt.NDArray[Any]], last: int) -> list[str]:
    faults = []
    features = tensors["conv1.hops"].shape[1]
    if len(tensors["conv1.bias"]) != features:
        faults.append(f"conv1.bias has {len(tensors['conv1.bias'])} values for {features} features")
    inputs = tensors["fc1.weight"].shape[1]
    if inputs % features:
        faults.append(f"fc1.weight has {inputs} inputs, not a whole number of taxels with {features} features each")
    for i in range(1, last + 1):
        outputs, inputs = tensors[f"fc{i}.weight"].shape
        if len(tensors[f"fc{i}.bias"]) != outputs:
            faults.append(f"fc{i}.bias has {len(tensors[f'fc{i}.bias'])} values for {outputs} neurons")
        if i > 1 and inputs != tensors[f"fc{i - 1}.weight"].shape[0]:
            faults.append(
                f"fc{i}.weight has {inputs} inputs, fc{i - 1} has {tensors[f'fc{i - 1}.weight'].shape[0]} neurons"
            )
    return faults
