"""Run a TrueNorth netlist in RANC's hardware description, and compare every spike, membrane and packet with ours.

    python benchmarks/cosimulate.py NET.loom DATA --rtl RANC [--simulator iverilog] [--work FOLDER] [--limit N] [--json]

RANC is a clone of github.com/UA-RCL/RANC; a recording takes a minute or so by verilator. What is built and finished
stays in the folder of ``--work``, and the same command goes on from it. The exit code is 1 where something differs.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from spikeloom.compiler.errors import OptionError, SpikeloomError
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.truenorth.cosimulation import SIMULATORS, cosimulate
from spikeloom.runtime.machines.truenorth.machine import TrueNorth
from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.sections import Outcome, terminal
from spikeloom.runtime.requests.choices import SplitChoice


def main(arguments: argparse.Namespace) -> Outcome:
    """Run the recordings."""
    machine = machine_for(arguments.netlist)
    if not isinstance(machine, TrueNorth):
        raise OptionError(f"{arguments.netlist}: no hardware description of {machine.target.title} is known")
    choice = SplitChoice(split=arguments.split, limit=arguments.limit)
    data = load_recordings(arguments.data, choice, machine.netlist)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(arguments.work or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return cosimulate(
            machine,
            data,
            rtl=arguments.rtl,
            simulator=arguments.simulator,
            folder=folder,
            bin_s=data.seconds,
        )


def options(words: list[str] | None = None) -> argparse.Namespace:
    """What was typed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("netlist")
    parser.add_argument("data")
    parser.add_argument("--rtl", required=True)
    parser.add_argument("--simulator", choices=tuple(SIMULATORS))
    parser.add_argument("--work")
    parser.add_argument("--split", default="test")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(words)


if __name__ == "__main__":
    given = options()
    try:
        outcome = main(given)
    except (SpikeloomError, OSError) as error:
        sys.exit(str(error))
    print(json.dumps(encode(outcome.result)) if given.json else terminal(outcome.sections(outcome.result)))
    sys.exit(outcome.code)
