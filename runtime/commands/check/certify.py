"""The command ``certify``: which decisions no small change of a recording alters, and what alters the others."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from spikeloom.compiler import __version__
from spikeloom.compiler.archive import arrays_digest
from spikeloom.compiler.errors import require_least
from spikeloom.compiler.files import sha256_of
from spikeloom.models.recordings.counts import number
from spikeloom.runtime.commands.options import add_netlist, add_picture, add_recordings
from spikeloom.runtime.inputs.files import require_picture, require_place, write_picture
from spikeloom.runtime.inputs.recordings import load_recordings
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.stability.neighbours import KINDS
from spikeloom.runtime.studies.stability.results import Provenance
from spikeloom.runtime.studies.stability.sections import sections, taxel_map
from spikeloom.runtime.studies.stability.study import MOST, SHIFT, stability

NOTES = """\
On each recording every one of these changes is decided, none is sampled: {kinds}.
For several changed events it says how many are proven to be harmless and how many are shown to suffice.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist(parser)
    add_recordings(parser)
    parser.add_argument("--shift", type=int, default=SHIFT, metavar="BINS", help=f"furthest shift (default: {SHIFT})")
    parser.add_argument(
        "--most", type=int, default=MOST, metavar="N", help=f"changed events to look for a proof of (default: {MOST})"
    )
    parser.add_argument("--jobs", type=int, metavar="N", help="recordings at a time (default: one a core)")
    add_picture(parser, "how many decisions hang on each taxel")
    parser.add_argument("-o", "--output", metavar="OUT.json", help="write what --json prints")
    parser.epilog = NOTES.format(kinds="; ".join(KINDS.values()))


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command."""
    require_place(arguments.output, "-o", arguments)
    require_picture(arguments, [arguments.output])
    require_least(vars(arguments), shift=0, most=1, jobs=1)
    machine = machine_for(arguments.netlist)
    data = load_recordings(arguments, machine.netlist, labels_for="certify", joined=False)
    singles = int(data.step_counts.sum()) * data.taxels * data.events.shape[2]
    tell(f"trying {singles:,} single events of {number(len(data), 'recording')}, then taxels, pairs, shifts and cuts")
    found = stability(machine, data, shift=arguments.shift, most=arguments.most, jobs=arguments.jobs)
    result = replace(
        found,
        provenance=Provenance(
            spikeloom=__version__,
            netlist=Path(arguments.netlist).name,
            netlist_sha256=sha256_of(arguments.netlist),
            data=Path(arguments.data).name,
            data_sha256=arrays_digest(data.identity()),
            split=arguments.split,
        ),
    )
    write_picture(arguments.picture, lambda: taxel_map(result))
    write_json(arguments.output, result)
    return Outcome(result, sections)
