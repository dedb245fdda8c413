"""The command ``anytime``: how early a decision could have been taken, and what that saves."""

import argparse

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import FloatArray
from spikeloom.runtime.commands.options import add_netlist, add_recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.capabilities import Stoppable, require_stoppable
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.anytime import exits
from spikeloom.runtime.studies.anytime.sections import sections
from spikeloom.runtime.studies.anytime.study import study

NOTES = """\
By proof: stop once no further spike can change the vote. With --calibrate also: stop once the leader is ahead by a
times the root of the steps left, where a is the smallest factor that lets no more than --differ of the training split's
races for second place end otherwise, or of its decisions with --held-out. Figures are of --split.
"""

ALLOWED = (0.0, 0.005, 0.01, 0.02, 0.05)
"""Shares of calibration races that may end otherwise, all of them reported."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist(parser)
    add_recordings(parser)
    parser.add_argument("--calibrate", metavar="PATH", help="recordings whose train split says when a vote is sure")
    words = "the network was not trained on --calibrate: its decisions count, not races for second place"
    parser.add_argument("--held-out", action="store_true", help=words)
    parser.add_argument("--differ", type=float, metavar="X", help="share of them that may end otherwise (default: 0)")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write the result with figures of every recording")
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_place(arguments.output, "-o", arguments)
    allowed = _allowed(arguments)
    machine = require_stoppable(machine_for(arguments.netlist), arguments.netlist, "anytime")
    data = load_recordings(arguments, machine.netlist)
    machine.require_sensor(data.events)
    points = _races(arguments, machine)
    progress("running")
    ran = machine.cumulative(data.events, data.step_counts)
    result = study(
        machine,
        data,
        ran,
        () if points is None else [exits.calibrate(points, share) for share in sorted(allowed)],
        calibrated_on=arguments.calibrate,
        held_out=arguments.held_out,
        chosen=None if points is None else sorted(allowed).index(allowed[0]) + 1,
    )
    write_json(arguments.output, result)
    return Outcome(result, sections)


def _allowed(arguments: argparse.Namespace) -> list[float]:
    """Shares to calibrate for, the chosen one first."""
    given = "--held-out" if arguments.held_out else "" if arguments.differ is None else f"--differ {arguments.differ:g}"
    if given and arguments.calibrate is None:
        raise OptionError(f"{given}: nothing to calibrate on; add --calibrate or omit it")
    chosen = arguments.differ or 0.0
    if not 0 <= chosen < 1:
        raise OptionError(f"--differ {chosen:g}: not a share; give a number from 0 to below 1")
    return [chosen, *(share for share in ALLOWED if share != chosen)]


def _races(arguments: argparse.Namespace, machine: Stoppable) -> FloatArray | None:
    """Turning points of races or decisions of the training split, if there is something to calibrate on."""
    if arguments.calibrate is None:
        return None
    named = {"data": arguments.calibrate, "split": "train", "limit": None}
    training = load_recordings(argparse.Namespace(**vars(arguments) | named), machine.netlist)
    machine.require_sensor(training.events)
    progress("calibrating")
    lengths, race = training.step_counts, exits.standing if arguments.held_out else exits.races
    return exits.turning_points(race(machine.cumulative(training.events, lengths).votes, lengths))
