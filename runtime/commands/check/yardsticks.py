"""The command ``yardsticks``: what others count of the float model, beside what the chip does."""

import argparse
from dataclasses import replace

from spikeloom.runtime.commands.options import add_checkpoint, add_recordings
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import origin_of, recordings
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies import yardsticks


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_checkpoint(parser)
    add_recordings(parser)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    from spikeloom.models.networks.reference import float_spikes

    checkpoint = load_checkpoint(arguments.checkpoint, arguments)
    graph, adjacency = propagation(checkpoint, load_graph(arguments, checkpoint.system), arguments.checkpoint)
    data = recordings(
        arguments.data,
        arguments.split,
        limit=arguments.limit,
        classes=checkpoint.classes,
        taxels=checkpoint.taxels,
        bin_s=arguments.bin,
        bins=checkpoint.bins,
        trained=origin_of(checkpoint.training),
    )
    spikes = float_spikes(checkpoint, adjacency, data.events)
    found = yardsticks.measure(checkpoint, adjacency, data.events, spikes, lengths=data.lengths)
    return Outcome(replace(found, graph=graph), yardsticks.sections)
