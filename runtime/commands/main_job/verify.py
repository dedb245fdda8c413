"""The command ``verify``: the netlist held against its checkpoint; on recordings their spikes, too."""

import argparse
from dataclasses import replace

from spikeloom.compiler.errors import OptionError
from spikeloom.runtime.commands.options import MIN_AGREEMENT, add_check, add_netlist_and_model, add_recordings
from spikeloom.runtime.equivalence.reference import require_match
from spikeloom.runtime.equivalence.rounding import check_rounding
from spikeloom.runtime.equivalence.rounding import sections as rounding_sections
from spikeloom.runtime.equivalence.verdict import parse_requirements, sections
from spikeloom.runtime.equivalence.verify import verify
from spikeloom.runtime.inputs.network import load_network
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.backends import backend_of, machine_for
from spikeloom.runtime.machines.base import ENGINES
from spikeloom.runtime.machines.integer import integer_machine
from spikeloom.runtime.machines.simulated import Account
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.sections import Outcome

NOTES = """\
Without --data nothing is simulated: only the level EN is asked, whether the netlist is its checkpoint, rounded. EN is
always required.
"""

WITH_DATA = ("original", "min_agreement", "require", "limit")
"""Options that only say something about recordings."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_netlist_and_model(parser)
    add_recordings(parser, window=True, required=False)
    what = "float model for E2 and E3 (default: the weights of --checkpoint)"
    parser.add_argument("--original", metavar="CKPT", help=what)
    what = f"onnx: onnxruntime runs the integer graph beside our engine (default: {ENGINES[0]})"
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0], help=what)
    what = f"share of equal decisions to pass (default: {MIN_AGREEMENT:g})"
    parser.add_argument("--min-agreement", type=float, metavar="X", help=what)
    what = "levels to pass instead: E0 specification = engine, E2 share of spikes in every layer, E3 of decisions"
    parser.add_argument("--require", metavar="E0,E2=X,E3=X", help=what)
    add_check(parser)
    parser.epilog = NOTES


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    if arguments.data is None:
        refuse(arguments, WITH_DATA, "is about recordings, give --data too")
    machine = machine_for(arguments.netlist)
    own = backend_of(machine.netlist.target).verify(arguments)
    if own is not None:
        return own
    agreement = MIN_AGREEMENT if arguments.min_agreement is None else arguments.min_agreement
    if not 0 <= agreement <= 1:
        raise OptionError(f"--min-agreement {agreement}: not a share; give a number from 0 to 1")
    required = {"E0": 1.0, "E3": agreement}
    if arguments.require is not None:
        if arguments.min_agreement is not None:
            raise OptionError(
                f"--min-agreement {agreement:g}: --require replaces it; write E3={agreement:g} into that instead"
            )
        required = parse_requirements(arguments.require)
    netlist, loaded = machine.netlist, load_network(arguments.checkpoint, arguments, machine.netlist)
    require_match(netlist, loaded.model)
    if (difference := loaded.differs_from(netlist, arguments.run)) is not None:
        tell(f"warning: {arguments.netlist}: {difference}")
    held = check_rounding(integer_machine(machine), loaded.network, fine_tuned=loaded.network.forms is not None)
    if arguments.data is None or not held.layers:
        return Outcome(held, rounding_sections, 0 if held.holds else 1)
    original = None if arguments.original is None else load_network(arguments.original, arguments)
    data = load_recordings(arguments, netlist, labels_for="verify")
    account = Account(machine, data, checked=arguments.spec_samples)
    verdict = verify(
        netlist,
        loaded.model,
        data,
        original=None if original is None else original.model,
        spec_samples=arguments.spec_samples,
        engine_name=arguments.engine,
        required=required,
        rounding=held,
        progress=account.begin,
    )
    explained = account.explained(arguments.explain_cost)
    verdict = replace(verdict, same_checkpoint=difference is None, explained_cost=explained)
    return Outcome(verdict, sections, 1 if verdict.missed else 0)
