"""TrueNorth as a :class:`machines.base.Machine`."""

import os
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, read_crossbars
from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.runtime.machines.base import Done, Machine, Price, T
from spikeloom.runtime.machines.truenorth import cost, engine, spec
from spikeloom.runtime.machines.truenorth.spec import Trace


@dataclass(frozen=True)
class TrueNorth(Machine):
    """A netlist that breaks no rule of its chip, and its simulator."""

    netlist: CrossbarNetlist
    details = ("counts",)
    kernel = "tick by tick"

    @cached_property
    def _engine(self) -> engine.Engine:
        return engine.prepare(self.netlist)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers."""
        return self.netlist.layers

    def of_layer(self, array: npt.NDArray[T], index: int) -> npt.NDArray[T]:
        """By tick."""
        return np.asarray(array[:, :, self.netlist.layer == index])

    @property
    def weight_bits(self) -> int:
        """Axons of all types add up."""
        return 1 + int(np.abs(self.netlist.weight).sum(axis=1).max()).bit_length()

    def legal(self) -> None:
        """Refuse a netlist that breaks a rule."""
        require_legal(self.netlist, self.target)

    def simulate(
        self, channels: EventArray, lengths: IntArray | None = None, *, spikes: bool, membranes: bool = False
    ) -> Trace:
        """Spikes and membranes by tick."""
        return engine.simulate(self._engine, channels, lengths=lengths, spikes=spikes, membranes=membranes)

    def twice(self, channels: EventArray) -> tuple[Trace, Trace]:
        """Every spike, membrane, vote and spike on an axon."""
        fast = engine.simulate(self._engine, channels[None], spikes=True, membranes=True)
        return spec.simulate(self.netlist, channels), fast

    def priced(
        self, channels: EventArray, lengths: IntArray | None, chip: Target, bin_s: float, detail: str, progress: Done
    ) -> tuple[Trace, Price]:
        """By synaptic events and ticks."""
        trace = self.simulate(channels, lengths, spikes=False)
        return trace, cost.price(self.netlist, chip, trace.counts, bin_s * self.netlist.bins)

    def batch(self, steps: int) -> int:
        """Recordings whose counts are held at a time."""
        return 16

    def stream(self) -> NoReturn:
        """Whole recordings only."""
        raise OptionError(f"{self.target.title}: runs whole recordings, not bin after bin; give one for another chip")


def load(path: str | os.PathLike[str]) -> TrueNorth:
    """Read a netlist file and hold it against every rule of its chip; FormatError or CapacityError."""
    machine = TrueNorth(read_crossbars(path))
    machine.legal()
    return machine
