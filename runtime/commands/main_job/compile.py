"""The command ``compile``: a checkpoint or a file of another format becomes a netlist."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from spikeloom.compiler import DEFAULT_TARGET, GOALS, Compilation, compile_network, write_netlist
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import load_target
from spikeloom.runtime.commands.main_job.integers import brings_integers, compile_integers
from spikeloom.runtime.commands.options import NETWORK_FILES, add_bin_option, add_network, group
from spikeloom.runtime.inputs.compilation import parse_cores, parse_packings, provenance
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.base import chip_commands, compiled, trained_for
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the options."""
    sub.add_argument("checkpoint", metavar=NETWORK_FILES, help="checkpoint, or a network as an ONNX, NIR or netx file")
    add_network(sub)
    storage, layout, output = (group(sub, title) for title in ("storage", "layout", "output"))
    sub.add_argument("--target", default=DEFAULT_TARGET, help=f"chip: {DEFAULT_TARGET} (default), or truenorth")
    storage.add_argument(
        "--weight-bits",
        metavar="N[,N]",
        help="storage width, one or one a layer: 2 to 6 or 8 (default: 8)",
    )
    storage.add_argument("--planes", metavar="N[,N]", help="times a synapse is stored, 1 to 3 (default: 1)")
    storage.add_argument("--scale-groups", metavar="N[,N]", help="scales in a layer, 1 to 8 (default: 1)")
    storage.add_argument(
        "--spike-exact",
        action="store_true",
        help="add planes and scales until the training spikes are the float model's",
    )
    storage.add_argument("--keep-all", action="store_true", help="keep neurons that never fire or reach no neuron")
    storage.add_argument(
        "--prune-unused", action="store_true", help="leave out neurons that never fired on the training split, too"
    )
    storage.add_argument("--calibrate", metavar="PATH", help="recordings whose train split chooses the scales")
    add_bin_option(sub)
    storage.add_argument(
        "--in-time",
        type=int,
        metavar="N",
        help="truenorth: lower a history-free network, N axons an input (2 to 4), whose sums travel in 20 ticks a step",
    )
    layout.add_argument(
        "--cores-for",
        metavar="LAYER=N[,…]",
        help="at least N cores for a layer, which it shares with none, as in conv1=4,fc1=6",
    )
    layout.add_argument("--chips", type=int, default=1, metavar="N", help="use up to N chips (default: 1)")
    layout.add_argument(
        "--optimize",
        default="cores",
        metavar="GOAL",
        help=f"choose the layout for {' or '.join(GOALS)}, which needs --calibrate (default: cores)",
    )
    output.add_argument(
        "--dump-after", action="append", default=[], metavar="PASS", help="print the network after a pass, on stderr"
    )
    output.add_argument("-o", "--output", required=True, metavar="NET.loom", help="netlist to write")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_place(arguments.output, "-o", arguments)
    chip = load_target(arguments.target)
    if brings_integers(arguments.checkpoint):
        return compile_integers(arguments)
    if unknown := set(arguments.dump_after) - {step.name for step in chip.passes}:
        names = ", ".join(step.name for step in chip.passes)
        raise OptionError(f"--dump-after {', '.join(sorted(unknown))}: no such pass; allowed: {names}")
    own = trained_for(arguments.checkpoint) or chip_commands(arguments.target)
    if own is not None:
        return own.compile_network(arguments)  # type: ignore[no-any-return]
    refuse(arguments, ("in_time",), f"{arguments.target} has no such option")
    options = chip.options(
        packings=parse_packings(arguments),
        spike_exact=arguments.spike_exact,
        keep_all=arguments.keep_all,
        prune_unused=arguments.prune_unused,
        cores_for=parse_cores(arguments.cores_for),
        chips=arguments.chips,
        optimize=arguments.optimize,
    )
    options.require_consistent(calibrated=arguments.calibrate is not None)
    asked = load_network(arguments.checkpoint, arguments)
    checkpoint, training = asked.checkpoint, None
    if arguments.calibrate is not None:
        progress("reading the recordings")
        training = recordings(
            arguments.calibrate,
            "train",
            classes=asked.network.classes,
            taxels=asked.network.input.taxels,
            bin_s=arguments.bin,
            bins=asked.network.input.bins,
        ).events
    progress("compiling")

    def dump(name: str, done: Compilation) -> None:
        if name in arguments.dump_after:
            sys.stderr.write(done.text())

    compilation = compile_network(
        asked.source,
        replace(
            options,
            forms=None if checkpoint is None else checkpoint.forms,
            training_events=training,
            provenance=provenance(arguments, asked, calibrated=training is not None),
        ),
        target=arguments.target,
        after=dump,
    )
    sha256 = write_netlist(compilation.netlist, arguments.output)
    return compiled(compilation, sha256, asked.facts)
