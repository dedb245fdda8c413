"""The command ``estimate``: synaptic operations, energy and time of an inference."""

from __future__ import annotations

import argparse

from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_detail, add_netlist, add_recordings
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.base import Machine, Price, Run, machine_for
from spikeloom.runtime.machines.simulated import Account, Accounted
from spikeloom.runtime.report.sections import Outcome


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist(parser)
    add_recordings(parser, window=True)
    add_detail(parser, ("counts", "cycle"), "counts")


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    machine = machine_for(arguments.netlist)
    data = load_recordings(arguments, machine.netlist)
    account = Account(machine, data)
    _, price = priced(arguments, machine, data, account)
    account.begin("no float")
    shown = price.outcome
    result = Accounted(result=shown.result, explained_cost=account.explained(arguments.explain_cost))
    return Outcome(result, lambda result: shown.sections(result.result))


def priced(arguments: argparse.Namespace, machine: Machine, data: Recordings, account: Account) -> tuple[Run, Price]:
    """Run the recordings and price them as the options say."""
    account.begin(arguments.detail)
    return machine.price(
        data.events,
        bin_s=arguments.bin,
        lengths=data.lengths,
        detail=arguments.detail,
        table=arguments.table,
        progress=lambda done: account.begin(arguments.detail, done),
    )
