"""Event lines in, the running decision out.

A line is ``time_s,taxel,polarity``. Bins are stepped in order, empty ones included, so that the final counts
are those of ``run`` on the same recording. A bin is stepped

* at full speed, as soon as a line of a later bin arrives;
* in real time, not before its end by the wall clock, which the first event of a grasp sets; and at the latest one bin
  after its end, so that decisions go on while nothing touches the sensor.

An event whose bin was stepped already is late; what comes after a grasp's decision is counted apart. Neither
is used.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal

from spikeloom.compiler.types import EventArray, IntArray, JsonObject
from spikeloom.models.recordings.counts import number, time_note
from spikeloom.models.recordings.eventlines import Event, EventLines, Mark
from spikeloom.runtime.machines.base import Step, Stream
from spikeloom.runtime.report.console import tell
from spikeloom.runtime.report.encode import OPTIONAL
from spikeloom.runtime.report.sections import Section, Text

MAX_GAP = 100_000
"""Empty bins in a row; more of them means that the times are not seconds, or not of this grasp."""

EDGE = Decimal("1e-9")
"""Share of a bin by which a time may miss an edge and yet count as on it; the same as where recordings are read."""


@dataclass(slots=True, kw_only=True)
class Summary:
    """All grasps together; `early` counts those that ended before their length, where they may."""

    kind: str = "end"
    grasps: int = 0
    bins: int = 0
    events: int = 0
    repeated: int = 0
    late: int = 0
    after_decision: int = 0
    interrupted: bool = False
    early: int | None = field(default=None, metadata=OPTIONAL)


@dataclass(kw_only=True, eq=False)
class Watch:
    """Bins events and steps a stream; one pass over the lines, any number of grasps."""

    stream: Stream  # At rest
    lines: EventLines
    as_json: bool  # Whether decisions are printed as objects, or as lines for people
    bin_s: Decimal  # Length of a bin
    bins: int | None  # Length of every grasp in bins; without it the last event or the wall clock ends it
    from_first: bool  # Whether the bins of a grasp begin at its first event instead of at time 0
    real: bool  # Whether to keep to the wall clock
    # Says from a chip step and the votes after it whether the grasp is decided, see :func:`exits.live`
    may_end: Callable[[int, IntArray], bool] | None
    column: EventArray  # Inputs of the open bin, (channels,)
    names: Sequence[str] | None = None  # Of classes
    origin: Decimal | None = None  # Of the grasp; None between two grasps
    epoch: float = 0.0  # Wall clock at the origin
    decided: bool = False
    last: tuple[Step, ...] = ()
    shown: int | None = None  # Decision that was printed last
    found: Summary = field(default_factory=Summary)
    times: tuple[Decimal, Decimal, int] | None = None  # First and last of the grasp, and how many there are
    noted: bool = False  # Whether it was said that times look wrong

    def run(self) -> None:
        """Follow the lines to their end, or until the user, or the reader of our output, ends it before."""
        try:
            while True:
                waits = self.real and self._is_open()
                entry = self.lines.read(self._wall(self.stream.index + 2) if waits else None)
                if entry is None:
                    self._close_bin()
                elif isinstance(entry, Event):
                    self._take(entry)
                else:
                    self._end_grasp()
                    if entry is Mark.END_OF_STREAM:
                        return
        except KeyboardInterrupt:
            if self._is_open() and self.stream.index:  # what the open bin holds is not all of it
                self._decide()
        except BrokenPipeError:
            pass
        self.found.interrupted = True

    def _is_open(self) -> bool:
        """Whether a grasp has begun and is not decided."""
        return self.origin is not None and not self.decided

    def _wall(self, bins: int) -> float:
        """Where the wall clock is after so many bins of the grasp."""
        return self.epoch + float(self.bin_s) * bins

    def _take(self, event: Event) -> None:
        """Put an event into its bin; step the bins before it."""
        self.found.events += 1
        if self.origin is None:
            self.origin = event.time_s if self.from_first else Decimal(0)
            self.epoch = time.monotonic() - float(event.time_s - self.origin)
        first, last, moments = self.times or (event.time_s, event.time_s, 1)
        moments += event.time_s != last
        self.times = min(first, event.time_s), max(last, event.time_s), moments
        place = (event.time_s - self.origin) / self.bin_s + EDGE
        index = int(place) if place >= 0 else -1
        if self._is_open() and index - self.stream.index > MAX_GAP:
            gap = index - self.stream.index
            raise self.lines.complain(
                f"time {event.time_s} s leaves {gap} bins without an event, allowed are {MAX_GAP}",
                "give seconds, end a grasp with an empty line, or let it begin at its first event (--origin first)",
            )
        while self._is_open() and self.stream.index < index:
            self._close_bin()
        if self.decided:
            self.found.after_decision += 1
            return
        if index < self.stream.index:
            self.found.late += 1
            if str(self.found.late).strip("0") == "1":  # 1, 10, 100, …
                many = number(self.found.late, "event")
                tell(f"{many} so far after the end of a bin, this one of {event.time_s} s: late, not used")
            return
        self.found.repeated += int(self.column[event.channel])
        self.column[event.channel] = 1

    def _close_bin(self, *, wait: bool = True) -> None:
        """Step the open bin, not before its end by the wall clock if that counts."""
        if self.real and wait:
            time.sleep(max(0.0, self._wall(self.stream.index + 1) - time.monotonic()))
        step = self.stream.step(self.column)
        self.last = (step,)
        self.column[:] = 0
        line = ""
        if step.counts.any() and step.decision != self.shown:
            self.shown = step.decision
            elapsed = f"{self.bin_s * (step.index + 1):f} s"
            line = f"{elapsed:>10}  {_standing(step, self.names)}"
        self._show(line, "bin", self.found.grasps + 1, step.index + 1, step)
        if step.index + 1 == self.bins:
            self._decide()
        elif self.may_end is not None and self.may_end(step.index, step.counts):
            self._decide(early=True)

    def _end_grasp(self) -> None:
        """Step the bins that are left, decide, and get ready for the next grasp."""
        while self._is_open() and (self.column.any() or self.stream.index < (self.bins or 0)):
            self._close_bin(wait=False)
        if self._is_open():
            self._decide()
        self.stream.reset()
        self._note_times()
        self.origin = None
        self.decided = False

    def _note_times(self) -> None:
        """Say once what recordings with such times would be told."""
        if self.times is not None and not self.noted:
            first, last, moments = self.times
            start = self.origin if self.from_first and self.origin is not None else Decimal(0)
            if note := time_note(float(first - start), float(last - start), moments):
                tell(f"warning: grasp {self.found.grasps}: {note}")
                self.noted = True
        self.times = None

    def _decide(self, *, early: bool = False) -> None:
        """Run the steps by which the read-out lags, unless they change nothing, and show the decision."""
        bins = self.stream.index
        self.decided = True
        last = self.last[-1] if early else (*self.last, *self.stream.finish())[-1]
        self.found.grasps += 1
        self.found.bins += bins
        if self.found.early is not None:
            self.found.early += early
        self.shown = None
        after = f"after {number(bins, 'bin')} ({self.bin_s * bins:f} s)"
        line = (
            f"grasp {self.found.grasps}: {_standing(last, self.names)}{', sure' if early else ''}, {after}"
        )
        self._show(
            line, "grasp", self.found.grasps, bins, last, {} if self.may_end is None else {"early": early}
        )

    def _show(
        self, line: str, kind: str, grasp: int, bins: int, step: Step, more: JsonObject | None = None
    ) -> None:
        """Print a line, if there is one, or what it says as an object."""
        if self.as_json:
            standing = {"kind": kind, "grasp": grasp, "bins": bins, "time_s": float(self.bin_s * bins)}
            standing |= {"decision": step.decision, "margin": step.margin, "counts": step.counts.tolist()}
            standing |= {} if self.names is None else {"class_name": self.names[step.decision]}
            line = json.dumps(standing | (more or {}))
        if line:
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()


def _standing(step: Step, names: Sequence[str] | None) -> str:
    """The decision and what it rests on, for people."""
    decision = step.decision if names is None else names[step.decision]
    if not step.counts.any():
        return f"class {decision}, no votes"
    ahead = f"{step.margin} ahead" if step.margin else "a tie"
    return f"class {decision}, {number(int(step.counts.max()), 'vote')}, {ahead}"


def sections(found: Summary) -> list[Section]:
    """The summary for people."""
    parts = [number(found.grasps, "grasp"), number(found.bins, "bin"), number(found.events, "event")]
    parts += [f"{found.repeated} repeated within a bin", f"{found.late} late"]
    parts += [f"{found.after_decision} after the decision"] if found.after_decision else []
    text = ", ".join([*parts, *([] if found.early is None else [f"{found.early} ended early"])])
    return [Section("Watched", [Text(text + ("\ninterrupted" if found.interrupted else ""))])]
