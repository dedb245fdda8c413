"""The command ``join``: several trained networks as one whose votes add up."""

from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.training import JoinRequest
from spikeloom.runtime.studies.training.joining import join, sections

REQUEST = JoinRequest


def run(request: JoinRequest) -> Outcome:
    """Run the command."""
    return Outcome(join(request), sections)
