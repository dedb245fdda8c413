"""What is known of the decisions of some recordings; as JSON, for other studies, and to be read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from spikeloom.runtime.report.shown import Shown

PHASES = 10
"""Parts of a recording in which altering events are counted."""


@dataclass(frozen=True, slots=True)
class Found:
    """One kind of change on one recording: how many there are, how many alter the decision, the first that does."""

    tried: int
    alter: int
    first: str | None = None
    to: int | None = None  # What is decided then
    least: int | None = None  # Bins of the smallest that does, where a kind has sizes


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """One recording.

    No change of up to `at_least` events alters its decision; the change `attack` of `at_most` events does, if one was
    found. `taxels` are those on which the decision hangs, by kind of change; `phases` the single events that alter it,
    by tenth of the recording.
    """

    file: str
    label: int
    decision: int
    ahead: int  # Votes that another class must gain on the decision
    kinds: Mapping[str, Found]
    at_least: int
    at_most: int | None
    exact: bool  # Whether `at_least` is the largest number of which this is true, up to the largest that was looked for
    attack: tuple[str, ...]
    taxels: Mapping[str, tuple[int, ...]]
    phases: tuple[int, ...]

    @property
    def right(self) -> bool:
        """Whether the decision is the label."""
        return self.label == self.decision


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """What verdicts depend on."""

    spikeloom: str
    netlist: str
    netlist_sha256: str
    data: str
    data_sha256: str
    split: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Stability(Shown):
    """Verdicts of recordings; `most` is the largest number of events that was looked for, `shift` that of bins."""

    target: str
    taxels: int
    classes: int
    shift: int
    most: int
    verdicts: tuple[Verdict, ...]
    provenance: Provenance | None = None

    def certified(self, events: int) -> int:
        """Recordings whose decision no change of up to so many events alters."""
        return sum(verdict.at_least >= events for verdict in self.verdicts)

    def unaltered(self, kind: str) -> int:
        """Recordings whose decision no change of a kind alters."""
        return sum(not verdict.kinds[kind].alter for verdict in self.verdicts)
