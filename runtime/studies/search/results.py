"""What is measured of a candidate: accuracies with intervals, costs of a mean inference, and the recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings, data_digest
from spikeloom.runtime.report.numbers import wilson


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
class Costs:
    """Of a mean inference: synaptic operations, joules and seconds by table."""

    operations: float
    energy_j: Mapping[str, float]
    time_s: Mapping[str, float]

    @classmethod
    def mean(
        cls,
        operations: IntArray | FloatArray,
        energy_j: Mapping[str, FloatArray],
        time_s: Mapping[str, FloatArray],
        **about: Any,
    ) -> Self:
        """Of recordings, from the costs of each, (samples,); `about` are the fields of a subclass."""
        return cls(
            operations=float(operations.mean()),
            energy_j={name: float(joules.mean()) for name, joules in energy_j.items()},
            time_s={name: float(seconds.mean()) for name, seconds in time_s.items()},
            **about,
        )

    @property
    def least(self) -> float:
        """Joules by the first table, or operations where no table prices them."""
        return next(iter(self.energy_j.values()), self.operations)


@dataclass(frozen=True, slots=True, kw_only=True)
class NetlistCosts(Costs):
    """The same, and the size of the netlist."""

    cores: int
    neurons: int
    synapses: int


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
    """Tables by which candidates are chosen and drawn; none for time where nothing is timed."""

    energy: str
    time: str | None

    def of(self, costs: Costs) -> dict[str, float]:
        """Costs that accuracy is held against, by name."""
        values = {"energy": costs.energy_j[self.energy]}
        return values if self.time is None else values | {"time": costs.time_s[self.time]}


def chosen_by(target: Target, energy: str | None = None) -> ChosenBy:
    """The first tables of a chip, unless one of energy is named."""
    energies = [table.name for table in target.energy]
    times = [table.name for table in target.time]
    return ChosenBy(energy=energy or energies[0], time=next(iter(times), None))


def titles_of(target: Target) -> dict[str, dict[str, str]]:
    """Titles of a chip's tables of ``energy`` and ``time``, by name."""
    energies = {table.name: table.title for table in target.energy}
    return {"energy": energies, "time": {table.name: table.title for table in target.time}}
