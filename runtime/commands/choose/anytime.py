"""The command ``anytime``: how early a decision could have been taken, and what that saves."""

from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import FloatArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.recordings import in_steps, load_recordings, warn_of_shared
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.capabilities import Stoppable
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.choose import AnytimeRequest
from spikeloom.runtime.studies.anytime import exits
from spikeloom.runtime.studies.anytime.sections import sections
from spikeloom.runtime.studies.anytime.study import study

NOTES = """\
By proof: stop once no further spike can change the decision. With --calibrate also: stop once the leading class is
ahead by a times the root of the steps left. On recordings that a network was trained on its classes lead by too far, so
a is the smallest factor that lets no more than --differ of the training split's races for second place end otherwise,
or of its decisions with --held-out. Figures are of --split.
"""

ALLOWED = (0.0, 0.005, 0.01, 0.02, 0.05)
"""Shares of calibration races that may end otherwise, all of them reported."""


REQUEST = AnytimeRequest


def run(request: AnytimeRequest) -> Outcome:
    """Run the command."""
    require_place(request.output, "-o", request)
    allowed = _allowed(request)
    machine = Stoppable.required(machine_for(request.netlist), request.netlist, "anytime")
    data = load_recordings(request.data, request, machine.netlist)
    points = _races(request, machine, data)
    progress("running")
    ran = machine.cumulative(data.events, data.step_counts)
    result = study(
        machine,
        data,
        ran,
        () if points is None else [exits.calibrate(points, share) for share in sorted(allowed)],
        calibrated_on=request.calibrate,
        held_out=request.held_out,
        chosen=None if points is None else sorted(allowed).index(allowed[0]) + 1,
    )
    write_json(request.output, result)
    return Outcome(result, sections)


def _allowed(request: AnytimeRequest) -> list[float]:
    """Shares to calibrate for, the chosen one first."""
    given = (
        "--held-out"
        if request.held_out
        else ""
        if request.differ is None
        else f"--differ {request.differ:g}"
    )
    if given and request.calibrate is None:
        raise OptionError(f"{given}: nothing to calibrate on; add --calibrate or omit it")
    chosen = request.differ or 0.0
    if not 0 <= chosen < 1:
        raise OptionError(f"--differ {chosen:g}: not a share; give a number from 0 to below 1")
    return [chosen, *(share for share in ALLOWED if share != chosen)]


def _races(request: AnytimeRequest, machine: Stoppable, data: Recordings) -> FloatArray | None:
    """Turning points of races or decisions of the training split, if there is something to calibrate on."""
    if request.calibrate is None:
        return None
    whole = replace(request, split="train", limit=None)
    calibrating = load_recordings(request.calibrate, whole, machine.netlist, joined=False)
    known = machine.netlist.provenance.get("train_sha256")
    if request.held_out and calibrating.events_sha256 == known:
        raise OptionError(f"--held-out: {request.calibrate} trained the network; omit it, or give others")
    training = in_steps(calibrating, machine.netlist)
    warn_of_shared(training, data)
    progress("calibrating")
    lengths = training.step_counts
    race = exits.standing if request.held_out else exits.races
    return exits.turning_points(race(machine.cumulative(training.events, lengths).votes, lengths))
