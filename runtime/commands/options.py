"""Options that several commands share."""

import argparse

from spikeloom.compiler.checkpoint import WEIGHTS
from spikeloom.compiler.formats.nir import CONVENTIONS
from spikeloom.models.graphs import CHOICES
from spikeloom.models.recordings.evtouch import BIN_S

MIN_AGREEMENT = 0.95
"""Share of equal decisions that ``verify`` wants."""

NETWORK_FILES = "CKPT|NET.onnx|NET.nir"
"""What a float network is read from."""

DATA_HELP = "recordings: released layout, event files (csv, npz), one recording, 'synthetic', 'objects' or 'containers'"


def add_netlist(parser: argparse.ArgumentParser) -> None:
    """Add the compiled network that a command is about."""
    parser.add_argument("netlist", metavar="NET.loom", help="compiled network")


def add_netlist_and_model(parser: argparse.ArgumentParser) -> None:
    """Add a netlist, the float network beside it as ``--checkpoint``, and how that is read."""
    add_netlist(parser)
    group(parser, "network").add_argument("--checkpoint", metavar=NETWORK_FILES, required=True, help="its float model")
    add_network(parser)


def add_checkpoint(parser: argparse.ArgumentParser, what: str = "trained network, or pretrained:NAME") -> None:
    """Add the checkpoint that a command is about, and how it is read."""
    parser.add_argument("checkpoint", metavar="CKPT", help=what)
    add_model(parser)


def add_bin_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--bin``."""
    options = group(parser, "recordings")
    what = f"width of a time bin for event files (default: the one that the network was trained on, else {BIN_S:g} s)"
    options.add_argument("--bin", type=float, metavar="S", help=what)


def group(parser: argparse.ArgumentParser, title: str) -> argparse._ArgumentGroup:
    """Options of one kind, which a command may add in several places."""
    found = (each for each in parser._action_groups if each.title == title)
    return next(found, None) or parser.add_argument_group(title)


def add_picture(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--picture``."""
    parser.add_argument("--picture", metavar="OUT.png|svg|pdf", help=f"draw {what}")


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command."""
    common = group(parser, "output")
    common.add_argument("--json", action="store_true", help="print the result as JSON")
    common.add_argument("--debug", action="store_true", help="show a traceback on errors")


def add_graph_options(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add the options that name a taxel graph: the built-in sensor's, or one of the user's own."""
    options = group(parser, "network")
    options.add_argument("--graph", help=f"taxel graph {purpose}: {CHOICES}")
    what = "your own sensor: number of taxels, or their positions x,y[,z] in mm"
    options.add_argument("--taxels", metavar="N|COORDS.csv", help=what)
    options.add_argument("--edges", metavar="EDGES.csv", help="your own graph: source,target")
    options.add_argument("--directed", action="store_true", help="take --edges as they are, one way")


def add_data(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Add the options that name recordings, all splits of them."""
    group(parser, "recordings").add_argument("--data", required=required, metavar="PATH", help=DATA_HELP)
    add_bin_option(parser)


def add_recordings(parser: argparse.ArgumentParser, *, window: bool = False, required: bool = True) -> None:
    """Add the options that name recordings to run; with `window` also the one that names a part of each."""
    add_data(parser, required=required)
    options = group(parser, "recordings")
    options.add_argument("--split", default="test", help="split to read (default: test)")
    options.add_argument("--limit", type=int, metavar="N", help="first N recordings only")
    if window:
        what = "first part of every recording, as in 50%% (default: 100%%)"
        options.add_argument("--window", default="100%", metavar="PERCENT", help=what)


def add_prices(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how closely a run is timed, and by which prices."""
    options = group(parser, "depth and prices")
    what = "counts: events, energy, simple time model; cycle: the time of every message too (default: counts)"
    options.add_argument("--detail", choices=("counts", "cycle"), default="counts", help=what)
    options.add_argument("--table", metavar="NAME|FILE.toml", help="energy or time by this table alone, or by your own")


def add_check(parser: argparse.ArgumentParser) -> None:
    """Add the options of a comparison of chip and float model."""
    what = "recordings for spec = engine (default: 3)"
    parser.add_argument("--spec-samples", type=int, default=3, metavar="N", help=what)


def add_model(parser: argparse.ArgumentParser, *, graph: bool = True) -> None:
    """Add the options that say how to read a checkpoint."""
    options = group(parser, "network")
    if graph:
        add_graph_options(parser, "that it was trained on")
    options.add_argument("--run", type=int, default=0, metavar="N", help="which run of a released file (default: 0)")
    what = "epoch, where a checkpoint holds several (default: the first of these that it holds)"
    options.add_argument("--weights", choices=WEIGHTS, help=what)
    options.add_argument("--beta", type=float, help="membrane decay, where the file does not say (default: 0.2)")
    options.add_argument("--theta", type=float, help="threshold, where the file does not say (default: 0.5)")


def add_network(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how to read a float network: a checkpoint on its graph, an ONNX or a NIR file."""
    options = group(parser, "network")
    add_model(parser)
    options.add_argument("--polarities", type=int, metavar="N", help="of an ONNX or NIR input, where its shape is flat")
    axis = options.add_mutually_exclusive_group()
    for name, first in (("first", True), ("last", False)):
        what = f"they are the {name} axis, where the shape of an ONNX or NIR input does not say"
        axis.add_argument(f"--polarities-{name}", dest="polarities_first", action="store_const", const=first, help=what)
    what = "time step that a NIR file is read in (default: its own)"
    options.add_argument("--dt", type=float, metavar="SECONDS", help=what)
    what = f"a step keeps 1 - dt/tau (euler) or exp(-dt/tau) (exponential) of a state (default: {CONVENTIONS[0]})"
    options.add_argument("--convention", choices=CONVENTIONS, help=what)
