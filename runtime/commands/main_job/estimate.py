"""The command ``estimate``: synaptic operations, energy and time of an inference."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.targets.base import load_target, with_tables
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.compiler.targets.truenorth.netlist_file import is_crossbars
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import add_detail, add_recordings
from spikeloom.runtime.costs.estimate import estimate
from spikeloom.runtime.costs.estimates import estimate_json, estimate_text
from spikeloom.runtime.costs.spent import Account, explained
from spikeloom.runtime.inputs.recordings import netlist_recordings
from spikeloom.runtime.machines.loihi1.trace import BoolArray
from spikeloom.runtime.machines.truenorth import commands as truenorth
from spikeloom.runtime.report.console import progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("netlist")
    add_recordings(parser, window=True)
    add_detail(parser, ("counts", "cycle"), "counts")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], Callable[[dict[str, Any]], str], int]:
    """Run the command."""
    if is_crossbars(arguments.netlist):
        return truenorth.estimate(arguments)
    netlist = read_netlist(arguments.netlist)
    data = netlist_recordings(arguments, netlist)
    account = Account(netlist, data)
    account.begin(arguments.detail)
    _, report = priced(arguments, netlist, data)
    account.begin("no float")
    return report | explained(arguments, account), estimate_text, 0


def priced(
    arguments: argparse.Namespace, netlist: Netlist, data: Recordings, spikes: BoolArray | None = None
) -> tuple[IntArray, dict[str, Any]]:
    """Spikes of each compartment, and what the recordings cost at the detail that was asked for; fills `spikes`."""
    progress("running")
    target = load_target(netlist.target)
    target = target if arguments.table is None else with_tables(target, arguments.table)
    counts, found = estimate(
        netlist,
        target,
        with_clocks(data.events, netlist.clocks),
        lengths=data.lengths,
        detail=arguments.detail,
        spikes=spikes,
        progress=lambda done: progress(f"running: {done} of {len(data)}"),
    )
    return counts.spikes, estimate_json(netlist, target, found, bin_s=arguments.bin * netlist.bins)
