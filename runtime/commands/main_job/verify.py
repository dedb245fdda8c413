"""The command ``verify``: the netlist held against its checkpoint; on recordings their spikes, too."""

from collections.abc import Mapping
from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.equivalence.verdict import parse_requirements, sections
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.backends import backend_of, machine_for
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.netlist_check import sections as check_sections
from spikeloom.runtime.report.console import Progress, tell
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.main_job import MIN_AGREEMENT, VerifyRequest

NOTES = """\
Without --data nothing is simulated: only the level EN is asked, whether the netlist is its checkpoint, rounded. EN is
always required.
"""

WITH_DATA = (
    "original",
    "engine",
    "min_agreement",
    "require",
    "spec_samples",
    "bin",
    "split",
    "limit",
    "window",
)
"""Options that only say something about recordings."""


REQUEST = VerifyRequest


def run(request: VerifyRequest) -> Outcome:
    """Run the command."""
    if request.data is None:
        refuse(request, WITH_DATA, "is about recordings, give --data too")
    required = _required(request)
    machine = machine_for(request.netlist)
    netlist = machine.netlist
    reference = backend_of(netlist.target).reference(request, netlist)
    if reference.whole:
        refuse(
            request, ("original", "min_agreement"), "the network is whole numbers, there is no float model"
        )
    if isinstance(machine, Comparable):
        require_match(machine.netlist, reference.network)
    if reference.difference is not None:
        tell(f"warning: {request.netlist}: {reference.difference}")
    check = machine.check_lowering(reference.network)
    if request.data is None or not check.simulates:
        return Outcome(check, check_sections, 0 if check.holds else 1)
    original = None if request.original is None else load_network(request.original, request).network
    data = load_recordings(request.data, request, netlist, labels_for="verify")
    count = Progress(len(data))
    verdict = verify(
        netlist,
        reference.network,
        data,
        original=reference.floats if original is None else original,
        spec_samples=request.spec_samples,
        engine_name=request.engine,
        required=required
        or ({"E0": 1.0, "E1": 1.0} if reference.whole else {"E0": 1.0, "E3": MIN_AGREEMENT}),
        check=check,
        progress=lambda part, done: count(done, part),
    )
    verdict = replace(verdict, same_checkpoint=reference.difference is None)
    return Outcome(verdict, sections, 1 if verdict.missed else 0)


def _required(request: VerifyRequest) -> Mapping[str, float] | None:
    """Levels and shares that the options require; None where they say nothing."""
    agreement = request.min_agreement
    if agreement is not None and not 0 <= agreement <= 1:
        raise OptionError(f"--min-agreement {agreement}: not a share; give a number from 0 to 1")
    if request.require is None:
        return None if agreement is None else {"E0": 1.0, "E3": agreement}
    if agreement is not None:
        instead = f"write E3={agreement:g} into that instead"
        raise OptionError(f"--min-agreement {agreement:g}: --require replaces it; {instead}")
    return parse_requirements(request.require)
