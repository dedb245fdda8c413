"""The command ``inspect``: what is in a netlist or a checkpoint."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist_file import is_netlist, read_netlist
from spikeloom.compiler.targets.truenorth.netlist_file import is_crossbars
from spikeloom.runtime.commands.options import add_model
from spikeloom.runtime.inputs.files import require_inspectable
from spikeloom.runtime.inputs.network import load_checkpoint
from spikeloom.runtime.machines.truenorth import commands as truenorth
from spikeloom.runtime.machines.truenorth import native
from spikeloom.runtime.report import render


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("path", help="netlist or checkpoint")
    add_model(parser, graph=False)


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], Callable[[dict[str, Any]], str], int]:
    """Run the command."""
    require_inspectable(arguments.path)
    if native.is_named(arguments.path):
        return native.inspect(arguments)
    if is_netlist(arguments.path):
        for name in ("beta", "theta", "weights", "run", "system"):
            value = getattr(arguments, name)
            if value is not None and (name, value) != ("run", 0):
                raise OptionError(f"--{name} {value}: is for checkpoints, {arguments.path} is a netlist; omit it")
        if is_crossbars(arguments.path):
            return truenorth.inspect(arguments.path)
        netlist = read_netlist(arguments.path)
        uses = measure(netlist, load_target(netlist.target))
        sha256 = hashlib.sha256(Path(arguments.path).read_bytes()).hexdigest()
        return render.netlist_json(netlist, uses, sha256), render.netlist_text, 0
    given = tuple(name for name in ("beta", "theta") if getattr(arguments, name) is not None)
    return render.checkpoint_json(load_checkpoint(arguments.path, arguments), given), render.checkpoint_text, 0
