"""The command ``export``: a netlist in the format of another program."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Iterator
from typing import Any

from compiler.atomic import write_atomically
from compiler.netlist import Netlist
from compiler.serialize import read_netlist
from compiler.targets import Target, load_target
from runtime import sanafe
from runtime.inputs import require_place

Json = dict[str, Any]

SUMMARY = "write a netlist in the format of another program"

FORMATS = {"sanafe": f"network and mapping for SANA-FE {sanafe.VERSION}, YAML"}
"""Values of ``--to``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("netlist", metavar="NET.loom")
    parser.add_argument(
        "--to", required=True, choices=tuple(FORMATS), help="; ".join(f"{key}: {what}" for key, what in FORMATS.items())
    )
    parser.add_argument("-o", "--output", required=True, metavar="FILE")


def _sanafe(netlist: Netlist, target: Target) -> tuple[Iterator[bytes], Json]:
    places = sanafe.cores(netlist, target)
    lines = (f"{line}\n".encode() for line in sanafe.export(netlist, target))
    facts = {
        "groups": [sanafe.INPUT, *sanafe.group_names(netlist)],
        "cores": list(places[: netlist.n_cores]),
        "input_cores": list(places[netlist.n_cores :]),
    }
    return lines, facts


WRITERS: dict[str, Callable[[Netlist, Target], tuple[Iterator[bytes], Json]]] = {"sanafe": _sanafe}
"""For each format what yields the file and what tells about it."""


def export(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command: the report, how to print it, and the exit code."""
    require_place(arguments.output, "-o", arguments)
    netlist = read_netlist(arguments.netlist)
    chunks, facts = WRITERS[arguments.to](netlist, load_target(netlist.target))
    digest, size = hashlib.sha256(), 0
    with write_atomically(arguments.output) as file:
        for chunk in chunks:
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    report = {
        "path": arguments.output,
        "format": arguments.to,
        "bytes": size,
        "sha256": digest.hexdigest(),
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
        **facts,
    }
    return report, _text, 0


def _text(report: Json) -> str:
    return (
        f"{report['path']}: {report['neurons']} neurons and {report['synapses']} synapses for {report['format']}, "
        f"{report['bytes']} bytes\n"
        f"groups: {', '.join(report['groups'])}\n"
        f"cores (tile.core): {', '.join(report['cores'])}; of the inputs: {', '.join(report['input_cores'])}"
    )
