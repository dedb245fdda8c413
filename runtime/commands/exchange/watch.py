"""The command ``watch``: event lines in, the running decision out.

A line is ``time_s,taxel,polarity``. Bins are stepped in order, empty ones included, so that the final counts are those
of ``run`` on the same recording. A bin is stepped

* at full speed, as soon as a line of a later bin arrives;
* in real time, not before its end by the wall clock, which the first event of a grasp sets; and at the latest one bin
  after its end, so that decisions go on while nothing touches the sensor.

An event whose bin was stepped already, or whose grasp was decided already, is late: it is counted, not used.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.errors import DataError, ModelError, OptionError
from spikeloom.models.recordings.eventlines import Event, EventLines, Mark
from spikeloom.runtime.commands.options import add_netlist
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.sections import Outcome, Section, Text

if TYPE_CHECKING:
    from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.base import Step, Stream

NOTES = """\
Lines come in the order of their times: an event whose bin is over, since a later one came, is counted as late and not
used. What follows a # is a comment, and a grasp may begin with a header that names the columns, in any order. An empty
line or the line "reset" ends a grasp. Polarity is 0 and 1, or -1 and 1. --json prints one object a line: kind "bin"
for every bin, "grasp" for every decision, and "end" last.
"""

MAX_GAP = 100_000
"""Empty bins in a row; more of them means that the times are not seconds, or not of this grasp."""

EDGE = Decimal("1e-9")
"""Share of a bin by which a time may miss an edge and yet count as on it; the same as where recordings are read."""

REFRESH_S = 0.05
"""Least time between two drawings of the line on a terminal."""


class Display:
    """Where the running decision appears: lines on stdout; on a terminal also one line that changes, on stderr.

    Parameters
    ----------
    bin_s : Decimal
        Length of a bin.
    as_json : bool
        Print objects instead of text.
    """

    def __init__(self, bin_s: Decimal, *, as_json: bool) -> None:
        self._bin_s = bin_s
        self._json = as_json
        self._terminal = sys.stderr.isatty() and not as_json
        self._drawn = 0.0
        self._shown: int | None = None

    def bin(self, grasp: int, step: Step) -> None:
        """Show what is decided after a bin."""
        if self._json:
            self._write(self._result("bin", grasp, step.index + 1, step))
            return
        if not step.counts.any():
            return
        elapsed = f"{self._bin_s * (step.index + 1):f} s"
        if step.decision != self._shown:
            self._shown = step.decision
            self._write(f"{elapsed:>10}  {_standing(step)}")
        elif self._terminal and time.monotonic() >= self._drawn + REFRESH_S:
            sys.stderr.write(f"\r\x1b[K{elapsed:>10}  {_standing(step)}")
            sys.stderr.flush()
            self._drawn = time.monotonic()

    def grasp(self, grasp: int, bins: int, last: Step, *, early: bool | None = None) -> None:
        """Show what a grasp came to; and whether it ended before its length, where it may."""
        self._shown = None
        if self._json:
            self._write(self._result("grasp", grasp, bins, last, {} if early is None else {"early": early}))
        else:
            seconds = f"{self._bin_s * bins:f}"
            sure = ", sure" if early else ""
            self._write(f"grasp {grasp}: {_standing(last)}{sure}, after {_number(bins, 'bin')} ({seconds} s)")

    def _result(self, kind: str, grasp: int, bins: int, step: Step, more: dict[str, bool] | None = None) -> str:
        return json.dumps(
            {
                "kind": kind,
                "grasp": grasp,
                "bins": bins,
                "time_s": float(self._bin_s * bins),
                "decision": step.decision,
                "margin": step.margin,
                "counts": step.counts.tolist(),
                **(more or {}),
            }
        )

    def _write(self, line: str) -> None:
        if self._terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


class Watch:
    """Bins events and steps a stream; one pass over the lines, any number of grasps.

    Parameters
    ----------
    stream : Stream
        At rest.
    lines : EventLines
        Where events come from.
    display : Display
        Where decisions go.
    channels : int
        Input channels of the network.
    bin_s : Decimal
        Length of a bin.
    bins : int, optional
        Length of every grasp in bins; by default the last event or the wall clock ends it.
    from_first : bool
        Begin the bins of a grasp at its first event instead of at time 0.
    real : bool
        Keep to the wall clock.
    may_end : callable, optional
        Says from a chip step and the votes after it whether the grasp is decided, see :func:`exits.live`.
    """

    def __init__(
        self,
        stream: Stream,
        lines: EventLines,
        display: Display,
        *,
        channels: int,
        bin_s: Decimal,
        bins: int | None,
        from_first: bool,
        real: bool,
        may_end: Callable[[int, IntArray], bool] | None = None,
    ) -> None:
        self._stream = stream
        self._lines = lines
        self._display = display
        self._column = np.zeros(channels, np.uint8)
        self._bin_s = bin_s
        self._bins = bins
        self._from_first = from_first
        self._real = real
        self._may_end = may_end
        self._origin: Decimal | None = None  # of the grasp; None between two grasps
        self._epoch = 0.0  # wall clock at the origin
        self._decided = False
        self._last: tuple[Step, ...] = ()
        self.grasps = self.bins = self.events = self.repeated = self.late = self.early = 0
        self.step_s: list[float] = []

    def run(self) -> bool:
        """Follow the lines to their end; return whether the user, or the reader of our output, ended it before."""
        try:
            while True:
                if self._real and self._is_open() and not self._lines.arrived(self._wall(self._stream.index + 2)):
                    self._close_bin()
                    continue
                entry = self._lines.read()
                if isinstance(entry, Event):
                    self._take(entry)
                elif entry is not Mark.NOTHING:
                    self._end_grasp()
                    if entry is Mark.END_OF_STREAM:
                        return False
        except KeyboardInterrupt:
            if self._is_open() and self._stream.index:  # what the open bin holds is not all of it
                self._decide()
        except BrokenPipeError:
            pass
        return True

    def _is_open(self) -> bool:
        """Whether a grasp has begun and is not decided."""
        return self._origin is not None and not self._decided

    def _wall(self, bins: int) -> float:
        """Where the wall clock is after so many bins of the grasp."""
        return self._epoch + float(self._bin_s) * bins

    def _take(self, event: Event) -> None:
        """Put an event into its bin; step the bins before it."""
        self.events += 1
        if self._origin is None:
            self._origin = event.time_s if self._from_first else Decimal(0)
            self._epoch = time.monotonic() - float(event.time_s - self._origin)
        place = (event.time_s - self._origin) / self._bin_s + EDGE
        index = int(place) if place >= 0 else -1
        if self._is_open() and index - self._stream.index > MAX_GAP:
            gap = index - self._stream.index
            raise self._lines.complain(
                f"time {event.time_s} s leaves {gap} bins without an event, allowed are {MAX_GAP}",
                "give seconds, end a grasp with an empty line, or let it begin at its first event (--origin first)",
            )
        while self._is_open() and self._stream.index < index:
            self._close_bin()
        if self._decided or index < self._stream.index:
            self.late += 1
            return
        self.repeated += int(self._column[event.channel])
        self._column[event.channel] = 1

    def _close_bin(self, *, wait: bool = True) -> None:
        """Step the open bin, not before its end by the wall clock if that counts."""
        if self._real and wait:
            time.sleep(max(0.0, self._wall(self._stream.index + 1) - time.monotonic()))
        begun = time.perf_counter()
        step = self._stream.step(self._column)
        self._last = (step,)
        self.step_s.append(time.perf_counter() - begun)
        self._column[:] = 0
        self._display.bin(self.grasps + 1, step)
        if step.index + 1 == self._bins:
            self._decide()
        elif self._may_end is not None and self._may_end(step.index, step.counts):
            self._decide(early=True)

    def _end_grasp(self) -> None:
        """Step the bins that are left, decide, and get ready for the next grasp."""
        while self._is_open() and (self._column.any() or self._stream.index < (self._bins or 0)):
            self._close_bin(wait=False)
        if self._is_open():
            self._decide()
        self._stream.reset()
        self._origin, self._decided = None, False

    def _decide(self, *, early: bool = False) -> None:
        """Run the steps by which the read-out lags, unless they change nothing, and show the decision."""
        bins = self._stream.index
        self._decided = True
        last = self._last[-1] if early else (*self._last, *self._stream.finish())[-1]
        self.grasps += 1
        self.bins += bins
        self.early += early
        self._display.grasp(self.grasps, bins, last, early=None if self._may_end is None else early)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepTime:
    """Median and 99th percentile of the time of a step, also as a share of a bin."""

    median_ms: float
    p99_ms: float
    p99_share_of_bin: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """All grasps together; `early` counts those that ended before their length, where they may."""

    kind: str = "end"
    grasps: int
    bins: int
    events: int
    repeated: int
    late: int
    interrupted: bool
    early: int | None = field(default=None, metadata=OPTIONAL)
    step: StepTime | None = field(default=None, metadata=OPTIONAL)


def run(arguments: argparse.Namespace) -> Outcome:
    """Run the command; its result is the summary, everything else was printed before.

    Raises
    ------
    SpikeloomError
        If an option, the netlist or a line cannot be used.
    """
    from spikeloom.runtime.machines.base import machine_for
    from spikeloom.runtime.machines.integer import integer_machine
    from spikeloom.runtime.studies.anytime import exits

    bin_s = _duration(arguments.bin)  # of the recordings; a step of the network may join several
    if arguments.bins is not None and arguments.bins < 1:
        raise OptionError(f"--bins {arguments.bins}: not a length; give 1 or more, or leave it out")
    factor = arguments.until_sure
    if factor is not None and arguments.bins is None:
        raise OptionError("--until-sure: what can still come is not known; give the length of a grasp with --bins")
    if factor is not None and not factor >= 0:
        raise OptionError(
            f"--until-sure {factor:g}: no votes per root of a bin; give a number from 0, as spikeloom anytime prints "
            "it, or none for the proof alone"
        )
    machine = machine_for(arguments.netlist)
    netlist = machine.netlist
    bin_s *= netlist.bins
    if netlist.polarities != 2:
        raise ModelError(
            f"{arguments.netlist}: {netlist.polarities} polarities per taxel found, event lines have 2; "
            "watch a network for events of two polarities"
        )
    stream = machine.stream()
    stdin = arguments.input == "-"
    name = "standard input" if stdin else arguments.input
    with _opened(arguments.input) as file:
        session = Watch(
            stream,
            EventLines(file, name, netlist.taxels),
            Display(bin_s, as_json=arguments.json),
            channels=netlist.taxels * netlist.polarities,
            bin_s=bin_s,
            bins=arguments.bins,
            from_first=arguments.origin == "first",
            real=arguments.speed == "real",
            may_end=None if factor is None else exits.live(integer_machine(machine), arguments.bins, factor),
        )
        interrupted = session.run()
    if not session.events and not interrupted:
        raise DataError(f"{name}: empty stream, no event found; give lines 'time_s,taxel,polarity'")
    summary = Summary(
        grasps=session.grasps,
        bins=session.bins,
        events=session.events,
        repeated=session.repeated,
        late=session.late,
        interrupted=interrupted,
        early=None if factor is None else session.early,
        step=_timing(session.step_s, float(bin_s)) if arguments.timing else None,
    )
    return Outcome(summary, sections)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    add_netlist(parser)
    parser.add_argument("--input", default="-", metavar="FILE", help="event lines (default: -, standard input)")
    parser.add_argument(
        "--bin", default="0.02", metavar="SECONDS", help="length of a bin of the recordings (default: 0.02)"
    )
    parser.add_argument(
        "--bins", type=int, metavar="N", help="steps of every grasp: shorter ones are filled up, longer ones cut"
    )
    parser.add_argument(
        "--origin",
        choices=("zero", "first"),
        default="zero",
        help="where the first bin of a grasp begins: at time 0 or at the first event (default: zero)",
    )
    parser.add_argument(
        "--speed",
        choices=("real", "full"),
        default="full",
        help="keep to the wall clock, or go on as soon as events allow it (default: full)",
    )
    parser.add_argument(
        "--until-sure",
        nargs="?",
        type=float,
        const=math.inf,
        metavar="A",
        help="end a grasp of --bins once nothing can change the vote, or it leads by A*sqrt(bins left) (see anytime)",
    )
    parser.add_argument("--timing", action="store_true", help="add the time that steps took to the summary")
    parser.epilog = NOTES


def _opened(name: str) -> io.FileIO:
    """File of event lines, or standard input."""
    try:
        return io.FileIO(0 if name == "-" else name, closefd=name != "-")
    except OSError as error:
        raise DataError(
            f"--input {name}: {error.strerror}; give a file of event lines, or - for standard input"
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


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _standing(step: Step) -> str:
    """The decision and what it rests on, for people."""
    if not step.counts.any():
        return f"class {step.decision}, no votes"
    ahead = f"{step.margin} ahead" if step.margin else "a tie"
    return f"class {step.decision}, {_number(int(step.counts.max()), 'vote')}, {ahead}"


def _timing(step_s: list[float], bin_s: float) -> StepTime:
    median, late = np.percentile(step_s or [0.0], [50, 99]).tolist()
    return StepTime(median_ms=1e3 * median, p99_ms=1e3 * late, p99_share_of_bin=late / bin_s)


def sections(found: Summary) -> list[Section]:
    """The summary for people."""
    parts = [_number(found.grasps, "grasp"), _number(found.bins, "bin"), _number(found.events, "event")]
    parts += [f"{found.repeated} repeated within a bin", f"{found.late} late"]
    text = ", ".join([*parts, *([] if found.early is None else [f"{found.early} ended early"])])
    if found.step is not None:
        step = found.step
        share = f"{100 * step.p99_share_of_bin:.2g} % of a bin"
        text += f"\nstep: median {step.median_ms:.3f} ms, 99th percentile {step.p99_ms:.3f} ms ({share})"
    return [Section("Watched", [Text(text + ("\ninterrupted" if found.interrupted else ""))])]
