"""``join`` of networks that were trained for TrueNorth."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.targets.truenorth.native import SYSTEM, NativeNetwork, joined
from spikeloom.compiler.targets.truenorth.native_file import Trained, read_trained, write_trained
from spikeloom.models.training.joined import Joined, JoinedTest, joined_layers
from spikeloom.runtime.inputs.files import require_place, shipped
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.report.console import progress

KEPT = ("command", "seed", "epochs", "recipe", "data", "data_sha256", "test_samples")
"""Parts of a network's training record that the joined one keeps, beside what the chosen weights reached."""


def join(arguments: argparse.Namespace) -> Joined:
    """Put the towers of several networks into one file; ModelError or OptionError if they do not fit together."""
    for name in arguments.checkpoints:
        require_place(arguments.output, "-o", argparse.Namespace(checkpoint=name))
    found = [read_trained(shipped(name), weights=arguments.weights) for name in arguments.checkpoints]
    towers = [
        record for name, trained in zip(arguments.checkpoints, found, strict=True) for record in _records(name, trained)
    ]
    if len(towers) < 2:
        raise OptionError(f"join: {arguments.checkpoints[0]} is one network already; give two or more")
    graphs = {(trained.graph, trained.edges.tobytes()) for trained in found}
    if len(graphs) > 1:
        names = ", ".join(trained.graph for trained in found)
        raise ModelError(f"join: the networks have other graphs: {names}; give networks of one kind")
    try:
        network = joined([trained.network for trained in found])
    except ValueError as error:
        raise ModelError(f"join: {', '.join(arguments.checkpoints)} {error}; give networks of one kind") from error
    words = [name if shipped(name) != name else Path(name).name for name in arguments.checkpoints]
    words += [f"--weights {arguments.weights}"] if arguments.weights else []
    words += ["--data", Path(arguments.data).name] if arguments.data is not None else []
    record: dict[str, Any] = {"command": f"spikeloom join {' '.join(words)}", "towers": towers}
    measured = None
    if arguments.data is not None:
        measured = _measured(arguments.data, network, {tower.get("data_sha256") for tower in towers})
        record["test"] = asdict(measured)
    sha256 = write_trained(
        arguments.output, {"last": network}, graph=found[0].graph, edges=found[0].edges, training=record
    )
    return Joined(
        command=str(record["command"]),
        towers=towers,
        test=measured,
        system=SYSTEM,
        graph=found[0].graph,
        classes=network.classes,
        layers=joined_layers(network.neurons),
        file=Path(arguments.output).name,
        sha256=sha256,
    )


def _measured(path: str, network: NativeNetwork, trained_on: set[str | None]) -> JoinedTest:
    """What the joined network reaches on the test split of the data that all its towers were trained on."""
    from spikeloom.models.training.protocols import data_digest  # torch, so only here
    from spikeloom.models.truenorth.network import predict

    progress("reading the recordings")
    training, test = (
        recordings(path, split, classes=network.classes, taxels=network.taxels, labels_for="join")
        for split in ("train", "test")
    )
    if trained_on != {data_digest(training, test)}:
        raise OptionError(f"--data {path}: the networks were trained on other recordings; give those")
    progress("measuring")
    correct = int(np.count_nonzero(predict(network, test) == test.labels))
    return JoinedTest(correct=correct, samples=len(test), accuracy=correct / len(test), data=Path(path).name)


def _records(name: str, trained: Trained) -> list[dict[str, Any]]:
    """Where each tower of a file is from."""
    training, count = trained.training, len(trained.network.towers)
    held = training.get("towers")
    if count > 1 and isinstance(held, list) and len(held) == count:
        return held
    kept = [key for key in (*KEPT, trained.weights) if key in training]
    origin = {"file": Path(name).name, "sha256": trained.sha256, "weights": trained.weights}
    return [origin | {key: training[key] for key in kept}] * count
