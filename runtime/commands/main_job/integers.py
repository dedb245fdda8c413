"""``compile`` of a file that brings its integers (netx): nothing is rounded, they are laid out as they stand."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from spikeloom.compiler import Options, __version__, compile_network, write_netlist
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.netx.reader import SUFFIX, read_netx
from spikeloom.compiler.invariants import verify
from spikeloom.compiler.targets.base import load_target
from spikeloom.runtime.inputs.compilation import parse_cores
from spikeloom.runtime.inputs.repeat import NETWORK, ROUNDING, refuse
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import INLINE
from spikeloom.runtime.report.sections import Outcome, Section, Text


@dataclass(frozen=True, slots=True, kw_only=True)
class LaidOut:
    """A netlist of integers as they stood, and what was read from their file."""

    netlist: Any = field(metadata=INLINE)
    path: str
    facts: Sequence[str]


def brings_integers(source: object) -> bool:
    """Whether what is to be compiled is rounded already."""
    return isinstance(source, str) and source.endswith(SUFFIX)


def compile_integers(arguments: argparse.Namespace) -> Outcome:
    """Run the command for such a file."""
    path = arguments.checkpoint
    if load_target(arguments.target).options is not Options:
        raise OptionError(f"--target {arguments.target}: {path} holds integers of another chip; omit it")
    floats = ("in_time", "dt", "convention", *ROUNDING, "dump_after", "calibrate", "optimize")
    refuse(arguments, floats, f"is for float networks, {path} holds integers")
    refuse(arguments, NETWORK, f"is for checkpoints, the netx file {path} holds all it needs")
    progress("reading the network")
    read = read_netx(path, polarities=arguments.polarities, polarities_first=arguments.polarities_first)
    verify(read.network)
    progress("compiling")
    cores_for = parse_cores(arguments.cores_for)
    provenance = {
        "spikeloom": __version__,
        "checkpoint_sha256": read.sha256,
        "format": "netx",
        "keep_all": arguments.keep_all,
        **({"cores_for": cores_for} if cores_for else {}),
        **({"chips": arguments.chips} if arguments.chips != 1 else {}),
    }
    options = Options(keep_all=arguments.keep_all, cores_for=cores_for, chips=arguments.chips, provenance=provenance)
    done = compile_network(read.network, options, target=arguments.target)
    sha256 = write_netlist(done.netlist, arguments.output)
    described = machine_of(done.netlist).describe(sha256)

    def sections(made: LaidOut) -> Iterator[Section]:
        yield Section("", [*map(Text, made.facts)])
        *first, last = described.sections(made.netlist)
        yield from first
        yield Section("", [*last.blocks, Text(f"sha256 {sha256}")])

    return Outcome(LaidOut(netlist=described.result, path=arguments.output, facts=read.facts), sections)
