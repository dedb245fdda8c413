"""The command ``export``: a netlist, or a checkpoint's float network, in the format of another program."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Iterable
from typing import Any

from compiler.atomic import write_atomically
from compiler.errors import OptionError
from compiler.serialize import read_netlist
from compiler.targets import load_target
from models.events import BIN_S
from runtime import onnx_float, onnx_graph, sanafe
from runtime.data_commands import add_bin_option
from runtime.inputs import asked_checkpoint, asked_graph, propagation, require_place
from runtime.onnx_nodes import port_words
from runtime.options import DATA_HELP, add_model
from runtime.truenorth.commands import export_ranc

Json = dict[str, Any]

SUMMARY = "write a network in the format of another program"

FORMATS = {
    "sanafe": f"network and mapping of a netlist for SANA-FE {sanafe.VERSION}, YAML",
    "ranc": "TrueNorth cores, and a recording, for RANC's simulator, JSON",
    "onnx": "a netlist as an integer ONNX graph, bit for bit the chip",
    "onnx-float": "the float network of a checkpoint as a static ONNX graph",
}
"""Values of ``--to``."""

RECORDING: dict[str, object] = {"data": None, "split": None, "recording": None, "bin": BIN_S}
"""Options that name a recording, and what they are where they are not given."""

MODEL = {
    "graph": None,
    "taxels": None,
    "edges": None,
    "directed": False,
    "run": 0,
    "weights": None,
    "beta": None,
    "theta": None,
}
"""Options of checkpoints, and what they are where they are not given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("source", metavar="NET.loom|CKPT", help="a netlist; for onnx-float a checkpoint")
    parser.add_argument(
        "--to", required=True, choices=tuple(FORMATS), help="; ".join(f"{key}: {what}" for key, what in FORMATS.items())
    )
    parser.add_argument(
        "--form", choices=onnx_graph.FORMS, help="onnx: one step with its state, or whole recordings (default: scan)"
    )
    parser.add_argument("--data", metavar="PATH", help=f"ranc: {DATA_HELP}")
    parser.add_argument("--split", help="ranc: split to read (default: test)")
    parser.add_argument("--recording", type=int, metavar="N", help="ranc: which of them (default: 0)")
    add_bin_option(parser)
    add_model(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FILE")


def _sanafe(arguments: argparse.Namespace) -> tuple[Iterable[bytes], Json]:
    netlist = read_netlist(arguments.source)
    target = load_target(netlist.target)
    places = sanafe.cores(netlist, target)
    lines = (f"{line}\n".encode() for line in sanafe.export(netlist, target))
    facts = {
        "neurons": netlist.n_compartments,
        "synapses": netlist.n_synapses,
        "groups": [sanafe.INPUT, *sanafe.group_names(netlist)],
        "cores": list(places[: netlist.n_cores]),
        "input_cores": list(places[netlist.n_cores :]),
    }
    return lines, facts


def _onnx(arguments: argparse.Namespace) -> tuple[Iterable[bytes], Json]:
    netlist = read_netlist(arguments.source)
    content = onnx_graph.export(netlist, arguments.form or "scan")
    facts = {"neurons": netlist.n_compartments, "synapses": netlist.n_synapses}
    return [content], facts | _ports(arguments, content)


def _onnx_float(arguments: argparse.Namespace) -> tuple[Iterable[bytes], Json]:
    checkpoint = asked_checkpoint(arguments.source, arguments)
    name, adjacency = propagation(checkpoint, asked_graph(arguments), arguments.source)
    content = onnx_float.export_float(checkpoint, adjacency, arguments.form or "scan", graph_name=name)
    neurons = len(adjacency) * len(checkpoint.conv_bias) + sum(len(dense.bias) for dense in checkpoint.dense)
    return [content], {"neurons": neurons, "graph": name} | _ports(arguments, content)


def _ports(arguments: argparse.Namespace, content: bytes) -> Json:
    inputs, outputs = port_words(content)
    return {"form": arguments.form or "scan", "inputs": inputs, "outputs": outputs}


WRITERS: dict[str, Callable[[argparse.Namespace], tuple[Iterable[bytes], Json]]] = {
    "sanafe": _sanafe,
    "ranc": export_ranc,
    "onnx": _onnx,
    "onnx-float": _onnx_float,
}
"""For each format what yields the file and what tells about it."""


def _require_fit(arguments: argparse.Namespace) -> None:
    """Refuse options that the format would ignore."""
    for name, absent in RECORDING.items():
        given = getattr(arguments, name)
        if given != absent and arguments.to != "ranc":
            raise OptionError(f"--{name} {given}: is for ranc; leave it away")
        if given != absent and arguments.data is None:
            raise OptionError(f"--{name} {given}: says which recording of --data, which is not given; add it")
    if arguments.form is not None and arguments.to in ("sanafe", "ranc"):
        raise OptionError(f"--form {arguments.form}: is for onnx and onnx-float; leave it away")
    if arguments.to == "onnx-float":
        return
    for name, absent in MODEL.items():
        given = getattr(arguments, name)
        if given != absent:
            shown = f"--{name}" if given is True else f"--{name} {given}"
            raise OptionError(f"{shown}: is for checkpoints, --to {arguments.to} takes a netlist; leave it away")


def export(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command: the report, how to print it, and the exit code."""
    _require_fit(arguments)
    require_place(arguments.output, "-o", arguments)
    chunks, facts = WRITERS[arguments.to](arguments)
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
        **facts,
    }
    return report, _text, 0


def _text(report: Json) -> str:
    held = f"{report['neurons']} neurons"
    if "synapses" in report:
        held += f" and {report['synapses']} synapses"
    first = f"{report['path']}: {held} for {report['format']}, {report['bytes']} bytes"
    if "ticks" in report:
        inputs = report["path"], report["path"].removesuffix(".json") + ".out"
        with_events = "no recording, add packets" if report["ticks"] is None else f"{report['ticks']} ticks"
        return f"{first}\nrun: ranc_sim {inputs[0]} {inputs[1]} {inputs[0]} TICKS ({with_events})"
    if "groups" in report:
        return (
            f"{first}\ngroups: {', '.join(report['groups'])}\n"
            f"cores (tile.core): {', '.join(report['cores'])}; of the inputs: {', '.join(report['input_cores'])}"
        )
    sides = [f"{side}:\n" + "\n".join(f"  {port}" for port in report[side]) for side in ("inputs", "outputs")]
    return "\n".join([f"{first}, form {report['form']}", *sides])
