"""The command ``cosimulate``: a netlist in a hardware description that others wrote, spike by spike."""

import tempfile
from pathlib import Path

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import CosimulateRequest

REQUEST = CosimulateRequest


def run(request: CosimulateRequest) -> Outcome:
    """Run the command; exit code 1 where a spike, a membrane or a packet differs."""
    from spikeloom.runtime.machines.truenorth import cosimulation
    from spikeloom.runtime.machines.truenorth.machine import TrueNorth

    machine = machine_for(request.netlist)
    if not isinstance(machine, TrueNorth):
        raise OptionError(
            f"{request.netlist}: no hardware description of {machine.target.title} is known; give another netlist"
        )
    data = load_recordings(request.data, request, machine.netlist)
    machine.require_sensor(data.events)
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as temporary:
        folder = Path(request.work or temporary)
        folder.mkdir(parents=True, exist_ok=True)
        return cosimulation.cosimulate(
            machine, data, folder=folder, rtl=request.rtl, simulator=request.simulator, bin_s=data.seconds
        )
