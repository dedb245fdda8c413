"""The command ``stress``: where float network and chip break, and whether at the same place."""

import argparse

from spikeloom.compiler.errors import OptionError, require_least
from spikeloom.runtime.commands.options import add_netlist_and_model, add_picture, add_recordings
from spikeloom.runtime.inputs.files import require_picture, require_place, write_picture
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.stress.bench import NAMES
from spikeloom.runtime.studies.stress.sections import picture, sections
from spikeloom.runtime.studies.stress.study import study
from spikeloom.runtime.studies.stress.verdicts import parse_requirement

NOTES = """\
Perturbations: {names}.
Accuracies are means over the seeds with a 95 % interval; a level leaves where the mean is below the interval of the
clean accuracy.
"""

SEEDS = 5
"""Draws of each random perturbation."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist_and_model(parser)
    add_recordings(parser)
    parser.add_argument("--only", metavar="NAME[,…]", help="some perturbations (default: all)")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"draws of each (default: {SEEDS})")
    what = "accuracy that the chip must keep, as in taxels_dead:3>=0.85; else exit code 1; may be repeated"
    parser.add_argument("--require", action="append", default=[], metavar="NAME:LEVEL>=SHARE", help=what)
    parser.add_argument("--jobs", type=int, metavar="N", help="measurements at a time (default: one a core)")
    add_picture(parser, "the curves")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write what --json prints; report --stress shows it")
    parser.epilog = NOTES.format(names=", ".join(NAMES))


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 where a requirement is missed."""
    require_place(arguments.output, "-o", arguments)
    require_picture(arguments, [arguments.output])
    require_least(vars(arguments), seeds=1, jobs=1)
    chosen = list(NAMES) if arguments.only is None else [name.strip() for name in arguments.only.split(",")]
    for name in chosen:
        if name not in NAMES:
            raise OptionError(f"--only {name}: no such perturbation; choose from {', '.join(NAMES)}")
    requirements = list(map(parse_requirement, arguments.require))
    for wanted in requirements:
        if wanted.name not in chosen:
            raise OptionError(f"--require {wanted}: --only leaves {wanted.name} out; add it there")
    result = study(arguments, [name for name in NAMES if name in chosen], requirements)
    write_picture(arguments.picture, lambda: picture(result))
    write_json(arguments.output, result)
    return Outcome(result, sections, 1 if result.missed else 0)
