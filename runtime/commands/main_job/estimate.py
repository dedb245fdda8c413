"""The command ``estimate``: synaptic operations, energy and time of an inference."""

import argparse
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.models.recordings.evtouch import Recordings, first_part, parse_window
from spikeloom.models.training.counters import BITS
from spikeloom.runtime.commands.options import add_netlist, add_prices, add_recordings
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine, Price, Run
from spikeloom.runtime.report.console import Progress
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies import processor
from spikeloom.runtime.studies.processor import Comparison

AGAINST = "train a linear rule for a small processor on the same recordings, and hold its costs beside these"


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Costs on the chip, and beside them those of a rule on a processor."""

    costs: Any = field(metadata=INLINE)
    against_processor: Comparison


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist(parser)
    add_recordings(parser, window=True)
    add_prices(parser)
    parser.add_argument("--against-processor", action="store_true", help=AGAINST)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    machine = machine_for(arguments.netlist)
    data = load_recordings(arguments, machine.netlist)
    ran, price = machine.price(
        data.events,
        bin_s=arguments.bin,
        lengths=data.lengths,
        detail=arguments.detail,
        table=arguments.table,
        progress=Progress(len(data)),
    )
    costs = price.outcome
    if not arguments.against_processor:
        return costs
    compared = _against_processor(arguments, machine, ran, price)
    shown = [*costs.sections(costs.result), *processor.sections(compared)]
    return Outcome(Compared(costs=costs.result, against_processor=compared), lambda _: shown)


def _against_processor(arguments: argparse.Namespace, machine: Machine, ran: Run, price: Price) -> Comparison:
    """The same recordings in their own bins, and those of the training split, for a rule on a processor."""
    if isinstance(arguments.data, Recordings):
        raise OptionError("against_processor: needs the training split beside these; give the place of the recordings")
    window = parse_window(arguments.window)
    training, test = (
        first_part(load_recordings(each, machine.netlist, labels_for="--against-processor", joined=False), window)
        for each in (argparse.Namespace(**vars(arguments) | {"split": "train", "limit": None}), arguments)
    )
    right = ran.decisions == test.labels
    bits = min(machine.weight_bits, BITS[-1])
    return processor.against_processor(training, test, bits, arguments.bin, price, right)
