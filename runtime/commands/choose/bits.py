"""The command ``bits``: the storage width of each layer, from what the decisions have to keep."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from spikeloom.compiler import DEFAULT_TARGET, check_widths, search_widths
from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.base import COMPARTMENTS, load_target
from spikeloom.runtime.commands.main_job import compile as compile_command
from spikeloom.runtime.commands.options import add_bin_option, add_checkpoint
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import whole_numbers
from spikeloom.runtime.inputs.files import require_place, shipped
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.width_choice import WrittenNetlist, choose, sections

NOTES = """\
From the widest storage the layer is narrowed whose next smaller width keeps most decisions, again and again. Decisions
are those on training recordings; test recordings are not read, so check the netlist with spikeloom verify. Accuracy is
the share of recordings that the chip decides right, agreement the share that it decides as the float64 model does.
Memory is counted in 64-bit words.
"""

SAMPLES = 96


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
    choice = choose(
        made, figure, wanted, layers=layers, widths=widths, groups=arguments.scale_groups, available=len(training)
    )
    if choice.recommended is None:
        return Outcome(choice, sections, 1)
    choice = replace(choice, command=_command(arguments, choice.recommended.weight_bits))
    if arguments.output is not None:
        choice = replace(choice, netlist=_compiled(str(choice.command)))
    return Outcome(choice, sections)


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
