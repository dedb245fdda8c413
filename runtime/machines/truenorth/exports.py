"""Files of crossbar cores for other programs."""

from dataclasses import dataclass

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats import ranc
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.exports import Export, Facts, Format
from spikeloom.runtime.requests.choices import SplitChoice
from spikeloom.runtime.requests.exchange import ExportRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class RancFacts(Facts):
    """What a file for RANC holds; `ticks` to run it for, None without a recording."""

    ticks: int | None


def _ranc(request: ExportRequest) -> Export:
    from spikeloom.runtime.machines.truenorth.machine import load  # numba, so only here

    netlist = load(request.source).netlist
    events = None
    if request.data is not None:
        choice = SplitChoice(split=request.split or "test", bin=request.bin)
        data = load_recordings(request.data, choice, netlist)
        number = request.recording or 0
        if not 0 <= number < len(data.files):
            raise OptionError(f"--recording {number}: --data has recordings 0 to {len(data.files) - 1}")
        events = with_clocks(data.events[number : number + 1, ..., : data.steps_of(number)], netlist.clocks)[
            0
        ]
    ticks = None if events is None else netlist.ticks(events.shape[1]) + 1
    path = request.output
    out = request.output.removesuffix(".json") + ".out"
    shown = "no recording, add packets" if ticks is None else f"{ticks} ticks"
    return Export(
        content=(f"{line}\n".encode() for line in ranc.export(netlist, events)),
        facts=RancFacts(neurons=netlist.n_neurons, synapses=netlist.n_synapses, ticks=ticks),
        lines=(f"run: ranc_sim {path} {out} {path} TICKS ({shown})",),
    )


FORMATS = (
    Format(
        name="ranc",
        title="TrueNorth cores, and a recording, for RANC's simulator, JSON",
        write=_ranc,
        options=("data", "split", "bin", "recording"),
        ending="json",
    ),
)
