"""The command ``finetune``: train a network further on the integers of the chip."""

from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.training import FinetuneRequest
from spikeloom.runtime.studies.training.finetuning import finetune, sections

REQUEST = FinetuneRequest


def run(request: FinetuneRequest) -> Outcome:
    """Run the command; the text of a KeyboardInterrupt says what is kept."""
    return Outcome(finetune(request), sections)
