"""The command ``estimate``: synaptic operations, energy and time of an inference."""

import argparse

from spikeloom.compiler.errors import OptionError
from spikeloom.models.recordings.evtouch import Recordings, first_part, parse_window
from spikeloom.models.training.counters import BITS
from spikeloom.runtime.commands.options import add_detail, add_netlist, add_recordings
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine, Price, Run
from spikeloom.runtime.machines.simulated import Account, Accounted
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies import processor
from spikeloom.runtime.studies.processor import Comparison

AGAINST = "train a linear rule for a small processor on the same recordings, and hold its costs beside these"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist(parser)
    add_recordings(parser, window=True)
    add_detail(parser, ("counts", "cycle"), "counts")
    parser.add_argument("--against-processor", action="store_true", help=AGAINST)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    machine = machine_for(arguments.netlist)
    data = load_recordings(arguments, machine.netlist)
    account = Account(machine, data)
    ran, price = priced(arguments, machine, data, account)
    account.begin("no float")
    explained, shown, compared = account.explained(arguments.explain_cost), price.outcome, None
    if arguments.against_processor:
        compared = _against_processor(arguments, machine, ran, price)
    result = Accounted(result=shown.result, against_processor=compared, explained_cost=explained)
    others = [] if compared is None else processor.sections(compared)
    return Outcome(result, lambda result: [*shown.sections(result.result), *others])


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


def priced(arguments: argparse.Namespace, machine: Machine, data: Recordings, account: Account) -> tuple[Run, Price]:
    """Run the recordings and price them as the options say."""
    account.begin(arguments.detail)
    return machine.price(
        data.events,
        bin_s=arguments.bin,
        lengths=data.lengths,
        detail=arguments.detail,
        table=arguments.table,
        progress=lambda done: account.begin(arguments.detail, done),
    )
