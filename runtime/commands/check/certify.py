"""The command ``certify``: which decisions no small change of a recording alters, and what alters the others."""

from __future__ import annotations

from dataclasses import replace

from spikeloom.compiler.errors import require_least
from spikeloom.compiler.files import sha256_of
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.inputs.checkpoint import places_of
from spikeloom.runtime.inputs.files import require_place, write_picture
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.drawing import PICTURES
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import CertifyRequest
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.robustness.certificate_file import write_certificate
from spikeloom.runtime.studies.robustness.certify_sections import sections, taxel_map
from spikeloom.runtime.studies.robustness.exhaustive import certify, expected_seconds
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.results import Provenance

KINDS = "; ".join(kind.what for kind in EXHAUSTIVE.values())

NOTES = f"""\
On each recording every change of these kinds is tried, none is sampled: {KINDS}.
For several changed events it reports how many are proven to alter nothing, and how many are shown to suffice.
"""


TOLD_S = 60
"""Seconds from which on it is said how long it takes."""

REQUEST = CertifyRequest


@on_cluster
def run(request: CertifyRequest) -> Outcome:
    """Run the command."""
    require_place(request.output, "-o", request)
    require_place(request.certificate, "--certificate", request)
    require_place(request.picture, "--picture", request, PICTURES)
    require_least(vars(request), shift=0, most=1, jobs=1)
    machine = machine_for(request.netlist)
    data = load_recordings(request.data, request, machine.netlist, labels_for="certify", joined=False)
    singles = int(data.step_counts.sum()) * data.taxels * data.events.shape[2]
    seconds = expected_seconds(machine, data, request.jobs)
    lasting = "" if seconds is None or seconds < TOLD_S else f", at most about {seconds / 60:,.0f} min"
    tell(
        f"trying {singles:,} single events of {number(len(data), 'recording')}{lasting}, then every other change"
    )
    certificates = certify(machine, data, shift=request.shift, most=request.most, jobs=request.jobs)
    places = places_of(None, machine.netlist.provenance, data.taxels)
    result = replace(certificates, provenance=Provenance.of(request, data.sha256), places=places)
    if request.certificate is not None:
        write_certificate(request.certificate, result, sha256_of(request.netlist))
    write_picture(request.picture, lambda: taxel_map(result))
    write_json(request.output, result)
    return Outcome(result, sections)
