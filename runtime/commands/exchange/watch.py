"""The command ``watch``: event lines in, the running decision out; :mod:`studies.watching` follows them."""

import io
import zipfile
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.compiler.targets.netlist_file import Netlist, names_of, origin_of
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.counts import number
from spikeloom.models.recordings.eventlines import EventLines
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.requests.exchange import WatchRequest
from spikeloom.runtime.studies.watching import Summary, Watch, sections

NOTES = """\
Lines come in the order of their times. An event of a bin that is over, since one of a later bin came, is not used, but
reported and counted as late; events after a grasp's decision are counted apart. What follows a # is a comment, and a
grasp may begin with a header that names the columns, in any order. An empty line or the line "reset" ends a grasp.
Polarity is 0 and 1, or -1 and 1. --json prints one object a line: kind "bin" for every bin, "grasp" for every decision,
and "end" last. TrueNorth runs whole recordings only.
"""

REQUEST = WatchRequest


def run(request: WatchRequest) -> Outcome:
    """Run the command; its result is the summary, everything else was printed before."""
    from spikeloom.runtime.machines.backends import machine_for

    machine = machine_for(request.netlist)
    netlist = machine.netlist
    bins = _bins(request, netlist)
    if netlist.polarities != 2:
        raise ModelError(
            f"{request.netlist}: {number(netlist.polarities, 'polarity')} per taxel found, event lines have 2; "
            "watch a network for events of two polarities"
        )
    name = "standard input" if request.input == "-" else request.input
    early = None if request.until_sure is None else 0
    step_s = _step_seconds(request, netlist)
    with _opened(request.input) as file:
        session = Watch(
            stream=machine.stream(),
            lines=EventLines(file, name, netlist.taxels),
            as_json=request.json,
            column=np.zeros(netlist.taxels * netlist.polarities, np.uint8),
            bin_s=step_s,
            bins=bins,
            from_first=request.origin == "first",
            real=request.speed == "real",
            may_end=_ending(request, machine, bins),
            found=Summary(early=early),
            names=names_of(netlist.provenance, netlist.classes),
        )
        session.run()
    if not session.found.events and not session.found.interrupted:
        raise DataError(f"{name}: empty stream, no event found; give lines 'time_s,taxel,polarity'")
    return Outcome(session.found, sections)


def _require_sure(factor: float | None, bins: int | None) -> None:
    """Refuse an early end without a length, and a factor that is none."""
    if factor is None:
        return
    if bins is None:
        raise OptionError(
            "--until-sure: what can still come is not known; give the length of a grasp with --bins"
        )
    if not factor >= 0:
        raise OptionError(
            f"--until-sure {factor:g}: no votes per root of a bin; give a number from 0, as spikeloom anytime prints "
            "it, or none for the proof alone"
        )


def _bins(request: WatchRequest, netlist: Netlist) -> int | None:
    """Bins of every grasp, where their number is fixed; refused where that is none, or an early end needs it."""
    if request.bins is not None and request.bins < 1:
        raise OptionError(f"--bins {request.bins}: not a length; give 1 or more, or omit it")
    length = netlist.clocks.length
    bins = request.bins or length
    if length and bins != length:
        raise OptionError(
            f"--bins {bins}: the network runs every grasp for {length} steps, the last of them its read-out; "
            f"give --bins {length} or omit it"
        )
    _require_sure(request.until_sure, bins)
    return bins


def _step_seconds(request: WatchRequest, netlist: Netlist) -> Decimal:
    """Length of a step, which may join several bins of the recordings."""
    from spikeloom.models.recordings.evtouch import BIN_S
    from spikeloom.runtime.inputs.recordings import step_of, warn_of_steps

    bin_s = None if request.bin is None else _duration(request.bin)
    origin = origin_of(netlist.provenance)
    trained = origin.get("bin_s")
    if trained is not None and bin_s not in (None, Decimal(str(trained))):
        raise OptionError(f"--bin {bin_s:g}: the network was trained on bins of {trained:g} s; omit --bin")
    bin_s = bin_s or Decimal(str(trained or BIN_S))
    warn_of_steps(request.netlist, float(bin_s), origin | step_of(netlist.provenance, netlist.bins))
    return netlist.bins * bin_s


def _ending(
    request: WatchRequest, machine: Machine, bins: int | None
) -> Callable[[int, IntArray], bool] | None:
    """Says whether a grasp is decided before its end, where that is wanted."""
    from spikeloom.runtime.machines.capabilities import Stoppable
    from spikeloom.runtime.studies.anytime import exits

    if request.until_sure is None or bins is None:
        return None
    return exits.live(Stoppable.required(machine, request.netlist, "--until-sure"), bins, request.until_sure)


def _opened(name: str) -> io.FileIO:
    """File of event lines, or standard input."""
    if name != "-" and Path(name).is_file() and zipfile.is_zipfile(name):
        raise DataError(
            f"--input {name}: is no text; give event lines, or the recordings in it to spikeloom run --data"
        )
    try:
        return io.FileIO(0 if name == "-" else name, closefd=name != "-")
    except OSError as error:
        raise DataError(
            f"--input {name}: {error.strerror}; give event lines, or - for standard input"
        ) from error


def _duration(text: str) -> Decimal:
    """Length of a bin."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal(0)
    if not seconds.is_finite() or not Decimal("1e-6") <= seconds <= 1000:
        raise OptionError(f"--bin {text}: not a duration; give seconds from 0.000001 to 1000, such as 0.02")
    return seconds
