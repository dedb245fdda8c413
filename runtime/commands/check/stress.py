"""The command ``stress``: where float network and chip break, and whether at the same place."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import write_atomically
from spikeloom.runtime.commands.options import add_netlist_and_model, add_recordings
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.jobs import add_sweep_arguments, sweep
from spikeloom.runtime.studies.stress.battery import NAMES, SEEDS
from spikeloom.runtime.studies.stress.sections import picture, sections
from spikeloom.runtime.studies.stress.study import Plan, Request, Task, measure_task, study
from spikeloom.runtime.studies.stress.verdicts import parse_requirement

NOTES = """\
Perturbations: {names}.
Accuracies are means over the seeds with a 95 % interval; a level leaves where the mean is below the interval of the
clean accuracy. --full and --jobs measure in processes of their own and go on where an earlier run ended.
"""
KIND, VERSION = "stress", 1
"""Of the store of measured points; the version goes up when a result means something else."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist_and_model(parser)
    add_recordings(parser)
    parser.add_argument("--only", metavar="NAME[,…]", help="some perturbations (default: all)")
    parser.add_argument("--full", action="store_true", help="dense curves")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"draws of each (default: {SEEDS})")
    parser.add_argument(
        "--require",
        action="append",
        default=[],
        metavar="NAME:LEVEL>=SHARE",
        help="accuracy that the chip must keep, as in taxels_dead:3>=0.85; else exit code 1; may be repeated",
    )
    add_sweep_arguments(parser)
    parser.add_argument("--picture", metavar="OUT.png", help="draw the curves")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write what --json prints; report --stress shows it")
    parser.epilog = NOTES.format(names=", ".join(NAMES))


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; exit code 1 where a requirement is missed."""
    plan, request = _plan(arguments), Request.of(arguments)
    apart = arguments.full or arguments.jobs is not None or arguments.scheduler
    with tempfile.TemporaryDirectory(prefix="spikeloom-") as folder:
        store = Path(folder) / "points" if arguments.output is None else Path(f"{arguments.output}.points")

        def measured(points: Sequence[Task]) -> Mapping[str, Any]:
            return sweep(
                points,
                measure_task,
                store,
                kind=KIND,
                version=VERSION,
                jobs=arguments.jobs,
                scheduler=arguments.scheduler,
                fresh=arguments.fresh,
                label="stress",
            )

        result = study(request, plan, measured if apart else None)
    if arguments.picture is not None:
        with write_atomically(arguments.picture) as file:
            file.write(picture(result))
    write_json(arguments.output, result)
    return Outcome(result, sections, 1 if result.missed else 0)


def _plan(arguments: argparse.Namespace) -> Plan:
    """Refuse options that cannot be meant; what is to be measured."""
    require_place(arguments.output, "-o", arguments)
    require_place(arguments.picture, "--picture", arguments)
    if arguments.seeds < 1:
        raise OptionError(f"--seeds {arguments.seeds}: allowed are 1 or more; choose another")
    chosen = list(NAMES) if arguments.only is None else [name.strip() for name in arguments.only.split(",")]
    for name in chosen:
        if name not in NAMES:
            raise OptionError(f"--only {name}: no such perturbation; choose from {', '.join(NAMES)}")
    requirements = tuple(map(parse_requirement, arguments.require))
    for wanted in requirements:
        if wanted.name not in chosen:
            raise OptionError(f"--require {wanted}: --only leaves {wanted.name} out; add it there")
    names = tuple(name for name in NAMES if name in chosen)
    return Plan(names=names, requirements=requirements, seeds=arguments.seeds, full=arguments.full)
