"""The command ``bits``: the storage width of each layer, from what the decisions have to keep."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from spikeloom.compiler import DEFAULT_TARGET, WidthPoint, WidthSearch, check_widths, search_widths, widths_front
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import COMPARTMENTS, load_target
from spikeloom.runtime.commands.main_job import compile as compile_command
from spikeloom.runtime.commands.options import add_bin_option, add_checkpoint
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import key
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Block, Outcome, Section, Table, Text

NOTES = """\
From the widest storage the layer is narrowed whose next smaller width keeps most decisions, again and again. Decisions
are those on training recordings; test recordings are not read, so check the netlist with spikeloom verify. Accuracy is
the share of recordings that the chip decides right, agreement the share that it decides as the float64 model does.
Memory is counted in 64-bit words.
"""

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

    def share(self, figure: str) -> float:
        """Accuracy or agreement."""
        return (self.accuracy or 0.0) if figure == "accuracy" else self.agreement


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
    command: str | None = None
    netlist: WrittenNetlist | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_checkpoint(parser)
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
    parser.add_argument("-o", "--output", metavar="NET.loom", help="compile the recommended widths")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 if nothing reaches what is wanted."""
    figure = "accuracy" if arguments.accuracy is not None else "agreement"
    wanted = getattr(arguments, figure)
    if not 0 <= wanted <= 1:
        raise OptionError(f"--{figure} {wanted:g}: not a share; give a number from 0 to 1")
    if arguments.samples < 1:
        raise OptionError(f"--samples {arguments.samples}: give 1 or more")
    require_place(arguments.output, "-o", arguments)
    target, given = load_target(arguments.target, COMPARTMENTS), whole_numbers(arguments.widths, "--widths")
    checkpoint = load_checkpoint(arguments.checkpoint, arguments)
    if checkpoint.forms is not None:
        raise ModelError(
            f"{arguments.checkpoint}: was fine-tuned for its own widths; give the network that it was made from"
        )
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
    progress("")
    front = [_built(made, point) for point in widths_front(made.built, FIGURES[figure])]
    choice = WidthChoice(
        layers=layers,
        widths=widths,
        scale_groups=arguments.scale_groups,
        combinations=len(made.points),
        recordings=made.samples,
        available=len(training),
        wanted={figure: wanted},
        float_accuracy=None if made.float_right is None else made.float_right / made.samples,
        front=front,
        recommended=next((point for point in front if point.share(figure) >= wanted - 1e-9), None),
    )
    if choice.recommended is None:
        return Outcome(choice, sections, 1)
    choice = replace(choice, command=_command(arguments, choice.recommended.weight_bits))
    if arguments.output is not None:
        choice = replace(choice, netlist=_compiled(str(choice.command)))
    return Outcome(choice, sections)


def _built(made: WidthSearch, point: WidthPoint) -> BuiltPoint:
    return BuiltPoint(
        weight_bits=point.bits,
        words=point.words,
        cores=point.cores,
        accuracy=None if point.right is None else point.right / made.samples,
        agreement=point.equal / made.samples,
    )


def _command(arguments: argparse.Namespace, widths: Sequence[int]) -> str:
    """What compiles the recommended widths."""
    options = repeat.given(arguments, (*repeat.NETWORK, "target", "calibrate", "bin"))
    options |= {"weight_bits": ",".join(map(str, widths))}
    options |= {"scale_groups": None if arguments.scale_groups == 1 else arguments.scale_groups}
    file = arguments.output or "NET.loom"
    return repeat.command("compile", arguments.checkpoint, *repeat.words(options), "-o", file)


def _compiled(command: str) -> WrittenNetlist:
    parser = argparse.ArgumentParser()
    compile_command.add_arguments(parser)
    arguments = parser.parse_args(shlex.split(command)[2:])
    return WrittenNetlist(file=arguments.output, sha256=compile_command.run(arguments).result.netlist.sha256)


def sections(choice: WidthChoice) -> Iterator[Section]:
    """The front, the point to take, and the command that builds it."""
    yield Section("", [*_blocks(choice)])


def _blocks(choice: WidthChoice) -> Iterator[Block]:
    samples, recommended = choice.recordings, choice.recommended
    ((figure, wanted),) = choice.wanted.items()
    yield Text(
        f"{choice.combinations:,} combinations of widths on {samples} of {choice.available} training recordings\n"
        "training figures: they say how the combinations compare, not what the chip will reach on other recordings"
    )
    if choice.float_accuracy is not None:
        yield Text(f"float64 model: {percent(round(choice.float_accuracy * samples), samples)}")
    yield Text(f"most {figure} for the memory, least memory first:")
    rows = [
        [
            ",".join(map(str, point.weight_bits)),
            f"{point.words:,}",
            str(point.cores),
            *("" if share is None else f"{100 * share:.2f} %" for share in (point.accuracy, point.agreement)),
            "<-" if point == recommended else "",
        ]
        for point in choice.front
    ]
    yield Table([",".join(choice.layers), "words", "cores", *FIGURES, ""], rows)
    if recommended is None:
        best = max((point.share(figure) for point in choice.front), default=0.0)
        yield Text(f"no combination reaches {figure} {wanted:g}; the best has {best:.4f}")
        yield Text("  more --scale-groups or --widths may reach it; else fine-tune the network")
        return
    widths = ",".join(map(str, recommended.weight_bits))
    reached = percent(round(recommended.share(figure) * samples), samples)
    yield Text(f"{figure} {wanted:g} needs {widths}: {recommended.words:,} words; training {figure} {reached}")
    yield Text(f"  {choice.command}")
    if choice.netlist is not None:
        yield Text(f"  written: {choice.netlist.file}")
