"""The command ``lean``: what of a network its recordings do not need, what that costs, and a netlist without it."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler import __version__, write_netlist
from spikeloom.compiler.errors import OptionError
from spikeloom.models.recordings.events import of_length
from spikeloom.runtime.commands.options import NETWORK_FILES, add_network, add_recordings
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.compilation import storage
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_graph, load_network
from spikeloom.runtime.inputs.recordings import origin_of, recordings, require_splits
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.pruning.results import sections
from spikeloom.runtime.studies.pruning.study import study
from spikeloom.runtime.studies.pruning.trials import narrowed

NOTES = """\
Everything is chosen on the training split and reported on --split: how many decisions change, what is right,
operations, energy and time. What -o writes is what takes least energy on the training split, without neurons, without
taxels or without hops.
"""

DIFFER = 0.01


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("checkpoint", metavar=NETWORK_FILES, help="trained network")
    add_network(parser)
    add_recordings(parser)
    what = f"share of training decisions that the netlist may change (default: {DIFFER:g})"
    parser.add_argument("--differ", type=float, default=DIFFER, metavar="X", help=what)
    parser.add_argument("-o", "--output", metavar="OUT.loom", help="write the netlist without what may go")
    parser.add_argument("--network", metavar="OUT.pt", help="write the float network without dense neurons that may go")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    if not 0 <= arguments.differ < 1:
        raise OptionError(f"--differ {arguments.differ:g}: not a share; give a number from 0 to below 1")
    require_place(arguments.output, "-o", arguments, ["loom"])
    require_place(arguments.network, "--network", arguments, ["pt"])
    loaded = load_network(arguments.checkpoint, arguments)
    plain = loaded.checkpoint is not None and loaded.checkpoint.forms is None and loaded.checkpoint.towers == 1
    if arguments.network is not None and not plain:
        raise OptionError(
            f"--network {arguments.network}: {arguments.checkpoint} is no single checkpoint in floats; omit it, or "
            "give what that was fine-tuned or joined from"
        )
    require_splits(arguments.data)
    progress("reading the recordings")
    taken = loaded.network.input
    shared: dict[str, Any] = {"bin_s": arguments.bin, "bins": taken.bins, "taxels": taken.taxels, "labels_for": "lean"}
    shared |= {"classes": loaded.network.classes, "trained": origin_of(loaded.training)}
    found = (("train", None), (arguments.split, arguments.limit))
    each = (recordings(arguments.data, split, limit=limit, **shared) for split, limit in found)
    training, test = (of_length(data, taken.clocks.length) for data in each)
    result, netlist, spared = study(loaded, training, test, arguments.differ, arguments.output)
    if arguments.output is not None:
        lean = {"differ": result.differ} | encode(result.rows[result.taken].removed)
        made = {"spikeloom": __version__, "checkpoint_sha256": loaded.sha256, **loaded.origin(arguments.run)}
        made |= {**origin_of(loaded.training), **storage(None, loaded.network.forms)}
        made |= {"keep_all": False, "prune_unused": True, "ranges": "proven", "calibrated": True, "lean": lean}
        write_netlist(replace(netlist, provenance={**netlist.provenance, **made}), arguments.output)
    if arguments.network is not None and loaded.checkpoint is not None:
        from spikeloom.models.networks.checkpoint import save_again

        asked, given = load_graph(arguments, loaded.checkpoint.system), loaded.checkpoint
        edges = asked.edges if given.edges is None and asked is not None else given.edges
        typed = repeat.words({"data": test.source, "differ": result.differ})
        made = origin_of(loaded.training) | {"command": repeat.command("lean", Path(arguments.checkpoint).name, *typed)}
        less = narrowed(replace(given, graph=loaded.graph, edges=edges), spared)
        save_again(arguments.network, less, training=made | {"pruned_from": loaded.sha256})
    return Outcome(result, sections)
