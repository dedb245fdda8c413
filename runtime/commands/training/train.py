"""The command ``train``: networks of one system, any number of seeds."""

from spikeloom.compiler.formats.counters import SYSTEM as COUNTING
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.training import TrainRequest
from spikeloom.runtime.studies.cluster import on_cluster
from spikeloom.runtime.studies.counting import counters_sections
from spikeloom.runtime.studies.training.results import training_sections
from spikeloom.runtime.studies.training.study import train_counting, train_networks

REQUEST = TrainRequest


@on_cluster
def run(request: TrainRequest) -> Outcome:
    """Run the command."""
    if request.system == COUNTING:
        return Outcome(train_counting(request), counters_sections)
    return Outcome(train_networks(request), training_sections)
