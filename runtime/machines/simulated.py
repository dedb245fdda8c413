"""What a command simulated, and why not less: the option ``--explain-cost``.

A command names each part as it begins; what is known about parts stands here, once. Nothing is measured but the time.
"""

import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.report.console import Progress, progress, tell
from spikeloom.runtime.report.encode import INLINE, OPTIONAL

CHIP = "chip integers"


class Kind(NamedTuple):
    """A part of a command.

    Its arithmetic (``CHIP`` is the engine's), what it is for, and over which recordings it runs: all, those that the
    specification runs (checked), one, or none since it was not needed.
    """

    arithmetic: str
    over: str
    why: str


SUMS = "energies and simple times are sums over events: added up in the same run, no spike kept"
UNBOUNDED = "integer sums, no limits of registers"

KINDS = {
    # of run and estimate
    "spikes": Kind(CHIP, "all", "decisions need counts of spikes alone: none is kept, nothing is priced"),
    "spikes kept": Kind(CHIP, "all", "--spikes wants every spike: all run once more for each layer that is written"),
    "counts": Kind(CHIP, "all", SUMS),
    "cycle": Kind(CHIP, "all", "every message of every step is scheduled: spikes and updates kept, in the same run"),
    "no float": Kind("float", "none", "the float model says nothing about the chip's decisions or costs"),
    # of verify
    "float32 reference": Kind("float32, released operator order", "all", "what the chip's spikes are held against"),
    "ladder: float64": Kind("float64 sums", "all", "shows spikes that rounding of sums decides"),
    "chip": Kind(CHIP, "all", "every spike kept, since every one is compared"),
    "lowered model": Kind("whole numbers", "all", "E1: the model that the network brings has to be the chip"),
    "specification": Kind(
        "64-bit integers, and the engine again with membranes", "checked", "E0; --spec-samples says how many"
    ),
    "ladder: beta": Kind("float64 sums", "all", "spikes that differ by the decay registers alone"),
    "ladder: weights": Kind("float64 sums", "all", "and by rounded weights"),
    "ladder: bias_threshold": Kind("float64 sums", "all", "and by rounded biases and thresholds"),
    "ladder: rounding": Kind(UNBOUNDED, "all", "a membrane might saturate: what that does"),
    "ladder: proven": Kind(UNBOUNDED, "none", "no register can leave its range, so that rung is the chip"),
    "first divergence": Kind("membranes in float32 and on the chip", "one", "the recording that differs first"),
    # of report, beside those of verify
    "costs": Kind(CHIP, "all", SUMS),
    "the recording": Kind(CHIP, "one", "spikes and membranes of the recording that is drawn"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of a command as it went by; `kernel` is what the engine ran on, None where it did not run."""

    part: str
    ran: bool
    arithmetic: str
    recordings: int
    data_steps: int
    layers: tuple[str, ...]
    kernel: str | None
    why: str
    seconds: float

    def __str__(self) -> str:
        if not self.ran:
            return f"not simulated, {self.arithmetic}: {self.why}"
        noun = "recording" if self.recordings == 1 else "recordings"
        what = [f"{self.recordings} {noun}, {self.data_steps:,} steps", f"{len(self.layers)} layers", self.arithmetic]
        what += [self.kernel] if self.kernel else []
        return f"simulated {self.part} ({', '.join(what)}), {self.seconds:.2f} s: {self.why}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Accounted:
    """A result, a comparison and the parts behind it where they are wanted."""

    result: Any = field(metadata=INLINE)
    against_processor: Any = field(default=None, metadata=OPTIONAL)
    explained_cost: tuple[Part, ...] | None = field(default=None, metadata=OPTIONAL)


class Account:
    """Parts of a command that simulates a netlist on recordings; the specification runs the first `checked`."""

    def __init__(self, machine: Machine, data: Recordings, *, checked: int = 0) -> None:
        self._machine, self._checked = machine, min(checked, len(data))
        self._steps = data.step_counts
        self._seconds: dict[str, float] = {}
        self._now, self._since = "", time.perf_counter()
        self._progress = Progress(len(data))

    def begin(self, part: str, done: int = 0) -> None:
        """A part begins, perhaps once more, and the one before it has ended; so many recordings are done."""
        now = time.perf_counter()
        if self._now:
            self._seconds[self._now] += now - self._since
        self._seconds.setdefault(part, 0.0)
        self._now, self._since = part, now
        if (over := KINDS[part].over) == "all":
            self._progress(done, part)
        elif over != "none":
            progress(part)

    def explained(self, wanted: bool) -> tuple[Part, ...] | None:
        """All parts in their order, written to stderr too, if they are wanted; the last one ends now."""
        if not wanted:
            return None
        self.begin(self._now)
        parts = tuple(self._part(name, seconds) for name, seconds in self._seconds.items())
        progress("")
        tell("\n".join(map(str, parts)))
        return parts

    def _part(self, name: str, seconds: float) -> Part:
        kind = KINDS[name]
        recordings = {"all": len(self._steps), "checked": self._checked, "one": 1, "none": 0}[kind.over]
        ran = recordings > 0
        return Part(
            part=name,
            ran=ran,
            arithmetic=kind.arithmetic,
            recordings=recordings,
            data_steps=int(self._steps.max(initial=0) if kind.over == "one" else self._steps[:recordings].sum()),
            layers=self._machine.layers if ran else (),
            kernel=self._machine.kernel if ran and kind.arithmetic == CHIP else None,
            why=kind.why,
            seconds=seconds if ran else 0.0,
        )
