"""The command ``cosimulate``: a netlist in a hardware description that others wrote, spike by spike."""

import argparse
import tempfile
from pathlib import Path

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.commands.options import add_netlist, add_recordings, group
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.report.sections import Outcome


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist(parser)
    add_recordings(parser)
    options = group(parser, "hardware")
    options.add_argument("--rtl", required=True, metavar="FOLDER", help="a clone of github.com/UA-RCL/RANC (TrueNorth)")
    options.add_argument("--simulator", choices=("verilator", "iverilog"), help="default: verilator, if it is there")
    what = "keep what is built and finished, and go on from it (a minute a recording)"
    options.add_argument("--work", metavar="FOLDER", help=what)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 where a spike, a membrane or a packet differs."""
    from spikeloom.runtime.machines.truenorth import cosimulation
    from spikeloom.runtime.machines.truenorth.machine import TrueNorth

    machine = machine_for(arguments.netlist)
    if not isinstance(machine, TrueNorth):
        raise OptionError(
            f"{arguments.netlist}: no hardware description of {machine.target.title} is known; give another netlist"
        )
    data = load_recordings(arguments, machine.netlist)
    machine.require_sensor(data.events)
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as temporary:
        folder = Path(arguments.work or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        options = {"rtl": arguments.rtl, "simulator": arguments.simulator, "bin_s": arguments.bin}
        return cosimulation.cosimulate(machine, data, folder=folder, **options)
