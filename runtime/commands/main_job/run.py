"""The command ``run``: decisions and spikes, bit for bit the chip's."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.targets.truenorth.netlist_file import is_crossbars
from spikeloom.runtime.commands.main_job.estimate import priced
from spikeloom.runtime.commands.options import add_detail, add_recordings
from spikeloom.runtime.costs.spent import Account, explained
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import netlist_recordings
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.truenorth import commands as truenorth
from spikeloom.runtime.machines.votes import class_counts, predictions
from spikeloom.runtime.report import decisions
from spikeloom.runtime.report.console import progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("netlist")
    add_recordings(parser, window=True)
    add_detail(parser, ("spikes", "counts", "cycle"), "spikes")
    parser.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], Callable[[dict[str, Any]], str], int]:
    """Run the command."""
    if arguments.spikes is not None:
        require_place(arguments.spikes, "--spikes", arguments)
    if is_crossbars(arguments.netlist):
        return truenorth.run(arguments)
    netlist = read_netlist(arguments.netlist)
    data = netlist_recordings(arguments, netlist)
    progress("running")
    events = with_clocks(data.events, netlist.clocks)
    account = Account(netlist, data)
    found: dict[str, Any] | None = None
    if arguments.detail == "spikes":
        account.begin("spikes" if arguments.spikes is None else "spikes kept")
        trace = engine.simulate(netlist, events, lengths=data.lengths, spikes=arguments.spikes is not None)
        spikes, kept = trace.counts.spikes, trace.spikes
    else:
        shape = len(data), data.steps + netlist.max_depth, netlist.n_compartments
        kept = None if arguments.spikes is None else np.zeros(shape, np.bool_)
        account.begin(arguments.detail)
        spikes, found = priced(arguments, netlist, data, kept)
    account.begin("no float")
    if kept is not None:
        layers = {layer.name: aligned(netlist, kept, i) for i, layer in enumerate(netlist.layers)}
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **layers)  # type: ignore[arg-type]
    decided = predictions(netlist, spikes)
    report = decisions.run_json(data.files, data.labels, class_counts(netlist, spikes), decided)
    report |= {} if found is None else {"costs": found}
    return report | explained(arguments, account), decisions.run_text, 0
