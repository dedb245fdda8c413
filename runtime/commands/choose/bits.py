"""The command ``bits``: the storage width of each layer, from what the decisions have to keep.

The search itself is :mod:`storage.width_search`. What it found is kept in the user's cache, so that another wanted
share is answered at once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spikeloom import __version__
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.formats.archive import is_netlist
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.formats.checkpoint import Checkpoint
from spikeloom.compiler.formats.checkpoint_file import arrays_digest
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import COMPARTMENTS, Target, load_target
from spikeloom.compiler.targets.loihi1.storage.width_search import Found, Point, check_widths, front, search
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.recordings.fetch import data_folder
from spikeloom.runtime.commands.options import add_bin_option, add_model
from spikeloom.runtime.inputs.files import require_place, shipped
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.report.tables import percent, table

Json = dict[str, Any]

NOTES = """\
Every combination of widths is tried on training recordings; test recordings are not read, so check the netlist with
spikeloom verify. Accuracy is the share of recordings that the chip decides right, agreement the share that it decides
as the float64 model does. Memory is counted in 64-bit words. What was found is kept in the user's cache.
"""

FORMAT = 1
"""Of a cache file; goes up when a search could find something else, or the file means something else."""

SAMPLES = 96

FIGURES = {"accuracy": "right", "agreement": "equal"}
"""What can be wanted, and the count of a point that tells it."""


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
    parser.add_argument("--target", default="loihi1", help="chip (default: loihi1)")
    parser.add_argument("--top", type=int, default=10, metavar="N", help="points of the front to show (default: 10)")
    parser.add_argument("--no-cache", action="store_true", help="search anew, and keep nothing")
    parser.add_argument("-o", "--output", metavar="NET.loom", help="compile the recommended widths")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
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
    target, asked = load_target(arguments.target, COMPARTMENTS), _widths(arguments.widths)
    path = shipped(arguments.checkpoint)
    if Path(path).is_file() and is_netlist(path):
        raise ModelError(f"{path}: is a netlist, its widths are decided; give the checkpoint that it was made from")
    checkpoint = load_checkpoint(path, arguments)
    if checkpoint.forms is not None:
        raise ModelError(f"{path}: was fine-tuned for its own widths; give the network that it was made from")
    layers = ("conv1", *(dense.name for dense in checkpoint.dense))
    widths = check_widths(asked, arguments.scale_groups, len(layers), target)
    _, adjacency = propagation(checkpoint, load_graph(arguments, checkpoint.system), arguments.checkpoint)
    _tell("reading the recordings")
    training = recordings(
        arguments.calibrate,
        "train",
        classes=checkpoint.classes,
        taxels=checkpoint.taxels,
        bins=checkpoint.bins,
        bin_s=arguments.bin,
        labels_for="--accuracy" if figure == "accuracy" else None,
    )
    found, kept = _found(arguments, checkpoint, adjacency, training, target, widths)
    _tell("")
    best = front(found.built, FIGURES[figure])
    reaching = [point for point in best if getattr(point, FIGURES[figure]) >= wanted * found.samples - 1e-9]
    command = _command(arguments, reaching[0].bits) if reaching else None
    report: Json = {
        "layers": list(layers),
        "widths": list(widths),
        "scale_groups": arguments.scale_groups,
        "combinations": len(found.points),
        "recordings": found.samples,
        "of": len(training),
        "wanted": {figure: wanted},
        "float_accuracy": _share(found.float_right, found.samples),
        "front": [_point_json(point, found.samples) for point in best],
        "recommended": _point_json(reaching[0], found.samples) if reaching else None,
        "command": None if command is None else shlex.join(command),
        "cached": kept,
        "netlist": None,
    }
    if arguments.output is not None and command is not None:
        from spikeloom.runtime.cli import build_parser

        compilation = build_parser().parse_args(command[1:])
        compiled, _, _ = compilation.action(compilation)
        report["netlist"] = {"file": arguments.output, "sha256": compiled["sha256"]}
    return report, lambda found: bits_text(found, arguments.top), 0 if reaching else 1


def _tell(what: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{what} …" if what else "\r\x1b[K")
        sys.stderr.flush()


def _widths(words: str) -> list[int]:
    try:
        return [int(word) for word in words.split(",")]
    except ValueError:
        raise OptionError(f"--widths {words}: not a number; give widths as in 2,4,8") from None


def _share(count: int | None, samples: int) -> float | None:
    return None if count is None else count / samples


def _point_json(point: Point, samples: int) -> Json:
    return {
        "weight_bits": list(point.bits),
        "words": point.words,
        "cores": point.cores,
        "accuracy": _share(point.right, samples),
        "agreement": _share(point.equal, samples),
    }


def _command(arguments: argparse.Namespace, widths: tuple[int, ...]) -> list[str]:
    """The words that compile what was found."""
    words = ["spikeloom", "compile", arguments.checkpoint]
    given = {
        "--graph": arguments.graph,
        "--taxels": arguments.taxels,
        "--edges": arguments.edges,
        "--run": arguments.run or None,
        "--weights": arguments.weights,
        "--beta": arguments.beta,
        "--theta": arguments.theta,
        "--target": None if arguments.target == "loihi1" else arguments.target,
        "--calibrate": arguments.calibrate,
        "--bin": None if math.isclose(arguments.bin, BIN_S) else arguments.bin,
        "--weight-bits": ",".join(map(str, widths)),
        "--scale-groups": None if arguments.scale_groups == 1 else arguments.scale_groups,
    }
    words += [word for option, value in given.items() if value is not None for word in (option, str(value))]
    return [*words, *(["--directed"] if arguments.directed else []), "-o", arguments.output or "NET.loom"]


# -- the cache ---------------------------------------------------------------------------------------------------------


def _found(
    arguments: argparse.Namespace,
    checkpoint: Checkpoint,
    adjacency: FloatArray,
    training: Recordings,
    target: Target,
    widths: tuple[int, ...],
) -> tuple[Found, bool]:
    """What the search finds, and whether it was kept from an earlier one."""
    question = {
        "format": FORMAT,
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
    key = _digest(question)
    path = data_folder() / "bits" / f"{key}.json"
    found = None if arguments.no_cache else read_found(path, key)
    if found is not None:
        return found, True
    found = search(
        expand(checkpoint, adjacency),
        target,
        channels_last(training.events, checkpoint.dynamics.clocks),
        training.labels,
        widths=widths,
        groups=arguments.scale_groups,
        samples=arguments.samples,
        lengths=training.lengths,
        tell=_tell,
    )
    if not arguments.no_cache:
        write_found(path, key, found)
    return found, False


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_found(path: Path, key: str, found: Found) -> None:
    """Keep what a search found; if the folder cannot be written, a line on stderr says so."""
    kept = {"key": key, "found": asdict(found)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as file:
            file.write(json.dumps(kept | {"sha256": _digest(kept)}).encode())
    except OSError as error:
        sys.stderr.write(f"spikeloom: warning: {path}: {error.strerror}; the search is not kept for the next call\n")


def read_found(path: Path, key: str) -> Found | None:
    """What was kept under a key; None if nothing was, or, with a line on stderr, if it is damaged."""
    try:
        kept = json.loads(path.read_bytes())
        if kept["key"] != key or kept["sha256"] != _digest({"key": kept["key"], "found": kept["found"]}):
            raise ValueError
        found = kept["found"]
        points, built = (
            tuple(Point(**point | {"bits": tuple(point["bits"])}) for point in found[name])
            for name in ("points", "built")
        )
        return Found(samples=found["samples"], float_right=found["float_right"], points=points, built=built)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        sys.stderr.write(f"spikeloom: warning: {path}: is damaged or of another version; it is left out\n")
        return None


# -- for people --------------------------------------------------------------------------------------------------------


def bits_text(report: Json, top: int) -> str:
    """The front, the point to take, and the command that builds it."""
    samples = report["recordings"]
    (figure, wanted), recommended = next(iter(report["wanted"].items())), report["recommended"]
    kept = ", kept from an earlier call" if report["cached"] else ""
    lines = [
        f"{report['combinations']:,} combinations of widths on {samples} of {report['of']} training recordings{kept}",
        "training figures: they say how the combinations compare, not what the chip will reach on other recordings",
    ]
    if report["float_accuracy"] is not None:
        lines.append(f"float64 model: {percent(round(report['float_accuracy'] * samples), samples)}")
    shown = _shown(report["front"], recommended, top)
    rows = [
        [
            ",".join(map(str, point["weight_bits"])),
            f"{point['words']:,}",
            str(point["cores"]),
            *("" if point[name] is None else f"{100 * point[name]:.2f} %" for name in FIGURES),
            "<-" if point == recommended else "",
        ]
        for point in shown
    ]
    lines.append(f"most {figure} for the memory, least memory first ({len(shown)} of {len(report['front'])} points):")
    lines.append(table([",".join(report["layers"]), "words", "cores", *FIGURES, ""], rows))
    if recommended is None:
        best = max((point[figure] for point in report["front"]), default=0.0)
        lines.append(f"no combination reaches {figure} {wanted:g}; the best has {best:.4f}")
        lines.append("  more --scale-groups or --widths may reach it; else fine-tune the network")
        return "\n".join(lines)
    chosen = ",".join(map(str, recommended["weight_bits"]))
    reached = percent(round(recommended[figure] * samples), samples)
    lines.append(f"{figure} {wanted:g} needs {chosen}: {recommended['words']:,} words; training {figure} {reached}")
    lines.append(f"  {report['command']}")
    if report["netlist"] is not None:
        lines.append(f"  written: {report['netlist']['file']}")
    return "\n".join(lines)


def _shown(points: list[Json], recommended: Json | None, top: int) -> list[Json]:
    """The `top` points of a front around the recommended one, or the best ones."""
    middle = len(points) if recommended is None else points.index(recommended)
    first = max(0, min(middle - top // 2, len(points) - top))
    return points[first : first + top]
