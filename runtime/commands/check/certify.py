"""The command ``certify``: which decisions no small change of a recording alters, and what alters the others."""

from __future__ import annotations

from dataclasses import replace

from spikeloom.compiler.errors import require_least
from spikeloom.compiler.files import sha256_of
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.inputs.checkpoint import places_of
from spikeloom.runtime.inputs.files import require_place, write_picture
from spikeloom.runtime.inputs.network import LoadedNetwork, load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.drawing import PICTURES
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import CertifyRequest
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.robustness.certificate_file import write_certificate
from spikeloom.runtime.studies.robustness.certify_sections import sections, taxel_map
from spikeloom.runtime.studies.robustness.exhaustive import certify, expected_seconds
from spikeloom.runtime.studies.robustness.float_proof import beside, prepared
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.provenance import compared
from spikeloom.runtime.studies.robustness.results import Provenance

KINDS = "; ".join(kind.what for kind in EXHAUSTIVE.values())

NOTES = f"""\
On each recording every change of these kinds is tried, none is sampled: {KINDS}.
For several changed events it reports how many are proven to alter nothing, and how many are shown to suffice.
--checkpoint also proves the float model's decision, in float32; certificates and their files are of the chip.
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
    loaded = _float_network(request, machine)
    data = load_recordings(request.data, request, machine.netlist, labels_for="certify", joined=False)
    model = None if loaded is None else prepared(loaded.network, machine.netlist, data)
    singles = int(data.step_counts.sum()) * data.taxels * data.events.shape[2]
    seconds = expected_seconds(machine, data, request.jobs)
    lasting = "" if seconds is None or seconds < TOLD_S else f", at most about {seconds / 60:,.0f} min"
    tell(
        f"trying {singles:,} single events of {number(len(data), 'recording')}{lasting}, then every other change"
    )
    certificates = certify(machine, data, shift=request.shift, most=request.most, jobs=request.jobs)
    provenance = Provenance.of(request, data.sha256)
    if loaded is not None and model is not None:
        certificates = beside(certificates, model, machine.netlist, data, jobs=request.jobs)
        provenance = compared(request, data.sha256, loaded)
    places = places_of(None, machine.netlist.provenance, data.taxels)
    result = replace(certificates, provenance=provenance, places=places)
    if request.certificate is not None:
        write_certificate(request.certificate, result, sha256_of(request.netlist))
    write_picture(request.picture, lambda: taxel_map(result))
    write_json(request.output, result)
    return Outcome(result, sections)


def _float_network(request: CertifyRequest, machine: Machine) -> LoadedNetwork | None:
    """What the netlist was made of, if it is given."""
    if request.checkpoint is None:
        refuse(request, [each.name for each in NetworkChoice.options()], "it says how --checkpoint is read")
        return None
    loaded = load_network(request.checkpoint, request, machine.netlist)
    if isinstance(machine, Comparable):
        require_match(machine.netlist, loaded.network)
    loaded.require_same(request.netlist, machine.netlist, request.run)
    return loaded
