"""What a search for the smallest network comes to."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spikeloom.runtime.report.encode import HIDDEN, INLINE, OPTIONAL
from spikeloom.runtime.report.shown import Shown
from spikeloom.runtime.studies.search.results import ChosenBy, Data, NetlistCosts, Share
from spikeloom.runtime.studies.smallest.space import Candidate
from spikeloom.runtime.studies.smallest.work import Measured


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried(Measured):
    """A candidate as far as it came: what was measured, and its accuracy by cross-validation with the Wilson interval.

    `behind` is what the best has ahead of it on the same recordings, with its standard error. It is on the
    `front` if no other one that came as far is cheaper and as accurate.
    """

    number: int
    candidate: Candidate = field(metadata=INLINE)
    rung: int
    accuracy: float
    low: float
    high: float
    right: tuple[int, ...] = field(metadata=HIDDEN)
    tried: tuple[int, ...] = field(metadata=HIDDEN)
    behind: float = 0.0
    behind_error: float = 0.0
    front: bool = False
    # Whether the last epochs still helped it, of networks that are trained by gradients; None where that is not known
    finished: bool | None = field(default=None, metadata=OPTIONAL)
    # Their accuracy after numbers of epochs, on the folds of each rung
    curve: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Numbers of candidates: the best that the budgets allow, the cheapest not shown to be worse, by each table.

    If nothing `fits` the budgets, the one that misses by the smallest factor. `ahead` is the cheapest
    candidate that is a point more accurate, `cheaper` the most accurate for two thirds of the energy.
    """

    budgets: tuple[str, ...]
    fits: bool
    best: int
    cheapest: Mapping[str, int]
    allowed: tuple[int, ...]
    ahead: int | None
    cheaper: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Candidates of one system: how many were `tried`, the `best` of those that came farthest, by its number.

    They were `finished` if some were cross-validated to the end, and none was still learning then.
    """

    system: str
    tried: int
    best: int
    finished: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """The choice, trained on the whole training split: its files, and float model beside chip on both splits.

    `different` are spikes in the recordings of ``train`` and ``test``; `right` is the chip's on the test
    split, which nothing else has looked at. `pace` says which term of the energy is the larger at the pace
    of the sensor.
    """

    network: str
    network_sha256: str
    netlist: str
    netlist_sha256: str
    different: Mapping[str, int]
    right: Share
    costs: NetlistCosts
    stopped: NetlistCosts | None
    pace: str


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Smallest(Shown):
    """A search, its choice and what that reaches.

    `conditions` were left out in turn; `at_random` is the accuracy of the choice where parts at random were left out.
    For candidates that are `untried`, by name, time was too short.
    """

    spikeloom: str
    command: str
    target: str
    data: Data
    tables: Mapping[str, Mapping[str, str]]
    chosen_by: ChosenBy
    conditions: tuple[str, ...]
    tried: tuple[Tried, ...]
    untried: tuple[str, ...]
    baselines: tuple[Tried, ...]
    choice: Choice
    at_random: float | None
    families: tuple[Family, ...]
    checked: Checked
    commands: tuple[str, ...]

    def candidate(self, number: int) -> Tried:
        """By its number, from 1."""
        return self.tried[number - 1]

    @property
    def chosen(self) -> Tried:
        """The choice by the first table."""
        return self.candidate(self.choice.cheapest[self.chosen_by.energy])
