"""The command ``yardsticks``: what others count of the float model, beside what the chip does."""

from dataclasses import replace

from spikeloom.compiler.passes.expand import expand
from spikeloom.runtime.inputs.checkpoint import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import origin_of, recordings
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import YardsticksRequest
from spikeloom.runtime.studies import yardsticks

REQUEST = YardsticksRequest


def run(request: YardsticksRequest) -> Outcome:
    """Run the command."""
    from spikeloom.models.networks.reference import float_spikes

    checkpoint = load_checkpoint(request.checkpoint, request)
    graph, adjacency = propagation(checkpoint, load_graph(request, checkpoint.system), request.checkpoint)
    data = recordings(
        request.data,
        request.split,
        limit=request.limit,
        classes=checkpoint.classes,
        taxels=checkpoint.taxels,
        bin_s=request.bin,
        bins=checkpoint.bins,
        trained=origin_of(checkpoint.training),
    )
    spikes = float_spikes(expand(checkpoint, adjacency), data.events)
    found = yardsticks.measure(checkpoint, adjacency, data.events, spikes, lengths=data.lengths)
    return Outcome(replace(found, graph=graph), yardsticks.sections)
