"""What a chart is: configurations of networks with their figures on both splits, and the one to deploy."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from spikeloom.models.recordings.evtouch import Recordings, data_digest
from spikeloom.runtime.report.encode import INLINE, key
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.chart.grid import FEWEST, Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile, Storage

FORMAT = 3
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

    >>> share(3, 4).accuracy
    0.75
    """
    low, high = wilson(correct, samples)
    return Share(correct=correct, accuracy=correct / samples, low=low, high=high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures(Share):
    """A configuration on one split: accuracy, float model's, equal decisions, and costs of a mean recording."""

    samples: int
    model: Share = field(metadata=key("float"))
    equal: int
    energy_j: Mapping[str, float]  # By table
    time_s: Mapping[str, float]  # By table
    synaptic_operations: float
    steps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A network in one storage and layout, by the axes of the grid."""

    network: str
    stored: Storage = field(metadata=INLINE)
    cores: str

    json_properties: ClassVar = ("storage",)

    @property
    def storage(self) -> str:
        """In short: ``4b 2p``."""
        return self.stored.label()


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
    expected: float = 0.0  # Accuracy, see `study.with_expectations`
    front: Mapping[str, bool] = field(default_factory=dict)  # Of test accuracy and each cost

    @property
    def label(self) -> str:
        """Short name: ``objects 4b 2p, fc1:6, 50 %``."""
        layout = "" if self.cores == FEWEST else f", {self.cores}"
        return f"{self.network} {self.storage}{layout}, {self.window} %"


@dataclass(frozen=True, slots=True, kw_only=True)
class Pick:
    """The number of the point to deploy, and how many points fit the budgets; if none `fits`, the nearest one."""

    budgets: tuple[str, ...]
    fits: bool
    fitting: int
    point: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Data:
    """Recordings: where they are, their bins, a hash over both splits, how many there are, and bins of the longest."""

    path: str
    bin_s: float
    sha256: str
    train: int
    test: int
    steps: int


def data_of(path: str, bin_s: float, training: Recordings, test: Recordings) -> Data:
    """The recordings of both splits; their bins are of the test split, of which a chart observes parts."""
    sizes = {"train": len(training), "test": len(test), "steps": test.steps}
    return Data(path=path, bin_s=bin_s, sha256=data_digest(training, test), **sizes)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenBy:
    """Tables by which points are chosen and drawn; none for time where nothing is timed."""

    energy: str
    time: str | None

    def costs(self) -> dict[str, Callable[[Figures], float]]:
        """Costs that accuracy is held against, by name: what gives them of figures."""
        found: dict[str, Callable[[Figures], float]] = {"energy": lambda figures: figures.energy_j[self.energy]}
        if (time := self.time) is not None:
            found["time"] = lambda figures: figures.time_s[time]
        return found


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Chart(Shown):
    """Every configuration of a grid, and which one to deploy."""

    spikeloom: str
    target: str
    command: str
    data: Data
    tables: Mapping[str, Mapping[str, str]]  # Titles of tables of ``energy`` and ``time``, by name
    chosen_by: ChosenBy
    grid: Grid
    networks: tuple[NetworkFile, ...]
    points: tuple[Point, ...]
    refused: tuple[Refused, ...]
    budget: Pick
    format: int = FORMAT

    @property
    def chosen(self) -> Point:
        """The point to deploy."""
        return self.points[self.budget.point - 1]
