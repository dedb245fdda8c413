"""Ways in: networks of every format and kind, as files or in memory, and recordings of every format for them.

A way in is a function of :data:`WAYS_IN` that writes a network into a folder and says how it is read; every network of
the zoo is one.
"""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import made_files
import made_modules
import made_netx
import made_nir
import nir
import numpy as np
import torch
import zoo
from commands import run
from made_files import CLASSES, TAXELS
from timed_networks import written
from torch import nn

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint


@dataclass(frozen=True, kw_only=True)
class Made:
    """A network as a way in leaves it, and the recordings for it."""

    network: str | None  # File in its folder; None for what is in memory only
    taxels: int
    polarities: int = 2
    classes: int = CLASSES
    reading: str = ""  # Options that say how it is read
    compiling: str = ""  # Further options of ``compile``
    rounded: bool = True  # Whether there are weights to round
    window: int = 100  # Per cent of a recording that it takes
    lengths: tuple[int, ...] = (14, 9, 14, 6, 11)
    recorded: str = "folder"  # One of FORMATS
    module: Callable[[], tuple[nn.Module, torch.Tensor]] | None = None


# -- recordings --------------------------------------------------------------------------------------------------------
def _folder(path: Path, splits: dict[str, list[np.ndarray]], classes: int) -> None:
    made_files.recordings_folder(path, **splits, classes=classes)


def _zip(path: Path, splits: dict[str, list[np.ndarray]], classes: int) -> None:
    _folder(path.with_suffix(""), splits, classes)
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(path.with_suffix("").rglob("*.npy")):
            archive.write(file, file.relative_to(path.with_suffix("")))


def _each(path: Path, splits: dict[str, list[np.ndarray]], classes: int, ending: str):
    """Files of single recordings, and their arrays."""
    for split, recordings in splits.items():
        (path / split).mkdir(parents=True)
        for number, recording in enumerate(recordings):
            yield path / split / f"touch_{number}_label_{number % classes}.{ending}", recording


def _events(recording: np.ndarray) -> np.ndarray:
    """Times, taxels and polarities in the order of time, each in the middle of its bin."""
    step, taxel, polarity = np.nonzero(recording.transpose(2, 0, 1))
    return np.stack([(step + 0.5) * 0.02, taxel, polarity], axis=1)


def lines_of(recording: np.ndarray) -> list[str]:
    return [f"{time:.3f},{taxel:.0f},{polarity:.0f}" for time, taxel, polarity in _events(recording)]


def _csv(path: Path, splits: dict[str, list[np.ndarray]], classes: int) -> None:
    for file, recording in _each(path, splits, classes, "csv"):
        file.write_text("\n".join(["time_s,taxel,polarity", *lines_of(recording)]) + "\n")


def _event_arrays(path: Path, splits: dict[str, list[np.ndarray]], classes: int) -> None:
    for file, recording in _each(path, splits, classes, "npz"):
        time, taxel, polarity = _events(recording).T
        np.savez(file, time_s=time, taxel=taxel.astype(np.int64), polarity=polarity.astype(np.int64))


def _bin_arrays(path: Path, splits: dict[str, list[np.ndarray]], classes: int) -> None:
    for file, recording in _each(path, splits, classes, "npz"):
        np.savez(file, bins=recording.transpose(2, 0, 1))


FORMATS = {
    "folder": ("", _folder),
    "zip": (".zip", _zip),
    "csv": ("", _csv),
    "events": ("", _event_arrays),
    "bins": ("", _bin_arrays),
}
"""Ending and writer of each format of recordings."""


def _recordings(
    made: Made, samples: int, lengths: Sequence[int], rng: np.random.Generator
) -> list[np.ndarray]:
    """Random ones with an event in each bin, so that lines of events say their length."""
    found = []
    for sample in range(samples):
        steps = lengths[sample % len(lengths)]
        recording = made_files.sparse_events(rng, made.taxels, made.polarities, steps, rate=0.2)
        recording[
            np.arange(steps) % made.taxels, rng.integers(0, made.polarities, steps), np.arange(steps)
        ] = 1
        found.append(recording)
    return found


def record(folder: Path, made: Made) -> list[np.ndarray]:
    """Write recordings for a network, unless they are there; gives those of the test split."""
    rng = np.random.default_rng(7)
    splits = {
        split: _recordings(made, samples, made.lengths, rng)
        for split, samples in (("train", 8), ("test", 5))
    }
    ending, write = FORMATS[made.recorded]
    if not (folder / f"data{ending}").exists():
        write(folder / f"data{ending}", splits, made.classes)
    return splits["test"]


# -- ways in -----------------------------------------------------------------------------------------------------------
WAYS_IN: dict[str, Callable[[Path], Made]] = {}


def way_in(name: str) -> Callable[[Callable[[Path], Made]], Callable[[Path], Made]]:
    """Register a way in by the function that makes it in a folder."""

    def register(make: Callable[[Path], Made]) -> Callable[[Path], Made]:
        WAYS_IN[name] = make
        return make

    return register


def _specimen(name: str, recorded: str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        network, taxels, reading, compiling = zoo.MAKERS[name](folder)
        long = name == "binned"
        return Made(
            network=network,
            taxels=taxels,
            classes=made_modules.CLASSES if name == "onnx" else CLASSES,
            reading=reading,
            compiling=compiling,
            rounded=name in zoo.FLOAT,
            lengths=(41, 23, 40) if long else (zoo.STEPS,) if name in ("mlp", "onnx") else Made.lengths,
            recorded=recorded,
        )

    return make


for _number, _name in enumerate(zoo.MAKERS):
    WAYS_IN[_name] = _specimen(_name, list(FORMATS)[_number % len(FORMATS)])


def _ring(folder: Path) -> str:
    lines = [f"{source},{target}" for source, target in made_files.ring().edges.tolist()]
    (folder / "ring.csv").write_text("\n".join(["source,target", *lines]))
    return "--edges {folder}/ring.csv"


@way_in("released")
def _released(folder: Path) -> Made:
    """A file of two runs, as TactileSGNet's authors save them; the second is asked for."""
    states = [made_files.state_dict(made_files.weights(seed), old=True) for seed in (3, 4)]
    (folder / "net.t7").write_bytes(made_files.torch_bytes(made_files.released(*states), new=False))
    return Made(network="net.t7", taxels=TAXELS, reading=f"{_ring(folder)} --run 1")


@way_in("state dict")
def _state_dict(folder: Path) -> Made:
    (folder / "net.pth").write_bytes(made_files.torch_bytes(made_files.state_dict(made_files.weights(5))))
    return Made(network="net.pth", taxels=TAXELS, reading=_ring(folder), recorded="zip")


@way_in("module")
def _module(folder: Path) -> Made:
    def module() -> tuple[nn.Module, torch.Tensor]:
        return made_modules.tag(), made_modules.example_of("tag")

    return Made(network=None, taxels=TAXELS, classes=made_modules.CLASSES, module=module, recorded="csv")


@way_in("window")
def _window(folder: Path) -> Made:
    """Trained on half of each recording, whose bins it joins."""
    written(folder / "float.pt", dynamics=zoo.PLAIN)
    facts = {"training": {"window": 50}, "bins": 3}
    zoo.stored(folder / "net.pt", read_checkpoint(folder / "float.pt"), **facts)
    return Made(network="net.pt", taxels=39, window=50, lengths=(28, 14, 26, 41))


@way_in("free-running")
def _free_running(folder: Path) -> Made:
    made_files.own_file(folder / "net.pt", last=made_files.weights(2))
    return Made(network="net.pt", taxels=TAXELS, compiling="--free-running", recorded="bins")


def _of_polarities(polarities: int) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        rng = np.random.default_rng(polarities)
        channels = polarities * 3
        nodes = [
            made_nir.affine(rng, 10, channels, 1.5),
            made_nir.lif(10, r=2.0),
            made_nir.affine(rng, CLASSES, 10, 1.5),
            made_nir.lif(CLASSES, r=2.0),
        ]
        nir.write(folder / "net.nir", made_nir.chain(*nodes))
        reading = f"--dt 0.02 --polarities {polarities}"
        recorded = "bins" if polarities > 1 else "folder"
        return Made(network="net.nir", taxels=3, polarities=polarities, reading=reading, recorded=recorded)

    return make


for _number in (1, 3, 8):
    WAYS_IN[f"polarities {_number}"] = _of_polarities(_number)


@way_in("netx of polarities")
def _netx_polarities(folder: Path) -> Made:
    rng = np.random.default_rng(0)
    layers = ((12, 15), (CLASSES, 12))
    made_netx.write(folder / "net.net", *(made_netx.dense(made_netx.even(rng, *shape)) for shape in layers))
    return Made(network="net.net", taxels=5, polarities=3, reading="--polarities 3", rounded=False)


def _own_with_data(folder: Path, **facts: Any) -> Made:
    """A small network of floats, and recordings in their place, for commands that make another network of them."""
    made_files.own_file(folder / "float.pt", last=made_files.weights(6), **facts)
    made = Made(network="net.pt", taxels=TAXELS)
    record(folder, made)
    return made


def ran(*words: object) -> None:
    """Run a command that has to succeed."""
    code, _, err = run(*words)
    assert code == 0, err


@way_in("fine-tuned by command")
def _fine_tuned(folder: Path) -> Made:
    made = _own_with_data(folder)
    tune = ["--data", folder / "data", "--weight-bits", "4", "--epochs", "1"]
    ran("finetune", folder / "float.pt", *tune, "-o", folder / "net.pt")
    return made


@way_in("NIR fine-tuned by command")
def _fine_tuned_nir(folder: Path) -> Made:
    _, taxels, reading, _ = zoo.recurrent(folder)
    made = Made(network="tuned.nir", taxels=taxels)
    record(folder, made)
    tune = ["--data", folder / "data", "--weight-bits", "4", "--epochs", "1"]
    ran("finetune", folder / "net.nir", *reading.split(), *tune, "-o", folder / "tuned.nir")
    return made


@way_in("joined by command")
def _joined(folder: Path) -> Made:
    for seed in (1, 2, 3):
        facts = {"window": 50}
        made_files.own_file(folder / f"{seed}.pt", last=made_files.weights(seed), training=facts)
    ran("join", *(folder / f"{seed}.pt" for seed in (1, 2, 3)), "-o", folder / "net.pt")
    return Made(network="net.pt", taxels=TAXELS, window=50)


@way_in("pruned")
def _pruned(folder: Path) -> Made:
    made = _own_with_data(folder)
    ran(
        "lean",
        folder / "float.pt",
        "--data",
        folder / "data",
        "--differ",
        "0.4",
        "--network",
        folder / "net.pt",
    )
    return made


@way_in("trained counters")
def _trained_counters(folder: Path) -> Made:
    made = Made(network="net.pt", taxels=TAXELS, lengths=(24, 13, 20), recorded="events")
    record(folder, made)
    train = ["train", "--data", folder / "data", "--system", "counters", "--join", "2", "--parts", "2"]
    ran(*train, "--window", "60%", "--thresholds", "1,2", "--ramp", "8", "-o", folder / "net.pt")
    return made
