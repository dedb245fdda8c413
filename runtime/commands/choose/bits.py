"""The command ``bits``: the storage width of each layer, from what the decisions have to keep.

The search itself is :func:`compiler.search_widths`. Its result is kept in the user's cache, so that another wanted
share is answered at once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from spikeloom.compiler import (
    DEFAULT_TARGET,
    WidthPoint,
    WidthSearch,
    __version__,
    check_widths,
    search_widths,
    widths_front,
)
from spikeloom.compiler.archive import arrays_digest, is_netlist
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import COMPARTMENTS, Target, load_target
from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.fetch import data_folder
from spikeloom.runtime.commands.main_job import compile as compile_command
from spikeloom.runtime.commands.options import add_bin_option, add_model
from spikeloom.runtime.inputs.files import require_place, shipped
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import decode, encode, key
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Block, Outcome, Section, Table, Text

NOTES = """\
From the widest storage the layer is narrowed whose next smaller width keeps most decisions, again and again. Decisions
are those on training recordings; test recordings are not read, so check the netlist with spikeloom verify. Accuracy is
the share of recordings that the chip decides right, agreement the share that it decides as the float64 model does.
Memory is counted in 64-bit words. The search is kept in the user's cache.
"""

VERSION = 2
"""Of a cache file; goes up when a search could find something else, or the file means something else."""

SAMPLES = 96

FIGURES = {"accuracy": "right", "agreement": "equal"}
"""What can be wanted, and the count of a point that tells it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuiltPoint:
    """A combination of widths as the compiler builds it; shares of the recordings that were decided."""

    weight_bits: Sequence[int]
    words: int
    cores: int | None
    accuracy: float | None
    agreement: float

    def share(self, figure: str) -> float | None:
        """Accuracy or agreement."""
        return self.accuracy if figure == "accuracy" else self.agreement


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenNetlist:
    """File of a netlist, and its hash."""

    file: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class WidthChoice:
    """Widths that keep what is wanted: `wanted` holds the one figure and its share."""

    layers: Sequence[str]
    widths: Sequence[int]
    scale_groups: int
    combinations: int
    recordings: int
    available: int = field(metadata=key("of"))
    wanted: Mapping[str, float]
    float_accuracy: float | None
    front: Sequence[BuiltPoint]
    recommended: BuiltPoint | None
    command: str | None
    cached: bool
    netlist: WrittenNetlist | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("checkpoint")
    add_model(parser)
    parser.add_argument("--calibrate", required=True, metavar="PATH", help="recordings whose train split decides")
    add_bin_option(parser)
    wanted = parser.add_mutually_exclusive_group(required=True)
    wanted.add_argument("--accuracy", type=float, metavar="X", help="share of recordings to decide right, 0 to 1")
    wanted.add_argument("--agreement", type=float, metavar="X", help="share to decide as the float64 model, 0 to 1")
    parser.add_argument(
        "--widths", default="2,3,4,5,6,8", metavar="N[,N]", help="widths to try in every layer (default: 2,3,4,5,6,8)"
    )
    parser.add_argument("--scale-groups", type=int, default=1, metavar="N", help="scales in a layer (default: 1)")
    parser.add_argument(
        "--samples", type=int, default=SAMPLES, metavar="N", help=f"recordings to decide (default: {SAMPLES})"
    )
    parser.add_argument("--target", default=DEFAULT_TARGET, help=f"chip (default: {DEFAULT_TARGET})")
    parser.add_argument("--top", type=int, default=10, metavar="N", help="points of the front to show (default: 10)")
    parser.add_argument("--no-cache", action="store_true", help="search anew, and keep nothing")
    parser.add_argument("-o", "--output", metavar="NET.loom", help="compile the recommended widths")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 if nothing reaches what is wanted.

    Raises
    ------
    SpikeloomError
        If an option, the checkpoint or the recordings cannot be used.
    """
    figure = "accuracy" if arguments.accuracy is not None else "agreement"
    wanted = getattr(arguments, figure)
    if not 0 <= wanted <= 1:
        raise OptionError(f"--{figure} {wanted:g}: not a share; give a number from 0 to 1")
    for option in ("samples", "top"):
        if getattr(arguments, option) < 1:
            raise OptionError(f"--{option} {getattr(arguments, option)}: give 1 or more")
    if arguments.output is not None:
        require_place(arguments.output, "-o", arguments)
    target, given = load_target(arguments.target, COMPARTMENTS), _widths(arguments.widths)
    path = shipped(arguments.checkpoint)
    if Path(path).is_file() and is_netlist(path):
        raise ModelError(f"{path}: is a netlist, its widths are decided; give the checkpoint that it was made from")
    checkpoint = load_checkpoint(path, arguments)
    if checkpoint.forms is not None:
        raise ModelError(f"{path}: was fine-tuned for its own widths; give the network that it was made from")
    layers = ("conv1", *(dense.name for dense in checkpoint.dense))
    widths = check_widths(given, arguments.scale_groups, len(layers), target)
    _, adjacency = propagation(checkpoint, load_graph(arguments, checkpoint.system), arguments.checkpoint)
    progress("reading the recordings")
    training = recordings(
        arguments.calibrate,
        "train",
        classes=checkpoint.classes,
        taxels=checkpoint.taxels,
        bins=checkpoint.bins,
        bin_s=arguments.bin,
        labels_for="--accuracy" if figure == "accuracy" else None,
    )
    made, cached = _searched(arguments, checkpoint, adjacency, training, target, widths)
    progress("")
    best = widths_front(made.built, FIGURES[figure])
    reaching = [point for point in best if getattr(point, FIGURES[figure]) >= wanted * made.samples - 1e-9]
    command = _command(arguments, reaching[0].bits) if reaching else None
    choice = WidthChoice(
        layers=layers,
        widths=widths,
        scale_groups=arguments.scale_groups,
        combinations=len(made.points),
        recordings=made.samples,
        available=len(training),
        wanted={figure: wanted},
        float_accuracy=_share(made.float_right, made.samples),
        front=[_built(point, made.samples) for point in best],
        recommended=_built(reaching[0], made.samples) if reaching else None,
        command=None if command is None else shlex.join(command),
        cached=cached,
        netlist=None if command is None or arguments.output is None else _compiled(command, arguments.output),
    )
    return Outcome(choice, partial(sections, top=arguments.top), 0 if reaching else 1)


def _compiled(command: Sequence[str], output: str) -> WrittenNetlist:
    parser = argparse.ArgumentParser()
    compile_command.add_arguments(parser)
    made = compile_command.run(parser.parse_args(command[2:])).result
    return WrittenNetlist(file=output, sha256=made.netlist.sha256)


def _widths(words: str) -> list[int]:
    try:
        return [int(word) for word in words.split(",")]
    except ValueError:
        raise OptionError(f"--widths {words}: not a number; give widths as in 2,4,8") from None


def _share(count: int | None, samples: int) -> float | None:
    return None if count is None else count / samples


def _built(point: WidthPoint, samples: int) -> BuiltPoint:
    return BuiltPoint(
        weight_bits=point.bits,
        words=point.words,
        cores=point.cores,
        accuracy=_share(point.right, samples),
        agreement=point.equal / samples,
    )


def _command(arguments: argparse.Namespace, widths: tuple[int, ...]) -> list[str]:
    """The words that compile the recommended widths."""
    words = ["spikeloom", "compile", arguments.checkpoint]
    given = {
        "--graph": arguments.graph,
        "--taxels": arguments.taxels,
        "--edges": arguments.edges,
        "--run": arguments.run or None,
        "--weights": arguments.weights,
        "--beta": arguments.beta,
        "--theta": arguments.theta,
        "--target": None if arguments.target == DEFAULT_TARGET else arguments.target,
        "--calibrate": arguments.calibrate,
        "--bin": None if math.isclose(arguments.bin, BIN_S) else arguments.bin,
        "--weight-bits": ",".join(map(str, widths)),
        "--scale-groups": None if arguments.scale_groups == 1 else arguments.scale_groups,
    }
    words += [word for option, value in given.items() if value is not None for word in (option, str(value))]
    return [*words, *(["--directed"] if arguments.directed else []), "-o", arguments.output or "NET.loom"]


# -- the cache ---------------------------------------------------------------------------------------------------------


def _searched(
    arguments: argparse.Namespace,
    checkpoint: Checkpoint,
    adjacency: FloatArray,
    training: Recordings,
    target: Target,
    widths: tuple[int, ...],
) -> tuple[WidthSearch, bool]:
    """The search, and whether it was kept from an earlier call."""
    question = {
        "version": VERSION,
        "spikeloom": __version__,
        "checkpoint": checkpoint.sha256,
        "run": arguments.run,
        "weights": checkpoint.weights,
        "beta": checkpoint.beta,
        "theta": checkpoint.theta,
        "graph": arrays_digest({"adjacency": adjacency}),
        "recordings": arrays_digest(training.identity()),
        "target": repr(target),
        "widths": widths,
        "scale_groups": arguments.scale_groups,
        "samples": arguments.samples,
    }
    digest = hashlib.sha256(json.dumps(question, sort_keys=True).encode()).hexdigest()
    path = data_folder() / "bits" / f"{digest}.json"
    kept = None if arguments.no_cache else read_search(path)
    if kept is not None:
        return kept, True
    made = search_widths(
        expand(checkpoint, adjacency),
        target,
        channels_last(training.events, checkpoint.dynamics.clocks),
        training.labels,
        widths=widths,
        groups=arguments.scale_groups,
        samples=arguments.samples,
        lengths=training.lengths,
        tell=progress,
    )
    if not arguments.no_cache:
        write_search(path, made)
    return made, False


def write_search(path: Path, made: WidthSearch) -> None:
    """Keep a search; if the folder cannot be written, a line on stderr says so."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as file:
            file.write(json.dumps(encode(made)).encode())
    except OSError as error:
        sys.stderr.write(f"spikeloom: warning: {path}: {error.strerror}; the search is not kept for the next call\n")


def read_search(path: Path) -> WidthSearch | None:
    """A search that was kept; None if there is none, or, with a line on stderr, if it is damaged."""
    try:
        return decode(WidthSearch, json.loads(path.read_bytes()))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, TypeError):
        sys.stderr.write(f"spikeloom: warning: {path}: is damaged or of another version; it is ignored\n")
        return None


# -- for people --------------------------------------------------------------------------------------------------------


def sections(choice: WidthChoice, top: int) -> Iterator[Section]:
    """The front, the point to take, and the command that builds it."""
    yield Section("", [*_blocks(choice, top)])


def _blocks(choice: WidthChoice, top: int) -> Iterator[Block]:
    samples, recommended = choice.recordings, choice.recommended
    ((figure, wanted),) = choice.wanted.items()
    kept = ", kept from an earlier call" if choice.cached else ""
    yield Text(
        f"{choice.combinations:,} combinations of widths on {samples} of {choice.available} training recordings{kept}"
    )
    yield Text(
        "training figures: they say how the combinations compare, not what the chip will reach on other recordings"
    )
    if choice.float_accuracy is not None:
        yield Text(f"float64 model: {percent(round(choice.float_accuracy * samples), samples)}")
    shown = _shown(choice.front, recommended, top)
    yield Text(f"most {figure} for the memory, least memory first ({len(shown)} of {len(choice.front)} points):")
    rows = [
        [
            ",".join(map(str, point.weight_bits)),
            f"{point.words:,}",
            str(point.cores),
            *("" if share is None else f"{100 * share:.2f} %" for share in map(point.share, FIGURES)),
            "<-" if point == recommended else "",
        ]
        for point in shown
    ]
    yield Table([",".join(choice.layers), "words", "cores", *FIGURES, ""], rows)
    if recommended is None:
        best = max((point.share(figure) or 0.0 for point in choice.front), default=0.0)
        yield Text(f"no combination reaches {figure} {wanted:g}; the best has {best:.4f}")
        yield Text("  more --scale-groups or --widths may reach it; else fine-tune the network")
        return
    widths = ",".join(map(str, recommended.weight_bits))
    reached = percent(round((recommended.share(figure) or 0.0) * samples), samples)
    yield Text(f"{figure} {wanted:g} needs {widths}: {recommended.words:,} words; training {figure} {reached}")
    yield Text(f"  {choice.command}")
    if choice.netlist is not None:
        yield Text(f"  written: {choice.netlist.file}")


def _shown(points: Sequence[BuiltPoint], recommended: BuiltPoint | None, top: int) -> Sequence[BuiltPoint]:
    """The `top` points of a front around the recommended one, or the best ones."""
    middle = len(points) if recommended is None else points.index(recommended)
    first = max(0, min(middle - top // 2, len(points) - top))
    return points[first : first + top]
