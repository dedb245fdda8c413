"""The command ``compile``: a checkpoint or a file of another format becomes a netlist."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from spikeloom.compiler import (
    DEFAULT_TARGET,
    GOALS,
    KEEP,
    Compilation,
    Options,
    __version__,
    compile_network,
    invariants,
    write_netlist,
)
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats import NETX
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.formats.text import text
from spikeloom.compiler.targets.base import load_target
from spikeloom.models.recordings.events import of_length
from spikeloom.runtime.commands.options import NETWORK_FILES, add_bin_option, add_network, group
from spikeloom.runtime.inputs.compilation import parse_cores, parse_keep, parse_packings, provenance
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import origin_of, recordings
from spikeloom.runtime.inputs.repeat import LAYOUT, NETWORK, ROUNDING, command, given, refuse, words
from spikeloom.runtime.machines.base import chip_module, describe, trained_for
from spikeloom.runtime.report.console import Progress, progress
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text


@dataclass(frozen=True, slots=True, kw_only=True)
class LaidOut:
    """A netlist of integers as they stood, and what was read from their file."""

    netlist: Any = field(metadata=INLINE)
    path: str
    facts: Sequence[str]


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the options."""
    sub.add_argument("checkpoint", metavar=NETWORK_FILES, help="checkpoint, or a network as an ONNX, NIR or netx file")
    add_network(sub)
    storage, layout, output = (group(sub, title) for title in ("storage", "layout", "output"))
    sub.add_argument("--target", default=DEFAULT_TARGET, help=f"chip: {DEFAULT_TARGET} (default), or truenorth")
    what = "storage width, one or one a layer: 2 to 6 or 8 (default: 8)"
    storage.add_argument("--weight-bits", metavar="N[,N]", help=what)
    storage.add_argument("--planes", metavar="N[,N]", help="times a synapse is stored, 1 to 3 (default: 1)")
    storage.add_argument("--scale-groups", metavar="N[,N]", help="scales in a layer, 1 to 8 (default: 1)")
    what = "add planes and scales until the training spikes are the float model's"
    storage.add_argument("--spike-exact", action="store_true", help=what)
    storage.add_argument("--keep-all", action="store_true", help="keep neurons that never fire or reach no neuron")
    what = "leave out neurons that never fired on the training split, too"
    storage.add_argument("--prune-unused", action="store_true", help=what)
    storage.add_argument(
        "--share-lists",
        action="store_true",
        help="with --calibrate: round what a convolution repeats alike, for less memory",
    )
    storage.add_argument("--calibrate", metavar="PATH", help="recordings whose train split chooses storage and scales")
    what = f"share of equal decisions on held-out training recordings that storage has to keep (default: {KEEP:g})"
    storage.add_argument("--keep", type=float, metavar="X", help=what)
    add_bin_option(sub)
    what = "truenorth: lower a history-free network, N axons an input (2 to 4), whose sums travel in 20 ticks a step"
    storage.add_argument("--in-time", type=int, metavar="N", help=what)
    what = "at least N cores for a layer, which it shares with none, as in conv1=4,fc1=6"
    layout.add_argument("--cores-for", metavar="LAYER=N[,…]", help=what)
    layout.add_argument("--chips", type=int, default=1, metavar="N", help="use up to N chips (default: 1)")
    what = f"choose the layout for {' or '.join(GOALS)}, which needs --calibrate (default: cores)"
    layout.add_argument("--optimize", default="cores", metavar="GOAL", help=what)
    what = "no host resets the chip: layers always integrate, blank steps after each recording clear them"
    layout.add_argument("--free-running", action="store_true", help=what)
    what = "print the network after a pass, on stderr"
    output.add_argument("--dump-after", action="append", default=[], metavar="PASS", help=what)
    output.add_argument("-o", "--output", required=True, metavar="NET.loom", help="netlist to write")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_place(arguments.output, "-o", arguments, ["loom"])
    chip = load_target(arguments.target)
    if isinstance(arguments.checkpoint, str) and arguments.checkpoint.endswith(NETX):
        return _compile_integers(arguments)
    names = [step.name for step in chip.module.PASSES]
    if unknown := set(arguments.dump_after) - set(names):
        raise OptionError(f"--dump-after {', '.join(sorted(unknown))}: no such pass; allowed: {', '.join(names)}")
    own = trained_for(arguments.checkpoint) or chip_module(arguments.target, "commands")
    if own is not None:
        return own.compile_network(arguments)  # type: ignore[no-any-return]
    refuse(arguments, ("in_time",), f"{arguments.target} has no such option")
    options = chip.module.Options(
        packings=parse_packings(arguments),
        spike_exact=arguments.spike_exact,
        keep=parse_keep(arguments),
        keep_all=arguments.keep_all,
        prune_unused=arguments.prune_unused,
        share_lists=arguments.share_lists,
        cores_for=parse_cores(arguments.cores_for),
        chips=arguments.chips,
        optimize=arguments.optimize,
        free_running=arguments.free_running,
    )
    options.require_consistent(calibrated=arguments.calibrate is not None)
    asked = load_network(arguments.checkpoint, arguments)
    forms, training, found = asked.network.forms, None, None
    if forms is not None:
        refuse(arguments, ("keep",), f"{arguments.checkpoint} was fine-tuned for its own storage")
    if arguments.calibrate is not None:
        progress("reading the recordings")
        found = recordings(
            arguments.calibrate,
            "train",
            classes=asked.network.classes,
            taxels=asked.network.input.taxels,
            bin_s=arguments.bin,
            bins=asked.network.input.bins,
            trained=origin_of(asked.training),
        )
        training = of_length(found, asked.network.input.clocks.length).events
    passes = Progress(len(names))
    progress("compiling")

    def dump(name: str, done: Compilation) -> None:
        passes(names.index(name) + 1, "compiling")
        if name in arguments.dump_after:
            sys.stderr.write(text(done.newest))

    compilation = compile_network(
        asked.model,
        replace(
            options,
            forms=forms,
            training_events=training,
            provenance=provenance(arguments, asked, calibrated=found),
        ),
        target=arguments.target,
        after=dump,
    )
    sha256 = write_netlist(compilation.netlist, arguments.output)
    helps = _finetune(arguments, checkpoint=asked.checkpoint is not None)
    shown = chip_module(arguments.target, "compiled").outcome(compilation, sha256, asked.facts, helps)
    return shown  # type: ignore[no-any-return]


def _finetune(arguments: argparse.Namespace, *, checkpoint: bool) -> str:
    """What to type for training on the chip's integers."""
    read = words(given(arguments, (*NETWORK, *LAYOUT)))
    data = ("--data", str(arguments.calibrate), "--weight-bits", "8")
    return command("finetune", str(arguments.checkpoint), *read, *data, "-o", "TUNED.pt" if checkpoint else "TUNED.nir")


def _compile_integers(arguments: argparse.Namespace) -> Outcome:
    """Compile a file that brings its integers: nothing is rounded, they are laid out as they stand."""
    path = arguments.checkpoint
    if load_target(arguments.target).module.Options is not Options:
        raise OptionError(f"--target {arguments.target}: {path} holds integers of another chip; omit it")
    floats = ("in_time", "dt", "convention", *ROUNDING, "dump_after", "calibrate", "optimize")
    refuse(arguments, floats, f"is for float networks, {path} holds integers")
    refuse(arguments, NETWORK, f"is for checkpoints, the netx file {path} holds all it needs")
    progress("reading the network")
    read = read_netx(path, polarities=arguments.polarities, polarities_first=arguments.polarities_first)
    invariants.verify(read.network)
    progress("compiling")
    cores_for = parse_cores(arguments.cores_for)
    provenance = {
        "spikeloom": __version__,
        "checkpoint_sha256": read.sha256,
        "format": "netx",
        "keep_all": arguments.keep_all,
        **({"cores_for": cores_for} if cores_for else {}),
        **({"chips": arguments.chips} if arguments.chips != 1 else {}),
    }
    layout = {"keep_all": arguments.keep_all, "cores_for": cores_for, "free_running": arguments.free_running}
    options = Options(**layout, chips=arguments.chips, provenance=provenance)
    done = compile_network(read.network, options, target=arguments.target)
    sha256 = write_netlist(done.netlist, arguments.output)
    described = describe(arguments.output)

    def sections(made: LaidOut) -> Iterator[Section]:
        yield Section("", [*map(Text, made.facts)])
        *first, last = described.sections(made.netlist)
        yield from first
        yield Section("", [*last.blocks, Text(f"sha256 {sha256}")])

    return Outcome(LaidOut(netlist=described.result, path=arguments.output, facts=read.facts), sections)
