"""What the page of a network shows, each part as its JSON has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.equivalence.verdict import Verdict
from spikeloom.runtime.machines.page_parts import BatchParts, Cores, Sizes
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL, key
from spikeloom.runtime.report.sections import Outcome
from spikeloom.runtime.studies.chart.results import Chart
from spikeloom.runtime.studies.stress.results import Stress

Floats = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sides:
    """An array of the float model and one of the chip."""

    model: IntArray = field(metadata=key("float"))
    chip: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """Every recording's decisions; matrices (classes, classes) count them, rows by label."""

    classes: int
    matrices: Sides
    files: tuple[str, ...]
    labels: IntArray
    model: IntArray = field(metadata=key("float"))
    chip: IntArray

    def confusions(self) -> list[tuple[int, int, int, int]]:
        """Label, wrong decision, and how often float model and chip take it; the most frequent first."""
        ours, chip = self.matrices.model, self.matrices.chip
        pairs = [
            (label, decided, int(ours[label, decided]), int(chip[label, decided]))
            for label, decided in np.argwhere(ours + chip).tolist()
            if label != decided
        ]
        return sorted(pairs, key=lambda pair: (-pair[2] - pair[3], pair[0], pair[1]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Taxels:
    """The sensor, its graph where there is one, and events and first-layer spikes of each taxel, on the mean."""

    sensor: str | None
    positions_mm: FloatArray | None
    graph: str | None
    edges: IntArray
    events: FloatArray
    layer: str
    spikes: FloatArray | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LayerSpikes:
    """Spikes of a layer in one recording, as pairs of step and neuron: where both fire, and where one side does."""

    name: str
    neurons: int
    active: IntArray
    float_spikes: int
    chip_spikes: int
    different: int
    both: IntArray
    float_only: IntArray
    chip_only: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Membranes of a neuron, called `of`, in the float model's units around a step.

    There its spikes differ or, if it does not diverge, its membranes lie furthest apart. Without it on the chip it is
    not held.
    """

    layer: str
    neuron: int
    of: str
    step: int
    held: bool
    first_step: int
    theta: float
    chip_theta: float
    model: Floats = field(metadata=key("float"))
    chip: FloatArray
    float_spikes: IntArray
    chip_spikes: IntArray
    diverges: bool

    @property
    def title(self) -> str:
        """What it shows."""
        where = f"{self.layer} {self.of}, step {self.step}"
        if not self.diverges:
            return f"no spike differs; the membranes lie furthest apart at {where}"
        return f"first spike of {self.layer} that differs: {where}{'' if self.held else ' (not on the chip)'}"

    def fires(self, step: int) -> str:
        """Who fires in a step."""
        sides = step in self.float_spikes, step in self.chip_spikes
        return {(True, True): "both", (True, False): "float only", (False, True): "chip only", (False, False): ""}[
            sides
        ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BySteps:
    """Joules and seconds of each chip step of one recording, and mean seconds of all, by table."""

    energy_j: Mapping[str, FloatArray]
    time_s: Mapping[str, FloatArray]
    mean_time_s: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Decided:
    """Decisions of both sides."""

    model: int = field(metadata=key("float"))
    chip: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """One recording on both sides; `input` holds pairs of step and channel, `costs` what estimate says of it."""

    file: str
    index: int
    steps: int
    label: int
    decision: Decided
    votes: Sides
    input: IntArray
    layers: tuple[LayerSpikes, ...]
    membranes: tuple[Trace, ...]
    costs: object
    by_step: BySteps
    core_energy_j: Mapping[str, Mapping[str, float]] = field(metadata=HIDDEN)


@dataclass(frozen=True, slots=True, kw_only=True)
class NetlistOrigin:
    """The netlist's file, and how it was compiled."""

    file: str
    sha256: str
    compiled: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointOrigin:
    """The float network's file, and what is known of its training."""

    file: str
    sha256: str
    system: str | None
    weights: str | None
    graph: str | None
    dynamics: Mapping[str, Any] | None
    bins: int
    training: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DataOrigin:
    """The recordings, with a hash over their events and labels."""

    name: str
    split: str
    samples: int
    bin_s: float
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipOrigin:
    """The chip, and titles of its tables by name."""

    name: str
    energy_tables: Mapping[str, str]
    time_tables: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """What to type, and what for."""

    what: str = field(metadata=key("for"))
    command: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """Files and their hashes, versions, and the commands that repeat the page."""

    netlist: NetlistOrigin
    checkpoint: CheckpointOrigin
    data: DataOrigin
    chip: ChipOrigin
    versions: Mapping[str, str]
    commands: tuple[Command, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Report:
    """All that the page shows."""

    verify: Verdict
    decisions: Decisions
    netlist: Sizes
    cores: Cores
    taxels: Taxels
    recording: Recording
    costs: object
    provenance: Provenance
    stress: Stress | None = field(default=None, metadata=OPTIONAL)
    chart: Chart | None = field(default=None, metadata=OPTIONAL)
    explained_cost: Any = field(default=None, metadata=OPTIONAL)
    output: str
    described: Outcome = field(metadata=HIDDEN)
    chip: BatchParts = field(metadata=HIDDEN)
