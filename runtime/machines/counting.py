"""What a chip offers that may hold a counting network."""

from abc import abstractmethod
from dataclasses import dataclass

from spikeloom.compiler.counters import Counters
from spikeloom.runtime.machines.base import Machine


@dataclass(frozen=True)
class Counting(Machine):
    """Says which counting network a netlist holds, if its decisions follow from numbers of events alone."""

    @property
    @abstractmethod
    def counters(self) -> Counters | None:
        """That network, or None.

        From the last event on, the membrane of a vote is its sum and the ramp. After an earlier step it is at
        most the ramp, all that weights above zero add until the end, and what those below zero added so far.
        Silent steps after the data may count as steps of data.
        """
