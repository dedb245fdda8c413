"""Ways out that need training, priced by the networks that the package ships: what they reached, cores and ticks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from spikeloom.compiler.formats.checkpoint import Checkpoint, read_checkpoint
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.lower import cores_needed
from spikeloom.compiler.targets.truenorth.native import highest_level
from spikeloom.compiler.targets.truenorth.native_file import Trained, is_trained, read_trained
from spikeloom.runtime.inputs.files import PRETRAINED

Json = dict[str, Any]

PROTOCOLS = ("clean", "last", "best")
"""Epochs of a training record, first the one whose test figure was not chosen by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shipped:
    """A shipped network that was trained for crossbar cores.

    Parameters
    ----------
    name : str
        As it is typed.
    accuracy : float
        Share of its test recordings that it decides rightly.
    samples : int
        So many they are.
    data : str
        Where they are from.
    cores : int
        Of the whole network.
    depth : int
        Ticks that a decision takes beside those of the data.
    levels, inputs, towers : int
        Of its weights; of a group of its first dense layer, without clocks; side by side.
    commands : tuple of str
        That make it.
    """

    name: str
    accuracy: float
    samples: int
    data: str
    cores: int
    depth: int
    levels: int
    inputs: int
    towers: int
    commands: tuple[str, ...]


def shipped_networks(
    chip: Target, *, taxels: int, classes: int, checkpoint: Checkpoint | None = None
) -> tuple[Shipped, ...]:
    """Shipped networks in whole numbers for the sensor and the classes of another one, the smallest first.

    Parameters
    ----------
    chip : Target
    taxels, classes : int
        Of the other network.
    checkpoint : Checkpoint, optional
        Of the other one; where it says on what it was trained, others are left out.
    """
    trained_on = None if checkpoint is None else (checkpoint.training or {}).get("data_sha256")
    found: list[Shipped] = []
    for file in _files("*.pt"):
        if is_trained(file):
            trained = read_trained(file)
            record = _record(trained.training)
            own = trained.network.taxels, trained.network.classes
            if own == (taxels, classes) and trained_on in (None, record.get("data_sha256")):
                found += _priced(file, trained, record, chip)
    return tuple(sorted(found, key=lambda each: each.cores))


def accuracy_on(graph: str, like: Shipped) -> tuple[str, float, str] | None:
    """Name, test accuracy and command of the shipped network for Loihi on another graph, trained on the same data.

    None where there is none that says what it reached.
    """
    for file in _files(f"*-{re.sub(r'[^A-Za-z0-9.]+', '', graph)}.pt"):
        training = read_checkpoint(file).training or {}
        reached = _reached(training)
        if reached is not None and training.get("data") == like.data and "command" in training:
            return f"{PRETRAINED}{file.stem}", reached[0] / reached[1], str(training["command"])
    return None


def _files(pattern: str) -> Iterator[Path]:
    yield from sorted(Path(str(resources.files("spikeloom.models") / "pretrained")).glob(pattern))


def _record(training: Mapping[str, Any]) -> Mapping[str, Any]:
    """What is known of the data: of a joined network from its first tower."""
    towers = training.get("towers")
    return towers[0] if isinstance(towers, list) and towers else training


def _reached(training: Mapping[str, Any]) -> tuple[int, int] | None:
    """Test recordings that were decided rightly, and all of them."""
    if isinstance(training.get("test"), Mapping):
        return int(training["test"]["correct"]), int(training["test"]["samples"])
    for which in PROTOCOLS:
        if isinstance(training.get(which), Mapping) and "correct" in training[which]:
            return int(training[which]["correct"]), int(training["test_samples"])
    return None


def _priced(file: Path, trained: Trained, record: Mapping[str, Any], chip: Target) -> Iterator[Shipped]:
    network, reached = trained.network, _reached(trained.training)
    if reached is None:
        return
    correct, samples = reached
    towers = trained.training.get("towers")
    parts = towers if isinstance(towers, list) else []
    commands = [*(str(part.get("command")) for part in parts), str(trained.training.get("command"))]
    yield Shipped(
        name=f"{PRETRAINED}{file.stem}",
        accuracy=correct / samples,
        samples=samples,
        data=str(record.get("data")),
        cores=cores_needed(network, chip),
        depth=len(network.towers[0]) - 1,
        levels=2 * highest_level(network.copies) + 1,
        inputs=int(network.towers[0][1].inputs.shape[1]),
        towers=len(network.towers),
        commands=tuple(commands),
    )
