"""A counting network: counters of events, and whole weights from these to a sum for each class.

Its file, and the spiking network that it stands for, are in :mod:`formats.counters`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from spikeloom.compiler.dynamics import Clocks
from spikeloom.compiler.types import IntArray

BLOCK = 127
"""A counter's spike lowers its membrane by this: the largest weight that 8 bits hold beside a weight of 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counters:
    """A counting network."""

    taxels: int
    polarities: int
    classes: int
    bins: int  # Bins of the recordings that a step joins
    steps: int  # That count; whatever comes later is not looked at
    parts: int  # Equal parts of these
    ramp: int  # Silent steps after them, in which the classes are read out
    counter: IntArray  # (counters, 3) int64; channel, part, and the event at which it spikes
    weight: IntArray  # (classes, counters) int64; to the sums
    # slope, threshold: Of the sums: what each step adds to them, and where they spike
    slope: float
    threshold: float
    training: Mapping[str, Any] = field(
        default_factory=dict
    )  # JSON values: how it was made and what it reached

    @property
    def clocks(self) -> Clocks:
        """Clocks of the parts, and how long a recording is run."""
        length = self.steps + self.ramp
        if self.parts == 1:
            return Clocks(length=length)
        return Clocks(channels=self.parts, steps=-(-self.steps // self.parts), length=length)

    def trained(self, record: Mapping[str, Any]) -> Self:
        """A copy with the record of how it was trained."""
        return replace(self, training=record)
