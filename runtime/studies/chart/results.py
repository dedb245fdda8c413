"""What a chart is: networks, configurations with their figures on both splits, and the choices among them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from spikeloom.runtime.report.encode import INLINE, key
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.studies.chart.grid import Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile

FORMAT = 2
"""Of what is measured; goes up when a figure means something else."""

SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """An accuracy with its Wilson interval."""

    correct: int
    accuracy: float
    low: float
    high: float


def share(correct: int, samples: int) -> Share:
    """The share of right decisions.

    Examples
    --------
    >>> share(3, 4).accuracy
    0.75
    """
    low, high = wilson(correct, samples)
    return Share(correct=correct, accuracy=correct / samples, low=low, high=high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures(Share):
    """A configuration on one split: accuracy, float model's, equal decisions, and costs of a mean recording.

    Energy and time are by table, in joules and seconds; `step_s` is the longest step.
    """

    samples: int
    model: Share = field(metadata=key("float"))
    equal: int
    energy_j: Mapping[str, float]
    time_s: Mapping[str, float]
    step_s: Mapping[str, float]
    synaptic_operations: float
    steps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A network in one storage and layout, by the axes of the grid."""

    network: str
    target: str
    graph: str
    bits: tuple[int, ...]
    planes: int
    groups: int
    prune: bool
    fine_tuned: bool
    storage: str
    cores: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused(Configuration):
    """One that the chip refuses, and why."""

    why: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Point(Configuration):
    """One on a part of every recording: its size, its figures, and the commands that give them."""

    number: int
    window: int
    n_cores: int
    neurons: int
    synapses: int
    netlist: str
    netlist_sha256: str
    train: Figures
    test: Figures
    commands: tuple[str, ...]
    expected: float = 0.0
    front: Mapping[str, bool] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Short name: ``objects 4b 2p, latency, 50 %``."""
        layout = "" if self.cores == "cores" else f", {self.cores}"
        return f"{self.network} {self.storage}{layout}, {self.window} %"


@dataclass(frozen=True, slots=True, kw_only=True)
class ChartedNetwork:
    """A network; accuracies of its float model by window and split, and what its points are expected to reach."""

    file: NetworkFile = field(metadata=INLINE)
    model: Mapping[int, Mapping[str, Share]] = field(metadata=key("float"))
    expected: float = 0.0

    json_properties: ClassVar = ("float_training",)

    @property
    def float_training(self) -> float:
        """Accuracy of the float model on whole training recordings, or the longest parts that were measured."""
        return self.model[max(self.model)]["train"].accuracy

    @property
    def whole(self) -> Share:
        """The float model on test recordings, likewise."""
        return self.model[max(self.model)]["test"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Against:
    """A point beside another: how many times less test energy and time by table, and how much more accuracy."""

    point: int
    energy: Mapping[str, float | None]
    time: Mapping[str, float | None]
    accuracy: float
    expected: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Saving:
    """Points beside the usual mapping: `chosen` by what is expected, `seen` on the test split, which is no choice."""

    usual: int
    chosen: Against
    seen: Against


@dataclass(frozen=True, slots=True, kw_only=True)
class Pick:
    """The point that fits the budgets best, how many fit, and what it gives up beside the best.

    `misses` has the ``limit`` of each budget that it does not fit, and what was ``found``.
    """

    budgets: tuple[str, ...]
    fits: bool
    fitting: int
    point: int
    misses: Mapping[str, Mapping[str, float]]
    best: int
    given_up: Against


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Recordings: where they are, their bins, a hash over both splits, how many there are, and bins of the longest."""

    path: str
    bin_s: float
    sha256: str
    train: int
    test: int
    steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenBy:
    """Tables by which points are chosen and drawn; none for time where nothing is timed."""

    energy: str
    time: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Every configuration of a grid, and which one to deploy.

    `tables` has the titles of tables of ``energy`` and ``time`` by name.
    """

    spikeloom: str
    target: str
    command: str
    data: Data
    tables: Mapping[str, Mapping[str, str]]
    chosen_by: ChosenBy
    grid: Grid
    networks: tuple[ChartedNetwork, ...]
    expected: str
    points: tuple[Point, ...]
    refused: tuple[Refused, ...]
    recommended: Mapping[str, int | None]
    saving: Saving | None
    budget: Pick | None
    format: int = FORMAT

    def point(self, number: int) -> Point:
        """A point by its number, from 1."""
        return self.points[number - 1]

    @property
    def taken(self) -> dict[int, list[str]]:
        """Points to take by number, and what for."""
        names: dict[int, list[str]] = {}
        for name, number in self.recommended.items():
            if number is not None:
                names.setdefault(number, []).append(name)
        return names


@dataclass(frozen=True, slots=True)
class Axis:
    """A cost that accuracy is drawn over: its title, the words below the axis, the unit, and the cost of a point."""

    title: str
    words: str
    unit: str
    value: Callable[[Point], float]


def axes(chart: Chart) -> dict[str, Axis]:
    """Costs of a chart by name."""
    energy, time = chart.chosen_by.energy, chart.chosen_by.time
    found = {"energy": Axis("energy", f"energy of a mean inference ({energy})", "J", lambda p: p.test.energy_j[energy])}
    if time is not None:
        named = f"time of a mean inference on the chip ({time})"
        found["latency"] = Axis("time on the chip", named, "s", lambda point: point.test.time_s[time])
    named = "synaptic operations of a mean inference"
    found["operations"] = Axis("synaptic operations", named, "", lambda point: point.test.synaptic_operations)
    found["cores"] = Axis("cores", "cores in use", "", lambda point: float(point.n_cores))
    return found
