"""Options that several commands share."""

from __future__ import annotations

import argparse

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.checkpoint_file import WEIGHTS
from spikeloom.compiler.formats.nir.neurons import CONVENTIONS
from spikeloom.compiler.systems import GRAPH_SYSTEMS, SYSTEMS, TACTILESGNET
from spikeloom.compiler.targets.loihi1.compilation import STAGES
from spikeloom.compiler.targets.loihi1.layout.choose import GOALS
from spikeloom.compiler.targets.loihi1.storage.quantize import RANGES
from spikeloom.compiler.targets.truenorth.native import BASES, USUAL_COPIES
from spikeloom.compiler.targets.truenorth.native import SYSTEM as NATIVE
from spikeloom.models.graphs import CHOICES
from spikeloom.models.systems import PADDINGS
from spikeloom.models.training.recipes import RECIPES, RELEASED
from spikeloom.models.training.schedule import DECAY_EPOCHS
from spikeloom.runtime.commands.exchange.data import add_bin_option
from spikeloom.runtime.machines.loihi1.trace import ENGINES

MARGIN = 0.1

MIN_AGREEMENT = 0.95
"""Share of equal decisions that ``verify`` wants."""

MODEL: dict[str, object] = {
    "system": None,
    "graph": None,
    "taxels": None,
    "edges": None,
    "directed": False,
    "weights": None,
    "beta": None,
    "theta": None,
    "run": 0,
}
"""Options of :func:`add_model`, and what they are where they are not given."""

ROUNDING: dict[str, object] = {
    "weight_bits": None,
    "planes": None,
    "scale_groups": None,
    "spike_exact": False,
    "prune_unused": False,
    "ranges": "proven",
    "margin": None,
    "against": None,
    "dump_after": [],
}
"""Options of ``compile`` that say how a float network is stored on Loihi, likewise."""

PLACING: dict[str, object] = {"keep_all": False, "cores_for": None, "chips": 1, "optimize": "cores"}
"""Options of ``compile`` that say where integers go, likewise."""

DATA_HELP = "recordings: released layout, event files (csv, npz), one recording, 'synthetic', 'objects' or 'containers'"


def add_graph_options(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add the options that name a taxel graph: the built-in sensor's, or one of the user's own."""
    parser.add_argument("--graph", help=f"taxel graph {purpose}: {CHOICES}")
    parser.add_argument("--taxels", metavar="N|COORDS.csv", help="your own sensor: positions x,y[,z] in mm")
    parser.add_argument("--edges", metavar="EDGES.csv", help="your own graph: source,target")
    parser.add_argument("--directed", action="store_true", help="take --edges as they are, one way")


def add_system(parser: argparse.ArgumentParser, default: str, *more: str) -> None:
    """Add the option that names a system: one of the usual ones, or of `more`."""
    parser.add_argument("--system", choices=(*SYSTEMS, *more), help=f"{', '.join((*SYSTEMS, *more))} ({default})")


def add_recordings(parser: argparse.ArgumentParser, *, window: bool = False) -> None:
    """Add the options that name recordings to run; with `window` also the one that names a part of each."""
    parser.add_argument("--data", required=True, metavar="PATH", help=DATA_HELP)
    add_bin_option(parser)
    parser.add_argument("--split", default="test", help="split to read (default: test)")
    parser.add_argument("--limit", type=int, metavar="N", help="first N recordings only")
    if window:
        parser.add_argument(
            "--window",
            default="100%",
            metavar="PERCENT",
            help="first part of every recording, as in 50%% (default: 100%%)",
        )


def add_detail(parser: argparse.ArgumentParser, choices: tuple[str, ...], default: str) -> None:
    """Add the option that says how deep a run is simulated."""
    what = {
        "spikes": "decisions only",
        "counts": "events, energy, simple time model",
        "cycle": "the time of every message too",
    }
    told = "; ".join(f"{choice}: {what[choice]}" for choice in choices)
    parser.add_argument("--detail", choices=choices, default=default, help=f"{told} (default: {default})")
    parser.add_argument("--table", metavar="NAME|FILE.toml", help="price and time by this table only, or by your own")
    add_explain_cost(parser)


def add_explain_cost(parser: argparse.ArgumentParser) -> None:
    """Add the option that tells what was simulated."""
    parser.add_argument(
        "--explain-cost", action="store_true", help="say on stderr (and in --json) what was simulated, and why"
    )


def add_verify(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``verify``."""
    parser.add_argument("netlist")
    parser.add_argument("--checkpoint", required=True, metavar="CKPT|NET.onnx")
    add_network(parser)
    add_recordings(parser, window=True)
    parser.add_argument(
        "--original", metavar="CKPT", help="float model for E2 and E3 (default: the weights of --checkpoint)"
    )
    parser.add_argument(
        "--spec-samples", type=int, default=3, metavar="N", help="recordings for spec = engine (default: 3)"
    )
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        default=ENGINES[0],
        help=f"onnx: onnxruntime runs the integer graph beside our engine (default: {ENGINES[0]})",
    )
    parser.add_argument(
        "--min-agreement",
        type=float,
        metavar="X",
        help=f"share of equal decisions to pass (default: {MIN_AGREEMENT:g})",
    )
    parser.add_argument(
        "--require",
        metavar="E0,E2=X,E3=X",
        help="levels to pass instead: E0 specification = engine, E2 share of spikes in every layer, E3 of decisions",
    )
    add_explain_cost(parser)


def add_training(parser: argparse.ArgumentParser) -> None:
    """Add the options of a training."""
    parser.add_argument("--data", required=True, metavar="PATH", help=DATA_HELP)
    add_bin_option(parser)
    parser.add_argument(
        "--join", type=int, default=1, metavar="N", help="a step joins N bins, an event where one has any (default: 1)"
    )
    needing = ", ".join((*GRAPH_SYSTEMS, NATIVE))
    add_system(parser, f"default: {TACTILESGNET}; {needing} need a graph", NATIVE)
    parser.add_argument(
        "--padding",
        choices=PADDINGS,
        help="of a grid-cnn's window: none, moving by 2 (default), or same, of which no Loihi core holds all neurons",
    )
    add_graph_options(parser, "to train on")
    defaults = ", ".join(f"{recipe.epochs} ({name})" for name, recipe in RECIPES.items())
    parser.add_argument(
        "--recipe",
        choices=tuple(RECIPES),
        default=RELEASED.name,
        help="how: as the released code does, or with lasting currents and clocks (default: released)",
    )
    parser.add_argument(
        "--current-decay", metavar="LAYER=X[,…]", help="share of the synaptic current that a step keeps: fc1=0.95"
    )
    parser.add_argument(
        "--membrane-decay", metavar="LAYER=X[,…]", help="share of the membrane, where it is not 0.2: fc1=0.5"
    )
    parser.add_argument("--clocks", type=int, metavar="K", help="inputs that tell which K-th of the recording it is")
    parser.add_argument("--features", type=int, metavar="N", help="of the first layer, per place")
    parser.add_argument(
        "--copies", type=int, choices=tuple(BASES), help=f"axons of an input on TrueNorth (default: {USUAL_COPIES})"
    )
    parser.add_argument("--batch", type=int, metavar="N", help="recordings to a step of the optimizer")
    parser.add_argument(
        "--spike-penalty", type=float, metavar="X", help="loss of a spike on every synapse in every step: fewer spikes"
    )
    parser.add_argument("--epochs", type=int, metavar="N", help=f"default: {defaults}")
    parser.add_argument(
        "--decay-epochs",
        type=int,
        metavar="N",
        help=f"the learning rate falls to a tenth every N epochs, after epoch N + 1 first (default: {DECAY_EPOCHS})",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of weights and order (default: 0)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train N seeds side by side (default: 1)")
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted training of the same options")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    parser.add_argument(
        "--keep",
        action="append",
        choices=WEIGHTS,
        help="epoch to store: last, best (on test) or clean (on validation); may be repeated (default: all three)",
    )
    parser.add_argument("--picture", metavar="OUT.png", help="draw learning curves and confusion matrix")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.pt")


def add_model(parser: argparse.ArgumentParser, *, graph: bool = True) -> None:
    """Add the options that say how to read a checkpoint."""
    if graph:
        add_graph_options(parser, "that it was trained on")
    add_system(parser, "default: what the checkpoint is")
    parser.add_argument("--run", type=int, default=0, metavar="N", help="which run of a released file (default: 0)")
    parser.add_argument(
        "--weights",
        choices=WEIGHTS,
        help="epoch, where a checkpoint holds several (default: the first of these that it holds)",
    )
    parser.add_argument("--beta", type=float, help="membrane decay, where the file does not say (default: 0.2)")
    parser.add_argument("--theta", type=float, help="threshold, where the file does not say (default: 0.5)")


def add_network(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how to read a float network: a checkpoint on its graph, an ONNX or a NIR file."""
    add_model(parser)
    parser.add_argument("--polarities", type=int, metavar="N", help="of an ONNX or NIR input, where its shape is flat")
    order = parser.add_mutually_exclusive_group()
    for name, first in (("first", True), ("last", False)):
        order.add_argument(
            f"--polarities-{name}",
            dest="polarities_first",
            action="store_const",
            const=first,
            help=f"they are the {name} axis, where the shape of an ONNX or NIR input does not say",
        )
    add_steps(parser)


def add_steps(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how the time constants of a NIR file become decays."""
    parser.add_argument("--dt", type=float, metavar="SECONDS", help="time step that a NIR file is read in")
    parser.add_argument(
        "--convention",
        choices=CONVENTIONS,
        help=f"a step keeps 1 - dt/tau (euler) or exp(-dt/tau) (exponential) of a state (default: {CONVENTIONS[0]})",
    )


def cores_asked(words: str | None) -> dict[str, int] | None:
    """Least number of cores by layer, from the words of ``--cores-for``.

    Examples
    --------
    >>> cores_asked("conv1=8,fc1=6")
    {'conv1': 8, 'fc1': 6}

    Raises
    ------
    OptionError
        If they are none.
    """
    if words is None:
        return None
    found: dict[str, int] = {}
    for word in words.split(","):
        layer, _, count = word.strip().partition("=")
        if not layer or not (count.isascii() and count.isdecimal()) or int(count) == 0:
            raise OptionError(f"--cores-for {words}: {word!r} is not LAYER=N, N from 1; write for example fc1=6")
        if layer in found:
            raise OptionError(f"--cores-for {words}: names {layer} twice; give it once")
        found[layer] = int(count)
    return found


def add_compile(sub: argparse.ArgumentParser) -> None:
    """Add the options of a compilation."""
    sub.add_argument("checkpoint", help="checkpoint, or a network as an ONNX, NIR or netx file")
    add_network(sub)
    sub.add_argument("--against", metavar="NET.loom", help="list the weights that differ from another netlist's")
    sub.add_argument("--target", default="loihi1", help="chip: loihi1 (default), or truenorth, to hear why not")
    sub.add_argument(
        "--weight-bits",
        metavar="N[,N]",
        help="storage width, one or one a layer: 2 to 6 or 8 (default: 8)",
    )
    sub.add_argument("--planes", metavar="N[,N]", help="times a synapse is stored, 1 to 3 (default: 1)")
    sub.add_argument("--scale-groups", metavar="N[,N]", help="scales in a layer, 1 to 8 (default: 1)")
    sub.add_argument(
        "--spike-exact",
        action="store_true",
        help="add planes and scales until the training spikes are the float model's",
    )
    sub.add_argument("--keep-all", action="store_true", help="keep neurons that provably never fire or are never heard")
    sub.add_argument(
        "--prune-unused", action="store_true", help="leave out neurons that never fired on the training split, too"
    )
    sub.add_argument("--calibrate", metavar="PATH", help="recordings whose train split chooses the scales")
    add_bin_option(sub)
    sub.add_argument(
        "--in-time",
        type=int,
        metavar="N",
        help="truenorth: lower a history-free network, N axons an input (2 to 4), whose sums travel in 20 ticks a step",
    )
    sub.add_argument(
        "--ranges", default="proven", help=f"how overflow is excluded: {' or '.join(RANGES)} (default: proven)"
    )
    sub.add_argument("--margin", type=float, help=f"share added to observed ranges (default: {MARGIN:g})")
    sub.add_argument(
        "--cores-for",
        metavar="LAYER=N[,…]",
        help="at least N cores for a layer, which it shares with none, as in conv1=4,fc1=6",
    )
    sub.add_argument("--chips", type=int, default=1, metavar="N", help="use up to N chips (default: 1)")
    sub.add_argument(
        "--optimize",
        default="cores",
        metavar="GOAL",
        help=f"choose the cores for {', '.join(GOALS)}; the last two need --calibrate (default: cores)",
    )
    sub.add_argument(
        "--dump-after", action="append", default=[], choices=STAGES, help="print the network after a stage, on stderr"
    )
    sub.add_argument("-o", "--output", required=True, metavar="NET.loom")
