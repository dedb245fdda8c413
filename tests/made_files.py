"""Small checkpoints and recordings on disk, for the tests that go through files and the command line."""

import io
import json
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spikeloom.compiler.archive import ZIP_DATE, read_npy
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.formats.own_checkpoint import content_digest, save_checkpoint
from spikeloom.models.graphs import Graph, normalised_adjacency
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.grasps import synthetic_grasps
from spikeloom.models.recordings.release import write_released

TAXELS, FEATURES, CLASSES, STEPS = 6, 5, 4, 24


def zipped(members: Mapping[str, bytes | str], compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of these members; equal members give equal bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, ZIP_DATE), content, compression)
    return file.getvalue()


def torch_bytes(content: object, *, new: bool = True, protocol: int = 2) -> bytes:
    """What torch writes; `new` is a zip, as since 1.6."""
    file = io.BytesIO()
    torch.save(content, file, _use_new_zipfile_serialization=new, pickle_protocol=protocol)
    return file.getvalue()


def ring(taxels: int = TAXELS) -> Graph:
    """Each taxel is joined to its two neighbours."""
    pairs = [(i, (i + 1) % taxels) for i in range(taxels)]
    return Graph(
        name="ring",
        coordinates=np.arange(taxels, dtype=float)[:, None],
        edges=np.array(pairs + [(b, a) for a, b in pairs]),
    )


def weights(
    seed: int = 0,
    *,
    taxels: int = TAXELS,
    features: int = FEATURES,
    hops: int = 4,
    sizes=(9, 8, CLASSES),
    gain=1.6,
) -> dict[str, np.ndarray]:
    """Random float32 weights of a TactileSGNet under the names of our own format; lively at the default gain."""
    rng = np.random.default_rng(seed)

    def draw(*shape, spread):
        return rng.normal(0, spread, shape).astype(np.float32)

    found = {
        "conv1.hops": draw(hops, features, 2, spread=0.5 * gain),
        "conv1.bias": draw(features, spread=0.1),
    }
    widths = (taxels * features, *sizes)
    for i, (before, size) in enumerate(zip(widths[:-1], sizes, strict=True), 1):
        found[f"fc{i}.weight"] = draw(size, before, spread=gain * before**-0.5)
        found[f"fc{i}.bias"] = draw(size, spread=0.1)
    return found


def state_dict(arrays: dict[str, np.ndarray], *, old: bool = False) -> dict[str, torch.Tensor]:
    """The same weights with the keys of current torch_geometric, or of old releases."""
    named = {name: array for name, array in arrays.items() if not name.startswith("conv1")}
    hops, bias = arrays["conv1.hops"], arrays["conv1.bias"]
    if old:
        conv = {"conv1.lin.weight": np.concatenate(list(hops), axis=1), "conv1.lin.bias": bias}
    else:
        conv = {"conv1.bias": bias} | {f"conv1.lins.{k}.weight": hop for k, hop in enumerate(hops)}
    return {name: torch.tensor(array) for name, array in (conv | named).items()}


def released(*states: dict[str, torch.Tensor]) -> dict:
    """What the released training script saves."""
    return {
        "net_list": list(states),
        "num_epochs": 100,
        "best_acc": torch.tensor([90.2777 - run for run in range(len(states))]),
    }


def graph_facts(graph: Graph) -> dict[str, Any]:
    """What a checkpoint holds of a graph, as keywords of `save_checkpoint`."""
    return {"taxels": graph.n_taxels, "graph": graph.name, "edges": graph.edges}


def own_file(
    path: Path, *, last=None, best=None, graph: Graph | None = None, beta=0.2, theta=0.5, training=None
) -> Path:
    """Write a checkpoint in our own format."""
    sets = {"last": last or weights()} | ({} if best is None else {"best": best})
    constants = {"beta": beta, "theta": theta, "training": training or {"seed": 0}}
    save_checkpoint(path, sets, **graph_facts(graph or ring()), **constants)
    return path


def checkpoint_bytes(sets: dict, graph: Graph, **options) -> bytes:
    """What our own format makes of weights."""
    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder) / "x.pt", sets, **graph_facts(graph), **options)
        return (Path(folder) / "x.pt").read_bytes()


def small_checkpoint(folder: Path, **options) -> tuple[Checkpoint, np.ndarray]:
    """A checkpoint read back from a file, and the propagation matrix of its graph."""
    checkpoint = read_checkpoint(own_file(folder / "small.pt", **options))
    return checkpoint, normalised_adjacency(checkpoint.edges, checkpoint.taxels)


def events(
    seed: int = 0, *, samples: int = 6, taxels: int = TAXELS, steps: int = STEPS, rate: float = 0.2
) -> np.ndarray:
    """Random recordings, (samples, taxels, 2, steps) uint8."""
    return sparse_events(seed, samples, taxels, 2, steps, rate=rate)


def sparse_events(seed: int | np.random.Generator, *shape: int, rate: float) -> np.ndarray:
    """Random events of any shape, uint8; a generator in the place of a seed is drawn from."""
    return (np.random.default_rng(seed).random(shape) < rate).astype(np.uint8)


def recordings_folder(
    folder: Path, *, train: np.ndarray | None = None, test: np.ndarray | None = None, classes: int = CLASSES
) -> Path:
    """Write recordings in the released layout, labels in turn."""
    for split, made in (("train", train if train is not None else events(1)), ("test", test)):
        (folder / split).mkdir(parents=True)
        for i, recording in enumerate(made if made is not None else events(2)):
            np.save(folder / split / f"sample_{i}_label_{i % classes}.npy", recording.astype(np.float32))
    return folder


def grasps_folder(folder: Path, **kind) -> list[Recordings]:
    """Write made grasps in the released layout, a seed for each split; keywords as of `synthetic_grasps`."""
    seeds = {"train": 1, "test": 2}
    grasps = [replace(synthetic_grasps(seed=seed, **kind), split=split) for split, seed in seeds.items()]
    write_released(folder, grasps)
    return grasps


def recorded(events: np.ndarray, labels: np.ndarray | None = None, split: str = "train") -> Recordings:
    """The same in memory."""
    labels = np.arange(len(events)) % CLASSES if labels is None else labels
    files = tuple(f"{i}.npy" for i in range(len(events)))
    return Recordings(held=events, labels=labels, files=files, split=split, source="made")


def csv_folder(folder: Path, *, taxels: int = TAXELS, samples: int = 8, classes: int = CLASSES) -> Path:
    """Write event files of about a second, each class with a taxel that it likes."""
    folder.mkdir(parents=True)
    for i in range(samples):
        rng = np.random.default_rng(i)
        taxel = np.where(rng.random(90) < 0.5, i % classes, np.arange(90)) % taxels
        lines = [f"{0.011 * k:.3f},{taxel[k]},{rng.integers(0, 2)}" for k in range(90)]
        (folder / f"tap_{i}_label_{i % classes}.csv").write_text(
            "\n".join(["time_s,taxel,polarity", *lines])
        )
    return folder


def rebuilt(
    content: bytes, change: object, *, sign: bool = True, compression: int = zipfile.ZIP_STORED
) -> bytes:
    """Our own format with changed members; signed anew unless told otherwise."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(members["manifest.json"])
    change(manifest, members)
    if sign:
        arrays = {n.removesuffix(".npy"): read_npy(m) for n, m in members.items() if n.endswith(".npy")}
        manifest["sha256"] = content_digest(manifest, arrays)
    return zipped(members | {"manifest.json": json.dumps(manifest)}, compression)
