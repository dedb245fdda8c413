"""Join trained networks into one whose votes add up."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import remove_leftovers, sha256_of
from spikeloom.compiler.formats.own_checkpoint import save_again
from spikeloom.compiler.formats.tensors import join as side_by_side
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.evtouch import WHOLE
from spikeloom.runtime.inputs.checkpoint import load_checkpoint
from spikeloom.runtime.inputs.files import require_place, shipped
from spikeloom.runtime.report.checkpoints import LayerSize, tower_line
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.sections import Section, Text
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.choices import CheckpointChoice
from spikeloom.runtime.requests.training import JoinRequest

KEPT = (
    "command",
    "seed",
    "epochs",
    "recipe",
    "data",
    "data_sha256",
    "train_sha256",
    "bin_s",
    "class_names",
    "window",
    "positions_mm",
    "test_samples",
    "fine_tuned_from",
)
"""Parts of a network's training record that the joined one keeps, beside what the chosen weights reached."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Joined(Shown):
    """Networks that were joined; `towers` holds the file, hash and training record of each."""

    command: str
    towers: Sequence[Mapping[str, Any]]
    system: str
    graph: str | None
    classes: int
    layers: Sequence[LayerSize]
    file: str
    sha256: str


def join(request: JoinRequest) -> Joined:
    """Join checkpoints and write the one that holds them all."""
    require_place(request.output, "-o", request, ["pt"])
    checkpoints = [_network(name, request.weights) for name in request.checkpoints]
    pairs = zip(request.checkpoints, checkpoints, strict=True)
    records = [_records(name, checkpoint) for name, checkpoint in pairs]
    towers = list(chain.from_iterable(records))
    if len(towers) < 2:
        raise OptionError(f"join: {request.checkpoints[0]} is one network already; give two or more")
    _warn_of_twice(records)
    joined = side_by_side(checkpoints, request.checkpoints)
    origin = _common_origin(towers)
    output = Path(request.output)
    remove_leftovers(output)
    command = _command(request)
    save_again(output, joined, training={"command": command, "towers": towers} | origin)
    return Joined(
        command=command,
        towers=towers,
        system=joined.system,
        graph=joined.graph,
        classes=joined.classes,
        layers=[LayerSize(name=name, neurons=count) for name, count in joined.neurons.items()],
        file=output.name,
        sha256=sha256_of(output),
    )


def _warn_of_twice(records: Sequence[Sequence[Mapping[str, Any]]]) -> None:
    """Say on stderr that two of what is joined hold one network, by the towers of each."""
    networks = [{(tower["sha256"], tower["weights"]) for tower in each} for each in records]
    if len(set().union(*networks)) < sum(map(len, networks)):
        tell("warning: join: one network stands there twice: its votes count twice; join other seeds")


def _common_origin(towers: Sequence[Mapping[str, Any]]) -> JsonObject:
    """What the first was trained on; ModelError if the widths of their bins, or the parts of recordings, differ."""
    origins = [origin_of(tower) for tower in towers]
    windows = sorted({origin.get("window", WHOLE) for origin in origins})
    if len(windows) > 1:
        raise ModelError(
            f"join: networks of {windows[0]} % and {windows[-1]} % of each recording; give those of one --window"
        )
    widths = sorted({origin["bin_s"] for origin in origins if "bin_s" in origin})
    if len(widths) > 1:
        raise ModelError(
            f"join: networks of bins of {widths[0]:g} s and {widths[-1]:g} s; give those of one width"
        )
    if any(origin.get("class_names") != origins[0].get("class_names") for origin in origins):
        raise ModelError("join: networks whose classes have other names; give those of the same classes")
    return origins[0]


def _command(request: JoinRequest) -> str:
    """The words that ask for the same."""
    words = [_shown(name) for name in request.checkpoints]
    words += ["--weights", request.weights] if request.weights else []
    return shlex.join(["spikeloom", "join", *words])


def _network(name: str, weights: str | None) -> Checkpoint:
    checkpoint = load_checkpoint(name, CheckpointChoice(weights=weights))
    if checkpoint.layout != "spikeloom":
        raise ModelError(
            f"{name}: does not say its graph and constants; give checkpoints that spikeloom train wrote"
        )
    return checkpoint


def _shown(name: str) -> str:
    """Name of a file without its folder, or of a shipped checkpoint."""
    return name if shipped(name) != name else Path(name).name


def _records(name: str, checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Where each tower of a checkpoint is from."""
    training = checkpoint.training or {}
    records = training.get("towers")
    if checkpoint.towers > 1 and isinstance(records, list) and len(records) == checkpoint.towers:
        return records
    kept = [key for key in (*KEPT, checkpoint.weights) if key in training]
    origin = {"file": _shown(name), "sha256": checkpoint.sha256, "weights": checkpoint.weights}
    return [origin | {key: training[key] for key in kept}] * checkpoint.towers


def sections(result: Joined) -> Iterable[Section]:
    """The joined network, for people."""
    layers = ", ".join(f"{layer.name} {layer.neurons:,}" for layer in result.layers)
    lines = [result.command, f"  {len(result.towers)} towers: {layers}, {result.classes} classes"]
    lines += [f"    {index}: {tower_line(tower)}" for index, tower in enumerate(result.towers)]
    yield Section("Joined", [Text("\n".join([*lines, f"  written: {result.file}"]))])
