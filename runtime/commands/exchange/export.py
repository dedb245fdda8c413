"""The command ``export``: a netlist in the format of another program."""

import argparse
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.onnx.writer import FORMS
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.models.recordings.evtouch import BIN_S, Recordings
from spikeloom.runtime.commands.options import DATA_HELP, add_bin_option
from spikeloom.runtime.inputs.files import require_netlist, require_place
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.inputs.repeat import refuse
from spikeloom.runtime.machines.backends import export_formats
from spikeloom.runtime.machines.base import Request
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text

FORMATS = {each.name: each for each in export_formats()}
"""By the value of ``--to``."""

OF_RECORDINGS = ("split", "bin", "recording")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("source", metavar="NET.loom", help="a netlist")
    what = "; ".join(f"{name}: {each.title}" for name, each in FORMATS.items())
    parser.add_argument("--to", required=True, choices=tuple(FORMATS), help=what)
    parser.add_argument("--form", choices=FORMS, help="onnx: a step and its state, or whole recordings (default: scan)")
    what = f"ranc: a recording to add; {DATA_HELP}"
    parser.add_argument("--data", metavar="PATH", help=what)
    parser.add_argument("--split", help="ranc: split to read (default: test)")
    parser.add_argument("--recording", type=int, metavar="N", help="ranc: which of them (default: 0)")
    add_bin_option(parser)
    parser.add_argument("--dt", type=float, metavar="SECONDS", help=f"nir: length of a step (default: {BIN_S:g} a bin)")
    parser.add_argument("-o", "--output", required=True, metavar="FILE")


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """A file that was written, and what its format says about it."""

    path: str
    format: str
    bytes: int
    sha256: str
    facts: Any = field(metadata=INLINE)


def _require_fit(arguments: argparse.Namespace) -> None:
    """Refuse options that the format would ignore."""
    for name in {option: None for each in FORMATS.values() for option in each.options}:
        if name not in FORMATS[arguments.to].options:
            formats = " and ".join(to for to, each in FORMATS.items() if name in each.options)
            refuse(arguments, (name,), f"is for {formats}, --to says {arguments.to}")
        elif name in OF_RECORDINGS and arguments.data is None:
            refuse(arguments, (name,), "says which recording of --data, which is not given")


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the file."""
    _require_fit(arguments)
    require_place(arguments.output, "-o", arguments, [FORMATS[arguments.to].ending or arguments.to])
    require_netlist(arguments.source)

    def read(netlist: Netlist) -> Recordings:
        split = arguments.split or "test"
        return load_recordings(argparse.Namespace(**vars(arguments) | {"split": split, "limit": None}), netlist)

    request = Request(
        source=arguments.source,
        output=arguments.output,
        recordings=None if arguments.data is None else read,
        recording=arguments.recording,
        form=arguments.form,
        dt=arguments.dt,
    )
    export = FORMATS[arguments.to].write(request)
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
        where = "" if FORMATS[result.format].whole else " on the chip"
        held = f"{result.facts.neurons} neurons{where} and {result.facts.synapses} synapses for {result.format}"
        form = "" if export.form is None else f", form {export.form}"
        lines = [f"{result.path}: {held}, {result.bytes} bytes{form}", *export.lines]
        yield Section("", [Text(line) for line in lines])

    return Outcome(written, sections)
