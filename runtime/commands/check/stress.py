"""The command ``stress``: where float network and chip break, and whether at the same place."""

from spikeloom.compiler.errors import OptionError, require_least
from spikeloom.runtime.inputs.files import require_place, write_picture
from spikeloom.runtime.report.drawing import PICTURES
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.check import StressRequest
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.robustness.curves import parse_requirement
from spikeloom.runtime.studies.robustness.perturbations import SAMPLED
from spikeloom.runtime.studies.robustness.sampled import stress
from spikeloom.runtime.studies.robustness.stress_sections import picture, sections

NOTES = f"""\
Perturbations: {", ".join(SAMPLED)}.
Accuracies are means over the seeds with a 95 % interval. A side leaves at the first level whose mean is below the
interval of the clean accuracy.
"""


REQUEST = StressRequest


@on_cluster
def run(request: StressRequest) -> Outcome:
    """Run the command; exit code 1 where a requirement is missed."""
    require_place(request.output, "-o", request)
    require_place(request.picture, "--picture", request, PICTURES)
    require_least(vars(request), seeds=1, jobs=1)
    chosen = list(SAMPLED) if request.only is None else [name.strip() for name in request.only.split(",")]
    for name in chosen:
        if name not in SAMPLED:
            raise OptionError(f"--only {name}: no such perturbation; choose from {', '.join(SAMPLED)}")
    requirements = list(map(parse_requirement, request.require))
    for wanted in requirements:
        if wanted.name not in chosen:
            raise OptionError(f"--require {wanted}: --only leaves {wanted.name} out; add it there")
    result = stress(request, [name for name in SAMPLED if name in chosen], requirements)
    write_picture(request.picture, lambda: picture(result))
    write_json(request.output, result)
    return Outcome(result, sections, 1 if result.missed else 0)
