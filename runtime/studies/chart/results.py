"""What a chart is: configurations of networks with their figures on both splits, and the one to deploy."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from spikeloom.runtime.report.encode import HIDDEN, INLINE, OPTIONAL, key
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.chart.grid import FEWEST, Grid
from spikeloom.runtime.studies.chart.networks import NetworkFile, Storage
from spikeloom.runtime.studies.search.results import ChosenBy, Costs, Data, Share

FORMAT = 5
"""Of what is measured; goes up when a figure means something else."""

SPLITS = ("train", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures(Share):
    """A configuration on one split: accuracy, float model's, equal decisions, and costs of a mean recording."""

    samples: int
    model: Share = field(metadata=key("float"))
    equal: int
    costs: Costs = field(metadata=INLINE)
    steps: float
    conditions: Mapping[str, Share] = field(default_factory=dict)  # Accuracy in each condition
    certified: float | None = field(
        default=None, metadata=OPTIONAL
    )  # Share of some training decisions that no event alters


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
    folder: str = field(metadata=HIDDEN)
    format: int = FORMAT

    @property
    def chosen(self) -> Point:
        """The point to deploy."""
        return self.points[self.budget.point - 1]
