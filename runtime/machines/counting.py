"""What a chip offers that may hold a counting network."""

from abc import abstractmethod
from dataclasses import dataclass

from spikeloom.compiler.counters import Counters
from spikeloom.runtime.machines.base import Machine


@dataclass(frozen=True)
class Counting(Machine):
    """Says of which counting network a netlist is, so that its decisions follow from numbers of events."""

    @property
    @abstractmethod
    def counters(self) -> Counters | None:
        """Of which it is, neuron by neuron; None if of none, or if counts alone do not decide.

        After the last event the membrane of each vote is its sum, and the ramp. After an earlier step it is at
        most what weights above zero will have added in the end, less what those below had taken until then.
        Silent steps after the data count as steps of data.
        """
