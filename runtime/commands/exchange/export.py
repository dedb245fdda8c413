"""The command ``export``: a netlist, or a checkpoint's float network, in the format of another program."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.onnx import writer_float
from spikeloom.compiler.formats.onnx.builder import port_words
from spikeloom.compiler.formats.onnx.writer import FORMS
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.commands.options import DATA_HELP, add_bin_option, add_model
from spikeloom.runtime.inputs.files import require_place
from spikeloom.runtime.inputs.network import load_checkpoint, load_graph, propagation
from spikeloom.runtime.inputs.recordings import recordings
from spikeloom.runtime.inputs.repeat import NETWORK, refuse
from spikeloom.runtime.machines.base import export_formats
from spikeloom.runtime.machines.export_format import Export, Format, Request, port_lines
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text

FLOAT = "onnx-float"

FORMATS = export_formats()
TITLES = {each.name: each.title for each in FORMATS} | {
    FLOAT: "the float network of a checkpoint as a static ONNX graph"
}
"""Values of ``--to``."""

OPTIONS = ("form", "data", "split", "bin", "recording", "limit", "dt", "strict")
"""Of single formats."""

OF_RECORDINGS = ("split", "bin", "recording", "limit")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("source", metavar="NET.loom|CKPT", help="a netlist; for onnx-float a checkpoint")
    parser.add_argument(
        "--to", required=True, choices=tuple(TITLES), help="; ".join(f"{key}: {what}" for key, what in TITLES.items())
    )
    parser.add_argument(
        "--form", choices=FORMS, help="onnx: one step with its state, or whole recordings (default: scan)"
    )
    parser.add_argument(
        "--data",
        metavar="PATH",
        help=f"ranc: a recording to add; netx: those on which spikes that move are counted; {DATA_HELP}",
    )
    parser.add_argument("--split", help="ranc, netx: split to read (default: test)")
    parser.add_argument("--recording", type=int, metavar="N", help="ranc: which of them (default: 0)")
    parser.add_argument("--limit", type=int, metavar="N", help="netx: first N of them only")
    add_bin_option(parser)
    add_model(parser)
    parser.add_argument("--dt", type=float, metavar="SECONDS", help=f"nir: length of a step (default: {BIN_S:g} a bin)")
    parser.add_argument("--strict", action="store_true", help="netx: write nothing that had to be rounded")
    parser.add_argument("-o", "--output", required=True, metavar="FILE")


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """A file that was written, and what its format says about it."""

    path: str
    format: str
    bytes: int
    sha256: str
    facts: Any = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class FloatFacts:
    """What an ONNX file of a checkpoint holds, and what it takes and gives, as words."""

    neurons: int
    graph: str | None
    form: str
    inputs: list[str]
    outputs: list[str]


def _float(arguments: argparse.Namespace) -> Export:
    checkpoint = load_checkpoint(arguments.source, arguments)
    name, adjacency = propagation(checkpoint, load_graph(arguments), arguments.source)
    form = arguments.form or "scan"
    content = writer_float.export_float(checkpoint, adjacency, form, graph_name=name)
    neurons = len(adjacency) * len(checkpoint.conv_bias) + sum(len(dense.bias) for dense in checkpoint.dense)
    inputs, outputs = port_words(content)
    facts = FloatFacts(neurons=neurons, graph=name, form=form, inputs=inputs, outputs=outputs)
    return Export(content=[content], facts=facts, synapses=None, form=form, lines=port_lines(inputs, outputs))


def _request(arguments: argparse.Namespace) -> Request:
    def read(classes: int, taxels: int, bins: int) -> Recordings:
        split, limit = arguments.split or "test", arguments.limit
        return recordings(
            arguments.data, split, limit=limit, classes=classes, taxels=taxels, bin_s=arguments.bin, bins=bins
        )

    return Request(
        source=arguments.source,
        output=arguments.output,
        recordings=None if arguments.data is None else read,
        recording=arguments.recording,
        form=arguments.form,
        dt=arguments.dt,
        strict=arguments.strict,
    )


def _require_fit(arguments: argparse.Namespace, chosen: Format | None) -> None:
    """Refuse options that the format would ignore."""
    users = {each.name: each.options for each in FORMATS} | {FLOAT: ("form",)}
    for name in OPTIONS:
        if name not in users[arguments.to]:
            formats = " and ".join(to for to, options in users.items() if name in options)
            refuse(arguments, (name,), f"is for {formats}, --to says {arguments.to}")
        elif name in OF_RECORDINGS and arguments.data is None:
            refuse(arguments, (name,), "says which recording of --data, which is not given")
    if chosen is not None:
        refuse(arguments, NETWORK, f"is for checkpoints, --to {arguments.to} takes a netlist")


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the file."""
    chosen = next((each for each in FORMATS if each.name == arguments.to), None)
    _require_fit(arguments, chosen)
    require_place(arguments.output, "-o", arguments)
    export = _float(arguments) if chosen is None else chosen.write(_request(arguments))
    digest, size = hashlib.sha256(), 0
    with write_atomically(arguments.output) as file:
        for chunk in export.content:
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    written = Written(
        path=arguments.output, format=arguments.to, bytes=size, sha256=digest.hexdigest(), facts=export.facts
    )

    def sections(result: Written) -> Iterator[Section]:
        synapses = "" if export.synapses is None else f" and {export.synapses} synapses"
        held = f"{result.facts.neurons} neurons{synapses} for {result.format}"
        form = "" if export.form is None else f", form {export.form}"
        lines = [f"{result.path}: {held}, {result.bytes} bytes{form}", *export.lines]
        yield Section("", [Text(line) for line in lines])

    return Outcome(written, sections)
