"""``compile`` of a file that brings its integers, netx: nothing is rounded."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from spikeloom import __version__
from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.netx.layout import SUFFIX as NETX
from spikeloom.compiler.formats.netx.reader import read_netx
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.legalize import measure
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import write_netlist
from spikeloom.runtime.commands.options import MODEL, ROUNDING, parse_cores
from spikeloom.runtime.report import render
from spikeloom.runtime.report.console import progress

Json = dict[str, Any]
Outcome = tuple[Json, Callable[[Json], str], int]

FLOATS: Json = {"dt": None, "convention": None, **ROUNDING, "calibrate": None}
"""Options that say how a float network is read and rounded, and what they are where they are not given."""


def is_whole(arguments: argparse.Namespace) -> bool:
    """Whether what is to be compiled brings its integers."""
    return isinstance(arguments.checkpoint, str) and arguments.checkpoint.endswith(NETX)


def take(arguments: argparse.Namespace) -> Outcome:
    """Run the command for such a file: the report, how to print it, and the exit code."""
    netlist, facts = _from_netx(arguments)
    sha256 = write_netlist(netlist, arguments.output)
    report = render.netlist_json(netlist, measure(netlist, load_target(netlist.target)), sha256)
    return report | {"path": arguments.output, "facts": facts}, _text, 0


def _refuse(arguments: argparse.Namespace, options: Json, why: str) -> None:
    for name, absent in options.items():
        if getattr(arguments, name) != absent:
            shown = "polarities-first or -last" if name == "polarities_first" else name.replace("_", "-")
            raise OptionError(f"--{shown}: {why}")


def _from_netx(arguments: argparse.Namespace) -> tuple[Netlist, list[str]]:
    path = arguments.checkpoint
    _refuse(arguments, FLOATS, f"is for float networks, {path} holds integers; leave it away")
    _refuse(arguments, MODEL, f"is for checkpoints, the netx file {path} holds all it needs; leave it away")
    why = f"weighs layouts by what a float network does on recordings, {path} holds integers; leave it away"
    _refuse(arguments, {"optimize": "cores"}, f"{why}, or give --cores-for")
    progress("reading the network")
    found = read_netx(path, polarities=arguments.polarities, polarities_first=arguments.polarities_first)
    verify(found.network)
    progress("compiling")
    cores_for = parse_cores(arguments.cores_for)
    options = Options(
        keep_all=arguments.keep_all,
        cores_for=cores_for,
        chips=arguments.chips,
        optimize=arguments.optimize,
        provenance={
            "spikeloom": __version__,
            "checkpoint_sha256": found.sha256,
            "format": "netx",
            "keep_all": arguments.keep_all,
            **({"cores_for": cores_for} if cores_for else {}),
            **({"chips": arguments.chips} if arguments.chips != 1 else {}),
        },
    )
    return compile_network(found.network, options, target=arguments.target).netlist, list(found.facts)


def _text(report: Json) -> str:
    return "\n".join([*report["facts"], "", render.netlist_text(report), f"sha256 {report['sha256']}"])
