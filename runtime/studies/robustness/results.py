"""What ``stress`` returns: curves by perturbation; and ``certify``: a certificate of each recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from spikeloom.compiler import __version__
from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.inputs.recordings import name_of
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL, key
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.requests.check import CertifyRequest, StressRequest
from spikeloom.runtime.studies.robustness.definition import Level


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Counts over all recordings under one draw of a perturbation."""

    seed: int | None  # None for the clean recordings
    right: Mapping[str, int]  # Right decisions by side
    equal: int  # Decisions that are the same on both sides
    # Of each layer: spikes of the float network and of the chip, those in which they differ, entries
    layers: Mapping[str, tuple[int, int, int, int]]
    # Recordings with a sign of breakdown (``no vote``, ``one class``) by side and sign
    signs: Mapping[str, Mapping[str, int]]
    most: Mapping[str, tuple[int, int]]  # Class that is decided most often by side, and how often
    # stopped, saturated: Recordings that overflow a register of the chip, and membranes that it clips
    stopped: int
    saturated: int


@dataclass(frozen=True, slots=True, kw_only=True)
class InCondition:
    """Clean recordings of a condition, and right decisions by side."""

    recordings: int
    right: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Mean accuracy over seeds, its 95 % interval, and the accuracy of each seed."""

    mean: float
    low: float
    high: float
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One level: accuracies, share of equal decisions, share of spikes in common by layer, and reasons by side."""

    level: Level
    seeds: tuple[int, ...]
    model: Spread = field(metadata=key("float"))
    chip: Spread
    equal: float
    common: Mapping[str, float]
    stopped: int
    saturated: int
    why: Mapping[str, tuple[str, ...]]

    def spread(self, side: str) -> Spread:
        """Accuracy of a side."""
        return self.chip if side == "chip" else self.model


@dataclass(frozen=True, slots=True, kw_only=True)
class Breaks:
    """First level at which a side leaves the clean interval, and comes down to chance."""

    leaves: Level | None
    chance: Level | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """One perturbation from mild to harsh; `breaks` by side."""

    what: str
    unit: str
    seeded: bool
    levels: tuple[Point, ...]
    breaks: Mapping[str, Breaks]
    same_place: bool
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """What either depends on, beside its options: versions, hashes, names of files."""

    spikeloom: str
    netlist: str
    netlist_sha256: str
    data: str
    data_sha256: str
    split: str

    @classmethod
    def of(cls, request: CertifyRequest | StressRequest, data_sha256: str, **more: Any) -> Self:
        """That of a request on recordings with this hash; `more` are the fields of a subclass."""
        return cls(
            spikeloom=__version__,
            netlist=Path(request.netlist).name,
            netlist_sha256=sha256_of(request.netlist),
            data=name_of(request.data),
            data_sha256=data_sha256,
            split=request.split,
            **more,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedProvenance(Provenance):
    """The same, where a float network stands beside the chip."""

    checkpoint: str
    checkpoint_sha256: str
    dt: float | None = field(default=None, metadata=OPTIONAL)
    convention: str | None = field(default=None, metadata=OPTIONAL)
    polarities_first: bool | None = field(default=None, metadata=OPTIONAL)
    graph: str | None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Stress(Shown):
    """Where float network and chip break: curves by perturbation, and why others were not measured."""

    recordings: int
    classes: int
    seeds: int
    clean: Run
    conditions: Mapping[str, InCondition] = field(default_factory=dict)
    perturbations: Mapping[str, Curve]
    not_applicable: Mapping[str, str]
    required: tuple[str, ...]
    missed: tuple[str, ...]
    provenance: ComparedProvenance


def shown(level: Level) -> str:
    """A level as it is typed.

    >>> shown(3), shown(0.25), shown(1e-4)
    ('3', '0.25', '0.0001')
    """
    return f"{level:g}"


PHASES = 10
"""Parts of a recording in which altering events are counted."""


@dataclass(frozen=True, slots=True)
class Decided:
    """One kind of change on one recording: how many there are, how many alter the decision, the first that does."""

    tried: int
    alter: int
    first: str | None = None
    to: int | None = None  # What is decided then
    least: int | None = None  # Bins of the smallest that does, where a kind has sizes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What a checker needs to see for itself that no `unaltered` events alter a decision, and that `changes` do."""

    rule: int  # By which it can see that: 0 for nothing, see ``examples/check_certificate.py``
    unaltered: int
    bins: IntArray  # (channels, steps) int64; bins of the recording that are set in each step of the network
    changes: IntArray  # (changes, 2) int64; channel and step
    pasts: IntArray  # (groups, 3) int64; what a proof knows of the past of a group: see ``proofs.bounds.Proven``


@dataclass(frozen=True, slots=True, kw_only=True)
class FloatModel:
    """What the float model decides of a recording, in float32; no change of up to `at_least` events alters that."""

    decision: int
    at_least: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """What is proven and known of one recording.

    No change of up to `at_least` events alters its decision; the change `attack` of `at_most` events does,
    if one was found. `taxels` are those on which the decision hangs, by kind of change; `phases` the
    single events that alter it, by tenth of the recording.
    """

    file: str
    label: int
    decision: int
    ahead: int  # Votes that another class must gain on the decision
    kinds: Mapping[str, Decided]
    at_least: int
    at_most: int | None
    exact: bool  # Whether `at_least` is the largest number of which this is true, up to the largest that was looked for
    attack: tuple[str, ...]
    taxels: Mapping[str, tuple[int, ...]]
    phases: tuple[int, ...]
    model: FloatModel | None = field(default=None, metadata={**key("float"), **OPTIONAL})
    evidence: Evidence | None = field(default=None, metadata=HIDDEN, compare=False)

    @property
    def right(self) -> bool:
        """Whether the decision is the label."""
        return self.label == self.decision

    @property
    def alike(self) -> int | None:
        """Up to so many changed events float model and chip are proven to decide alike; None if they never do."""
        if self.model is None or self.model.decision != self.decision:
            return None
        return min(self.at_least, self.model.at_least)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Certificates(Shown):
    """Those of all recordings; `most` is the largest number of events that was looked for, `shift` that of bins."""

    target: str
    taxels: int
    classes: int
    shift: int
    most: int
    certificates: tuple[Certificate, ...]
    provenance: Provenance | None = None
    class_names: Sequence[str] | None = field(default=None, metadata=OPTIONAL)
    # (taxels, 2 or 3) millimetres, as far as they are known
    places: FloatArray | None = field(default=None, metadata=HIDDEN)

    def certified(self, events: int) -> int:
        """Recordings whose decision no change of up to so many events alters."""
        return sum(each.at_least >= events for each in self.certificates)

    def unaltered(self, kind: str) -> int:
        """Recordings whose decision no change of a kind alters."""
        return sum(not each.kinds[kind].alter for each in self.certificates)
