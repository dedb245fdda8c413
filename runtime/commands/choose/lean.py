"""The command ``lean``: what of a network its recordings do not need, what that costs, and a netlist without it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.storage import Fixed, Given
from spikeloom.compiler.targets.compartments import write_netlist
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.models.recordings.events import joined_bins, of_length
from spikeloom.runtime.inputs import repeat
from spikeloom.runtime.inputs.checkpoint import load_graph
from spikeloom.runtime.inputs.compilation import known_of, remembered
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import (
    recordings,
    require_splits,
    step_of,
    warn_of_length,
    warn_of_shared,
)
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choose import LeanRequest
from spikeloom.runtime.studies.pruning.results import sections
from spikeloom.runtime.studies.pruning.study import study
from spikeloom.runtime.studies.pruning.trials import narrowed

NOTES = """\
Everything is chosen on the training split and reported on --split: how many decisions change, how many are right,
operations, energy and time. Neurons, taxels or hops are left out, one kind at a time; -o writes the network that takes
least energy on the training split.
"""


REQUEST = LeanRequest


def run(request: LeanRequest) -> Outcome:
    """Run the command."""
    if not 0 <= request.differ < 1:
        raise OptionError(f"--differ {request.differ:g}: not a share; give a number from 0 to below 1")
    require_place(request.output, "-o", request, ["loom"])
    require_place(request.network, "--network", request, ["pt"])
    loaded = load_network(request.checkpoint, request)
    plain = (
        loaded.checkpoint is not None and loaded.checkpoint.forms is None and loaded.checkpoint.towers == 1
    )
    if request.network is not None and not plain:
        raise OptionError(
            f"--network {request.network}: {request.checkpoint} is no single checkpoint in floats; omit it, or "
            "give what that was fine-tuned or joined from"
        )
    require_splits(request.data)
    progress("reading the recordings")
    taken = loaded.network.input
    shared: dict[str, Any] = {
        "bin_s": request.bin,
        "taxels": taken.taxels,
        "labels_for": "lean",
    }
    trained = origin_of(loaded.training) | step_of(loaded.read_as, taken.bins)
    shared |= {"classes": loaded.network.classes, "trained": trained}
    known = recordings(request.data, "train", **shared)
    reported = recordings(request.data, request.split, limit=request.limit, bins=taken.bins, **shared)
    training = of_length(joined_bins(known, taken.bins), taken.clocks.length)
    warn_of_length(reported, taken.clocks, trained)
    test = of_length(reported, taken.clocks.length)
    warn_of_shared(training, test)
    result, netlist, spared = study(loaded, training, test, request.differ, request.output)
    if request.output is not None:
        lean = {"differ": result.differ} | encode(result.rows[result.taken].removed)
        forms = loaded.network.forms
        made = known_of(request, loaded, known)
        made |= remembered(Fixed() if forms is None else Given(forms))
        made |= {
            "keep_all": False,
            "prune_unused": True,
            "ranges": "proven",
            "calibrated": True,
            "lean": lean,
        }
        write_netlist(replace(netlist, provenance={**netlist.provenance, **made}), request.output)
    if request.network is not None and loaded.checkpoint is not None:
        from spikeloom.compiler.formats.own_checkpoint import save_again

        graph = load_graph(request, loaded.checkpoint.system)
        given = loaded.checkpoint
        edges = graph.edges if given.edges is None and graph is not None else given.edges
        typed = repeat.words({"data": test.source, "differ": result.differ})
        made = origin_of(loaded.training) | {
            "command": repeat.command("lean", Path(request.checkpoint).name, *typed)
        }
        less = narrowed(replace(given, graph=loaded.graph, edges=edges), spared)
        save_again(request.network, less, training=made | {"pruned_from": loaded.sha256})
    return Outcome(result, sections)
