"""What ``lean`` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from spikeloom.runtime.report.encode import INLINE, OPTIONAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Of a mean inference, and the size of the netlist; joules and seconds by table."""

    operations: float
    energy_j: Mapping[str, float]
    time_s: Mapping[str, float]
    cores: int
    neurons: int
    synapses: int

    @property
    def least(self) -> float:
        """Joules by the first table, or operations where no table prices them."""
        return next(iter(self.energy_j.values()), self.operations)


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed:
    """What is taken away: hops and taxels by number, neurons of each layer; or how many bins are joined."""

    hops: tuple[int, ...] | None = field(default=None, metadata=OPTIONAL)
    taxels: tuple[int, ...] | None = field(default=None, metadata=OPTIONAL)
    neurons: Mapping[str, int] | None = field(default=None, metadata=OPTIONAL)
    bins: int | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """Training decisions that differ from those of the whole network, and right ones."""

    differ: int
    right: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Tested:
    """The same of the reported split; decisions that become right or wrong."""

    differ: int
    right: int
    gained: int
    lost: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The network without something."""

    name: str
    removed: Removed
    training: Changed
    test: Tested
    costs: Costs = field(metadata=INLINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A checkpoint on the chip, one of several."""

    costs: Costs = field(metadata=INLINE)
    name: str
    graph: str | None
    training_operations: float
    training_right: int
    test_right: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Recordings of each split."""

    training: int
    test: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerUse:
    """Neurons of a layer: of the model, on the chip, and of these the ones that never fired in training."""

    name: str
    neurons: int
    on_chip: int
    never_fired: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TaxelUse:
    """Training events of a taxel, and decisions that change without it."""

    events: int
    training_differ: int
    test_differ: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Lean:
    """What a network can do without.

    `taken` is the row of least energy in training among those that change few enough decisions; `overflowing` were not
    tried, since a register could overflow. `chosen` is one of the `candidates`, of which there are none where only one
    network was given.
    """

    taken: int
    samples: Samples
    layers: tuple[LayerUse, ...]
    taxels: tuple[TaxelUse, ...]
    rows: tuple[Row, ...]
    overflowing: tuple[str, ...]
    source: str
    split: str
    differ: float
    candidates: tuple[Candidate, ...]
    chosen: str
    output: str | None
