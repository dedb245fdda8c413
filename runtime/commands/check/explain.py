"""The command ``explain``: why chip and float model differ on one recording.

The reference is the float model in float64, run from the synapses that the compiler expands; ``verify`` compares with
float32, as the model was trained.
"""

from __future__ import annotations

import argparse
import sys
from difflib import get_close_matches

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.interpret import channels_last
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.netlist import Netlist
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_netlist_and_model, add_recordings
from spikeloom.runtime.equivalence.explanation.causes import Explanation, explain, observe
from spikeloom.runtime.equivalence.explanation.sections import sections
from spikeloom.runtime.equivalence.explanation.summary import Explained, cause_roots, layer_roots, root_entry
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.integer import integer_machine_for
from spikeloom.runtime.report.sections import Outcome

NOTES = """\
An entry (neuron and step) that differs is a root if no input of the neuron differed since the last step in which both
sides fired; everything else follows from roots. Without --sample the first recording that differs is explained, of
the first ten or the first --limit. The reference is the float model in float64.
"""

LIMIT = 10
"""Recordings that are searched for a difference by default."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist_and_model(parser)
    add_recordings(parser)
    parser.add_argument("--sample", metavar="FILE", help="recording to explain (default: the first that differs)")
    parser.add_argument("--top", type=int, default=10, metavar="N", help="roots to show (default: 10)")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; differences are its subject, not a failure.

    Raises
    ------
    SpikeloomError
        If an option, the netlist, the checkpoint or the recordings cannot be used.
    """
    if arguments.top < 1:
        raise OptionError(f"--top {arguments.top}: at least 1 root can be shown; give a positive number")
    machine = integer_machine_for(arguments.netlist)
    netlist = machine.netlist
    loaded = load_network(arguments.checkpoint, arguments, netlist)
    require_match(netlist, loaded.model)
    _warn(netlist, loaded)
    if arguments.limit is None and arguments.sample is None:
        arguments.limit = LIMIT
    data = load_recordings(arguments, netlist)
    machine.require_sensor(data.events)
    chosen = range(len(data)) if arguments.sample is None else [_index(data, arguments.sample)]

    checkpoint, integer = loaded.checkpoint, machine.integer
    tuned = checkpoint is not None and checkpoint.forms is not None
    rounding = check_rounding(machine, loaded.network, fine_tuned=tuned)
    explanation: Explanation | None = None
    index = 0
    for index in chosen:
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        explanation = explain(
            loaded.network,
            integer,
            channels_last(events, netlist.clocks)[0],
            observe(machine, events),
            rounding=rounding,
            absent=machine.absent,
            unused=machine.unused,
            pruned=bool(netlist.provenance.get("prune_unused", False)),
        )
        if any(explanation.different):
            break
    assert explanation is not None, "recordings are never empty"
    names = [population.name for population in integer.populations]
    features = checkpoint.hops.shape[1] if checkpoint is not None and checkpoint.system in GRAPH_SYSTEMS else None
    result = Explained(
        sample=data.files[index],
        split=data.split,
        recording=index,
        searched=1 if arguments.sample is not None else index + 1,
        steps=data.steps_of(index),
        graph=loaded.graph,
        reference="float64",
        different=sum(explanation.different),
        roots=len(explanation.roots),
        diagnosis=explanation.diagnosis,
        layers=layer_roots(explanation, names),
        causes=cause_roots(explanation, names),
        faults=tuple(fault for layer in rounding.layers.values() for fault in layer.faults),
        top=tuple(
            root_entry(root, integer, None if root.root.layer else features)
            for root in explanation.roots[: arguments.top]
        ),
    )
    return Outcome(result, sections)


def _warn(netlist: Netlist, loaded: LoadedNetwork) -> None:
    """Say on stderr what the netlist remembers of its origin, where that is something else."""
    made, checkpoint, graph = netlist.provenance, loaded.checkpoint, loaded.graph
    if made.get("graph", graph) != graph:
        sys.stderr.write(f"spikeloom: warning: the netlist was compiled for graph {made['graph']}, this is {graph}\n")
    if made.get("checkpoint_sha256", loaded.sha256) != loaded.sha256:
        sys.stderr.write("spikeloom: warning: the netlist was compiled from another checkpoint file\n")
    elif checkpoint is not None and made.get("weights", checkpoint.weights) != checkpoint.weights:
        sys.stderr.write(
            f"spikeloom: warning: the netlist was compiled from the weights {made['weights']!r}, these are "
            f"{checkpoint.weights!r}; name them with --weights\n"
        )


def _index(data: Recordings, name: str) -> int:
    """Where a recording is."""
    if name in data.files:
        return data.files.index(name)
    near = get_close_matches(name, data.files, n=3, cutoff=0.5) or data.files[:3]
    raise DataError(
        f"--sample {name}: no such recording among {len(data)} of split {data.split}; near are {', '.join(near)}; "
        "'spikeloom run --json' lists the names"
    )
