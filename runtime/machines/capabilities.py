"""What some chips offer beyond :class:`machines.base.Machine`, one class for each thing that a study may need."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.loihi1.integers import IntegerNetwork
from spikeloom.compiler.targets.netlist_file import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.deviations import Deviations


@dataclass(frozen=True)
class Comparable(Machine):
    """Its layers are a float model's, neuron by neuron.

    Runs count time as the float model does, and have membranes: registers before the comparison, so that
    ``register / (scale * 2**MEMBRANE_SHIFT)`` is in the model's units. What the chip does not hold stays at
    zero.
    """

    @property
    @abstractmethod
    def integer(self) -> IntegerNetwork:
        """The netlist, cores forgotten; raises FormatError where it is no such network."""

    @property
    @abstractmethod
    def absent(self) -> tuple[BoolArray, ...]:
        """Neurons of each layer, (neurons,) bool, that the chip does not hold."""

    @property
    @abstractmethod
    def unread(self) -> tuple[BoolArray, ...]:
        """Those of them whose spikes reach no neuron, so that they cannot be compared."""

    def compared(self) -> list[slice | IntArray]:
        """Neurons of each layer whose spikes can be compared."""
        return [np.flatnonzero(~unread) if unread.any() else slice(None) for unread in self.unread]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cumulative:
    """Sums over chip steps up to and with each; after a recording's end they stay as they are.

    Votes (samples, steps, classes) are those after each step of the read-out, which lags `depth` chip steps
    behind the data; operations, joules by table and seconds by table and the simple model are (samples, chip
    steps). Tables that cannot price the run are missing, and all times for several chips.
    """

    votes: IntArray
    depth: int
    lengths: IntArray
    chip_steps: IntArray
    operations: FloatArray
    energy: Mapping[str, FloatArray]
    time: Mapping[str, FloatArray]


@dataclass(frozen=True)
class Stoppable(Machine):
    """A recording can be stopped before its end, with bounds on the votes that are still to come."""

    @property
    @abstractmethod
    def read_out_lag(self) -> int:
        """Chip steps by which the votes are behind the data."""

    @abstractmethod
    def cumulative(self, events: EventArray, lengths: IntArray) -> Cumulative:
        """Votes and costs step by step, from one run; `lengths` (samples,) are the data steps of each recording."""

    @property
    @abstractmethod
    def least_intervals(self) -> IntArray:
        """Least steps from one spike to the next of each neuron that votes, whatever its input; 0 if it never spikes.

        In the order of ``readout_class``; after :data:`LONGEST` steps nothing is looked for any more.
        """

    @property
    @abstractmethod
    def steady(self) -> BoolArray:
        """Which neurons that vote spike in every step after their first spike, in the order of ``readout_class``."""


@dataclass(frozen=True)
class Threaded(Comparable):
    """Several recordings can run side by side, a thread each."""

    @abstractmethod
    def on_a_thread(
        self, channels: EventArray, lengths: IntArray, first: int
    ) -> tuple[Iterable[BoolArray], IntArray]:
        """Spikes of each layer from the step `first` on, (samples, steps, neurons), and clipped membranes, (samples,).

        Channels (samples, channels, steps) include the clocks. Raises NumericRangeError if a register
        overflows in any recording.
        """


class Memory(ABC):
    """What a chip stores of a network, and the float network beside it: damage is done to both alike.

    The float network changes by as much in its own units, which is the same relative change up to rounding.
    Neurons are those that the chip holds, in its order; one that it does not hold stays as it is in the
    float network.
    """

    netlist: Netlist
    network: Network

    @property
    @abstractmethod
    def codes(self) -> IntArray:
        """Stored weights, (synapses,) int64, in two's complement, in steps of their format."""

    @property
    @abstractmethod
    def widths(self) -> IntArray:
        """Bits of each of them."""

    @property
    @abstractmethod
    def planes(self) -> int:
        """Stored weights that make one of the network's, at most."""

    @property
    @abstractmethod
    def thresholds(self) -> IntArray:
        """Threshold registers, (neurons,) int64."""

    @property
    @abstractmethod
    def hidden(self) -> IntArray:
        """Numbers of the neurons that neither vote nor relay a clock."""

    @property
    @abstractmethod
    def windows(self) -> bool:
        """Whether layers wait for their input."""

    @abstractmethod
    def with_codes(self, codes: IntArray) -> Self:
        """Other stored weights; where nothing changes, the float weight stays as it is, bit for bit."""

    @abstractmethod
    def with_stuck(self, neurons: IntArray, *, firing: bool) -> Self:
        """Neurons that never fire, or fire in every step, whatever reaches them; given by their numbers."""

    @abstractmethod
    def with_thresholds(self, thresholds: IntArray) -> Self:
        """Other thresholds, as far as registers hold them; those of relays stay."""

    @abstractmethod
    def with_late_layers(self, steps: int) -> Self:
        """Layers after the first open their windows so many steps late."""

    @abstractmethod
    def with_decays(self, factor: float) -> Self:
        """Membranes and lasting currents keep so much of the share that they keep."""


@dataclass(frozen=True)
class Damageable(Threaded):
    """What it stores can be damaged."""

    @abstractmethod
    def memory(self, network: Network) -> Memory:
        """What it stores, beside the float network that was compiled."""


@dataclass(frozen=True)
class Explainable(Comparable):
    """Every difference from the float network has a cause that can be named."""

    @abstractmethod
    def deviations(self, network: Network, compensated: Collection[str]) -> Deviations:
        """From the float network that was compiled; weights of `compensated` layers need not be the nearest."""


LONGEST = 4096
"""Steps after which :attr:`Stoppable.least_intervals` looks no further: a spike may follow then."""
