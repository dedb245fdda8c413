"""The command ``compile``: a checkpoint or a file of another format becomes a netlist."""

import argparse
import sys
from typing import Any

from spikeloom.compiler import DEFAULT_TARGET, KEEP
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.text import text
from spikeloom.runtime.commands.options import NETWORK_FILES, add_bin_option, add_network, group
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.machines.backends import backend_of, trained_for
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.sections import Outcome


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
    what = "at least N cores for a layer, which it shares with none, as in conv1=4,fc1=6"
    layout.add_argument("--cores-for", metavar="LAYER=N[,…]", help=what)
    layout.add_argument("--chips", type=int, default=1, metavar="N", help="use up to N chips (default: 1)")
    what = "no host resets the chip: layers always integrate, blank steps after each recording clear them"
    layout.add_argument("--free-running", action="store_true", help=what)
    what = "print the network after a pass, on stderr"
    output.add_argument("--dump-after", action="append", default=[], metavar="PASS", help=what)
    output.add_argument("-o", "--output", required=True, metavar="NET.loom", help="netlist to write")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_place(arguments.output, "-o", arguments, ["loom"])
    backend = backend_of(arguments.target)
    names = backend.passes
    if unknown := set(arguments.dump_after) - set(names):
        raise OptionError(f"--dump-after {', '.join(sorted(unknown))}: no such pass; allowed: {', '.join(names)}")
    only = trained_for(arguments.checkpoint)
    if only is not None and only is not backend:
        path = f"{arguments.checkpoint} was trained for {only.target.title}"
        raise OptionError(f"--target {arguments.target}: {path}; give --target {only.name}")
    passes = Progress(len(names))

    def dump(name: str, done: Any) -> None:
        passes(names.index(name) + 1, "compiling")
        if name in arguments.dump_after:
            sys.stderr.write(text(done.newest))

    lowered = backend.lower(arguments, dump)
    sha256 = lowered.write(arguments.output)
    return lowered.report(sha256)
