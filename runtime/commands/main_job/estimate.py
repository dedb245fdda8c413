"""The command ``estimate``: synaptic operations, energy and time of an inference."""

from dataclasses import dataclass, field, replace
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import BITS
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine, Price, Run
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.encode import HIDDEN, INLINE, OPTIONAL
from spikeloom.runtime.report.sections import Outcome, Section
from spikeloom.runtime.requests.main_job import EstimateRequest
from spikeloom.runtime.studies import neurobench, processor
from spikeloom.runtime.studies.neurobench import NeuroBench
from spikeloom.runtime.studies.processor import Comparison

REQUEST = EstimateRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Costs on the chip, and beside them those of a rule on a processor, and the metrics of others."""

    costs: Any = field(metadata=INLINE)
    against_processor: Comparison | None = field(default=None, metadata=OPTIONAL)
    neurobench: NeuroBench | None = field(default=None, metadata=OPTIONAL)
    price: Price = field(metadata=HIDDEN)


def run(request: EstimateRequest) -> Outcome:
    """Run the command."""
    machine, ran, priced = price(request)
    if not (request.against_processor or request.neurobench):
        return priced.outcome
    compared = Compared(
        costs=priced.details,
        against_processor=_against_processor(request, machine, ran, priced)
        if request.against_processor
        else None,
        neurobench=_neurobench(request, machine) if request.neurobench else None,
        price=priced,
    )
    return Outcome(compared, sections)


def price(request: EstimateRequest) -> tuple[Machine, Run, Price]:
    """Run the recordings of a request on their chip, and price them."""
    machine = machine_for(request.netlist)
    data = load_recordings(request.data, request, machine.netlist)
    ran, priced = machine.price(
        data.held,
        bin_s=data.seconds,
        lengths=data.lengths,
        detail=request.detail,
        table=request.table,
        progress=Progress(len(data)),
    )
    return machine, ran, priced


def sections(found: Compared) -> list[Section]:
    """Both for people."""
    compared = [] if found.against_processor is None else processor.sections(found.against_processor)
    metrics = [] if found.neurobench is None else neurobench.sections(found.neurobench)
    return [*found.price.sections(), *compared, *metrics]


def _neurobench(request: EstimateRequest, machine: Machine) -> NeuroBench:
    """Metrics of the same recordings."""
    network = Comparable.required(machine, request.netlist, "--neurobench")
    return neurobench.measure(network, load_recordings(request.data, request, machine.netlist))


def _against_processor(request: EstimateRequest, machine: Machine, ran: Run, priced: Price) -> Comparison:
    """The same recordings in their own bins, and those of the training split, for a rule on a processor."""
    if isinstance(request.data, Recordings):
        raise OptionError(
            "against_processor: needs the training split beside these; give the place of the recordings"
        )
    training, test = (
        load_recordings(request.data, each, machine.netlist, labels_for="--against-processor", joined=False)
        for each in (replace(request, split="train", limit=None), request)
    )
    right = ran.decisions == test.labels
    bits = min(machine.weight_bits, BITS[-1])
    return processor.against_processor(training, test, bits, test.seconds, priced, right)
