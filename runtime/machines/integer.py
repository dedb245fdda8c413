"""Chips whose netlist reads back as the integer network that the float model became, neuron by neuron."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.base import Machine, Price
from spikeloom.runtime.machines.core_map import CoreMap
from spikeloom.runtime.report.sections import Block


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cumulative:
    """Sums over chip steps up to and with each; after a recording's end they stay as they are.

    Votes (samples, steps, classes) are those after each step of the read-out, which lags `depth` chip steps behind the
    data; operations, joules by table and seconds by table and the simple model are (samples, chip steps). Tables that
    cannot price the run are missing, and all times for several chips.
    """

    votes: IntArray
    depth: int
    lengths: IntArray
    chip_steps: IntArray
    operations: FloatArray
    energy: Mapping[str, FloatArray]
    time: Mapping[str, FloatArray]


@dataclass(frozen=True)
class IntegerMachine(Machine):
    """A machine that can be compared with the float model: its layers are the model's, and so are their neurons.

    Its runs count time as the float model does, and have membranes: registers before the comparison, so that ``register
    / (scale * 2**MEMBRANE_SHIFT)`` is in the model's units. What the chip does not hold stays at zero.
    """

    @cached_property
    @abstractmethod
    def integer(self) -> IntegerNetwork:
        """The netlist, cores forgotten; raises FormatError where it is no such network."""

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

    @abstractmethod
    def on_a_thread(self, channels: EventArray, lengths: IntArray, first: int) -> tuple[Iterable[BoolArray], IntArray]:
        """Spikes of each layer from the step `first` on, (samples, steps, neurons), and clipped membranes, (samples,).

        Channels (samples, channels, steps) include the clocks. Raises NumericRangeError if a register overflows in any
        recording.
        """

    @abstractmethod
    def core_map(self, events: EventArray, lengths: IntArray, counts: IntArray) -> CoreMap:
        """Where the cores lie, and their traffic in recordings that gave these ``counts`` of a :class:`Run`."""

    @abstractmethod
    def figures(self, price: Price) -> list[Block]:
        """What a price looks like, for the page of the netlist."""

    @property
    def free_running(self) -> bool:
        """Whether nobody resets the chip: layers have no windows, and blank steps follow a recording."""
        return bool(self.netlist.blank)

    @property
    @abstractmethod
    def blank_due(self) -> int:
        """Blank steps after which a free-running chip forgets no more; 0 for others."""

    @abstractmethod
    def in_a_row(self, events: EventArray, lengths: IntArray | None) -> IntArray:
        """Votes (samples, classes) of recordings that follow each other on a free-running chip, as for :meth:`run`."""

    def require_windows(self) -> None:
        """Refuse a free-running netlist: an OptionError."""
        if self.free_running:
            raise OptionError("netlist: is free-running, which this cannot take; compile it without --free-running")

    @property
    def absent(self) -> tuple[BoolArray, ...]:
        """Neurons of each layer, (neurons,) bool, that the chip does not hold."""
        return tuple(
            ~np.isin(np.arange(layer.neurons), self.netlist.neuron[self.netlist.compartments_of(index)])
            for index, layer in enumerate(self.netlist.layers)
        )

    @property
    def unread(self) -> tuple[BoolArray, ...]:
        """Those of them that were left out because their spikes reach no neuron: their spikes cannot be compared."""
        return tuple(np.isin(np.arange(layer.neurons), layer.unread) for layer in self.netlist.layers)

    @property
    def received(self) -> BoolArray:
        """Input channels, (channels,) bool, that some core takes in."""
        return np.asarray(np.isin(np.arange(self.netlist.n_inputs), self.netlist.axon_source))

    @property
    def read_out_lag(self) -> int:
        """Chip steps by which the votes are behind the data: the depth of the latest layer that votes."""
        voting = np.unique(self.netlist.layer[self.netlist.readout_class >= 0])
        return max(int(self.netlist.layers[layer].depth) for layer in voting.tolist())

    def compared(self) -> list[slice | IntArray]:
        """Neurons of each layer whose spikes can be compared."""
        return [np.flatnonzero(~unread) if unread.any() else slice(None) for unread in self.unread]


LONGEST = 4096
"""Steps after which :attr:`IntegerMachine.least_intervals` looks no further: a spike may follow then."""


def integer_machine(machine: Machine, path: str = "netlist", command: str = "this command") -> IntegerMachine:
    """The same machine, if a float model can be compared with it; else an OptionError, which names file and command."""
    if not isinstance(machine, IntegerMachine):
        title = machine.target.title
        raise OptionError(f"{path}: is for {title}, which {command} does not take; give one for another chip")
    return machine
