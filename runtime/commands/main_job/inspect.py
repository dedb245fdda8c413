"""The command ``inspect``: what is in a netlist or a checkpoint."""

from __future__ import annotations

import argparse

from spikeloom.compiler.archive import is_netlist
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.files import sha256_of
from spikeloom.runtime.commands.main_job.checkpoint_facts import facts_of, sections
from spikeloom.runtime.commands.options import add_model
from spikeloom.runtime.inputs.files import require_inspectable
from spikeloom.runtime.inputs.network import load_checkpoint
from spikeloom.runtime.machines.base import machine_for, trained_for
from spikeloom.runtime.report.sections import Outcome


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("path", help="netlist or checkpoint")
    add_model(parser, graph=False)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_inspectable(arguments.path)
    if (own := trained_for(arguments.path)) is not None:
        return own.inspect(arguments)  # type: ignore[no-any-return]
    if is_netlist(arguments.path):
        for name in ("beta", "theta", "weights", "run", "system"):
            value = getattr(arguments, name)
            if value is not None and (name, value) != ("run", 0):
                raise OptionError(f"--{name} {value}: is for checkpoints, {arguments.path} is a netlist; omit it")
        machine = machine_for(arguments.path)
        return machine.describe(sha256_of(arguments.path))
    given = tuple(name for name in ("beta", "theta") if getattr(arguments, name) is not None)
    return Outcome(facts_of(load_checkpoint(arguments.path, arguments), given), sections)
