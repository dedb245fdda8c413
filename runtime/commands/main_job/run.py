"""The command ``run``: decisions and spikes, bit for bit the chip's."""

from __future__ import annotations

import argparse

import numpy as np

from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.commands.main_job.decisions import Decisions, sections
from spikeloom.runtime.commands.main_job.estimate import priced
from spikeloom.runtime.commands.options import add_detail, add_netlist, add_recordings
from spikeloom.runtime.costs.simulated import Account, Accounted
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import netlist_recordings
from spikeloom.runtime.machines.base import Price, machine_for
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.sections import Outcome


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist(parser)
    add_recordings(parser, window=True)
    add_detail(parser, ("spikes", "counts", "cycle"), "spikes")
    parser.add_argument("--spikes", metavar="OUT.npz", help="write the spikes of every layer, aligned with the data")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    keep = arguments.spikes is not None
    if keep:
        require_place(arguments.spikes, "--spikes", arguments)
    machine = machine_for(arguments.netlist)
    data = netlist_recordings(arguments, machine.netlist)
    account = Account(machine, data)
    price: Price | None = None
    if arguments.detail == "spikes":
        account.begin("spikes kept" if keep else "spikes")
        progress("running")
        done = machine.run(data.events, lengths=data.lengths, spikes=keep)
    else:
        account.begin(arguments.detail)
        done, price = priced(arguments, machine, data, spikes=keep)
    account.begin("no float")
    if done.spikes is not None:
        with write_atomically(arguments.spikes) as file:
            np.savez_compressed(file, **done.spikes)  # type: ignore[arg-type]
    found = Decisions(
        files=data.files,
        labels=data.labels,
        predictions=done.decisions,
        counts=done.votes,
        price=price,
        costs=None if price is None else price.outcome.result,
    )
    result = Accounted(result=found, explained_cost=account.explained(arguments.explain_cost))
    return Outcome(result, lambda result: sections(result.result))
