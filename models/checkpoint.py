"""Write our own checkpoint format; :mod:`compiler.frontends.checkpoint` describes and reads it."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from compiler.atomic import write_atomically
from compiler.frontends.checkpoint import FORMAT, VERSION, arrays_digest
from models.evtouch import Recordings
from models.graphs import Graph
from models.train import Trained

_EPOCH = (1980, 1, 1, 0, 0, 0)

Tensors = Mapping[str, npt.NDArray[np.float32]]


def training_record(
    trained: Trained, training: Recordings, test: Recordings, *, command: str, seed: int
) -> dict[str, Any]:
    """Everything needed to repeat a training, and what it reached; JSON values only.

    The best epoch is chosen on the test split, as the published figures are; the last one is not chosen at all.
    """
    last, best = trained.history[-1], trained.history[trained.best_epoch - 1]
    return {
        "command": command,
        "seed": seed,
        "epochs": len(trained.history),
        "data": training.source,
        "data_sha256": arrays_digest(
            {
                "train": training.events,
                "train_labels": training.labels,
                "test": test.events,
                "test_labels": test.labels,
            }
        ),
        "test_samples": last.tested,
        "last": {"epoch": last.epoch, "correct": last.correct, "accuracy": last.accuracy},
        "best": {"epoch": best.epoch, "correct": best.correct, "accuracy": best.accuracy},
        "best_note": "epoch chosen on the test split",
        "history": [[e.training_loss, e.test_loss, e.correct] for e in trained.history],
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


def checkpoint_bytes(
    weights: Mapping[str, Tensors],
    graph: Graph,
    *,
    beta: float,
    theta: float,
    training: Mapping[str, Any],
) -> bytes:
    """File content of a checkpoint; equal input gives equal bytes.

    Parameters
    ----------
    weights : mapping of ``last`` and optionally ``best`` to tensors
        ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, ``fc1.weight``, ``fc1.bias`` … float32.
    graph : Graph
        What it was trained on.
    beta, theta : float
        Decay and threshold.
    training : mapping
        JSON values: how it was made and what it reached.
    """
    arrays = {
        f"{which}/{name}": np.ascontiguousarray(array, "<f4")
        for which, tensors in weights.items()
        for name, array in sorted(tensors.items())
    }
    stages = [name for name in weights["last"] if name.endswith(".bias") and name.startswith("fc")]
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "architecture": "tactilesgnet",
        "taxels": graph.n_taxels,
        "classes": len(weights["last"][max(stages)]),
        "beta": beta,
        "theta": theta,
        "graph": {"name": graph.name, "edges": graph.edges.tolist()},
        "weights": list(weights),
        "training": dict(training),
        "sha256": arrays_digest(arrays),
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("manifest.json", date_time=_EPOCH), json.dumps(manifest, indent=1))
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH), content.getvalue())
    return file.getvalue()


def save_checkpoint(
    path: str | os.PathLike[str],
    weights: Mapping[str, Tensors],
    graph: Graph,
    *,
    beta: float,
    theta: float,
    training: Mapping[str, Any],
) -> None:
    """Write a checkpoint, whole or not at all; parameters as :func:`checkpoint_bytes`.

    Raises
    ------
    OSError
        If the file cannot be written; an older file is left as it was.
    """
    content = checkpoint_bytes(weights, graph, beta=beta, theta=theta, training=training)
    with write_atomically(path) as file:
        file.write(content)
