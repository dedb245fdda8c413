"""The command ``explain``: why chip and float model differ on one recording.

The reference is the float model in float64, run from the synapses that the compiler expands; ``verify``
compares with float32, as the model was trained.
"""

from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.interpret import Activity, channels_last
from spikeloom.runtime.equivalence.explanation.causes import explain
from spikeloom.runtime.equivalence.explanation.results import Explained, sections
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import find_recording, load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.capabilities import Explainable
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import ExplainRequest

NOTES = """\
An entry (neuron and step) that differs is a root if no input of the neuron differed since the last step in which both
sides fired; everything else follows from roots. Without --sample the first recording that differs is explained, if
it is among the first ten (or --limit). The reference is the float model in float64.
"""

LIMIT = 10
"""Recordings that are searched for a difference by default."""


REQUEST = ExplainRequest


def run(request: ExplainRequest) -> Outcome:
    """Run the command; differences are its subject, not a failure."""
    if request.top < 1:
        raise OptionError(f"--top {request.top}: at least 1 root can be shown; give a positive number")
    machine = Explainable.required(machine_for(request.netlist), request.netlist, "explain")
    netlist = machine.netlist
    loaded = load_network(request.checkpoint, request, netlist)
    require_match(netlist, loaded.network)
    loaded.require_same(request.netlist, netlist, request.run)
    if request.limit is None and request.sample is None:
        request = replace(request, limit=LIMIT)
    data = load_recordings(request.data, request, netlist)
    chosen = (
        range(len(data))
        if request.sample is None
        else [find_recording(data, request.sample, "--sample/--recording")]
    )

    machine.require_windows()
    check = machine.check_lowering(loaded.network)
    compensated = [name for name, layer in check.layers.items() if layer.compensated]
    deviations = machine.deviations(loaded.network, compensated)
    for index in chosen:
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        ran = machine.run(events, spikes=True, membranes=True)
        explanation = explain(
            loaded.network,
            deviations,
            channels_last(events, netlist.clocks)[0],
            Activity(spikes=tuple(ran.spikes.values()), membranes=tuple(ran.membranes.values())),
            absent=machine.absent,
            unread=machine.unread,
            pruned=bool(netlist.provenance.get("prune_unused", False)),
        )
        if explanation.different:
            break
    result = Explained(
        sample=data.files[index],
        split=data.split,
        recording=index,
        searched=1 if request.sample is not None else index + 1,
        steps=data.steps_of(index),
        graph=loaded.graph,
        explanation=explanation,
        faults=check.faults,
        top=explanation.found[: request.top],
    )
    return Outcome(result, sections)
