"""The command ``report``: everything about one netlist on one page, and the same as tables on the terminal."""

from typing import Any

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import sha256_of, write_atomically
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.inputs.recordings import find_recording, in_steps, load_recordings
from spikeloom.runtime.machines.backends import backend_of, describe, machine_for
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.page.recording import recording
from spikeloom.runtime.page.results import Decisions, Report, provenance, taxels
from spikeloom.runtime.page.sections import about, sections
from spikeloom.runtime.report import html
from spikeloom.runtime.report.console import Progress, progress
from spikeloom.runtime.report.sections import Outcome, Section, Text
from spikeloom.runtime.requests.main_job import ReportRequest
from spikeloom.runtime.studies.robustness.results import Stress
from spikeloom.runtime.studies.robustness.stress_sections import read_stress

NOTES = """\
The page opens from disk and loads nothing; its figures are inline SVG, each with its numbers as a table. What is
printed is the same for people who open no page; --json prints the data behind both. The exit code is 1 if specification
and engine differ.
"""


REQUEST = ReportRequest


def run(request: ReportRequest) -> Outcome:
    """Run the command; nothing is written before everything is known."""
    require_place(request.output, "-o", request, ["html"])
    machine = machine_for(request.netlist)
    netlist = machine.netlist
    battery = None
    if request.stress is not None:
        sha256 = sha256_of(request.netlist)
        battery = read_stress(request.stress, request.netlist, sha256)
    reference = backend_of(netlist.target).reference(request, netlist)
    if reference.loaded is None:
        raise OptionError(
            f"--checkpoint {request.checkpoint}: there is no float model to show beside the chip"
        )
    if isinstance(machine, Comparable):
        require_match(netlist, reference.loaded.network)
    reference.loaded.require_same(request.netlist, netlist, request.run)
    data = load_recordings(request.data, request, netlist, labels_for="report", joined=False)
    report = _report(request, machine, reference.network, reference.loaded, data, battery)
    made = report.provenance
    title = f"{made.netlist.file} on {made.data.file}"
    with write_atomically(request.output) as file:
        file.write(html.page(title, about(report), sections(report)).encode())

    def printed(report: Report) -> list[Section]:
        return [*sections(report), Section("", [Text(f"page: {report.output}")])]

    return Outcome(report, printed, 1 if report.verify.missed else 0)


def _report(
    request: ReportRequest,
    machine: Machine,
    source: Any,
    loaded: LoadedNetwork,
    recorded: Recordings,
    stress: Stress | None,
) -> Report:
    """All that the page shows."""
    netlist = machine.netlist
    data = in_steps(recorded, netlist)
    chosen = None if request.recording is None else find_recording(data, request.recording, "--recording")
    count = Progress(len(data))
    verdict = verify(
        netlist,
        source,
        data,
        original=loaded.network,
        spec_samples=request.spec_samples,
        required={"E0": 1.0},
        progress=lambda part, done: count(done, part),
    )
    decided = verdict.float_predictions
    assert decided is not None, "there is a float model"
    if chosen is None:
        first = verdict.first_divergence
        apart = np.flatnonzero(decided != verdict.chip_predictions)
        chosen = int(apart[0]) if len(apart) else 0 if first is None else data.files.index(first.file)
    progress("pricing")
    ran, price = machine.price(data.held, lengths=data.lengths, bin_s=data.seconds, counts=True)
    origin = provenance(request, netlist, machine.target, loaded, recorded, data.files[chosen])
    described = describe(request.netlist)
    return Report(
        verify=verdict,
        decisions=Decisions(
            classes=netlist.classes,
            files=verdict.files,
            labels=verdict.labels,
            model=decided,
            chip=verdict.chip_predictions,
        ),
        netlist=described.result,
        cores=machine.core_map(data.events, data.step_counts, ran.counts),
        taxels=taxels(machine, loaded, data, ran.counts, request.taxels),
        recording=recording(machine, loaded, data, chosen) if isinstance(machine, Comparable) else None,
        costs=price.outcome.result,
        provenance=origin,
        output=request.output,
        described=described,
        price=price,
        figures=machine.figures(price),
        stress=stress,
    )
