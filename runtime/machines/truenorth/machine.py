"""TrueNorth as a :class:`machines.base.Machine`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import with_tables
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, read_crossbars
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.base import EventArray, Machine, Price, Run, T, one_by_one
from spikeloom.runtime.machines.truenorth import cost, engine, spec
from spikeloom.runtime.machines.truenorth.spec import Trace, differences


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
        of_layer: npt.NDArray[T] = array[:, :, self.netlist.layer == index]
        return of_layer

    def legal(self) -> None:
        """Refuse a netlist that breaks a rule."""
        require_legal(self.netlist, self.target)

    def run(
        self,
        events: EventArray,
        *,
        lengths: IntArray | None = None,
        spikes: bool = False,
        membranes: bool = False,
    ) -> Run:
        """Decisions, and spikes by tick."""
        trace = self.simulate(events, lengths, spikes=spikes, membranes=membranes)
        return self._run(trace, trace.counts.votes)

    def check(self, events: EventArray, *, lengths: IntArray | None = None) -> int:
        """Every spike, membrane, vote and spike on an axon, one recording after another."""
        found = 0
        for sample in one_by_one(with_clocks(events, self.netlist.clocks), lengths):
            fast = engine.simulate(self._engine, sample[None], spikes=True, membranes=True)
            found += differences(spec.simulate(self.netlist, sample), fast)
        return found

    def price(
        self,
        events: EventArray,
        *,
        bin_s: float,
        lengths: IntArray | None = None,
        detail: str = "counts",
        table: str | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> tuple[Run, Price]:
        """Decisions and costs."""
        self.require_detail(detail)
        chip = self.target if table is None else with_tables(self.target, table)
        trace = self.simulate(events, lengths, spikes=False)
        return self._run(trace, trace.counts.votes), cost.price(self.netlist, chip, trace.counts, bin_s)

    def batch(self, steps: int) -> int:
        """Recordings whose counts are held at a time."""
        return 16

    def stream(self) -> NoReturn:
        """Whole recordings only."""
        raise OptionError(
            f"{self.target.title}: runs whole recordings, not bin after bin; give a netlist for another chip"
        )

    def simulate(
        self, events: EventArray, lengths: IntArray | None = None, *, spikes: bool, membranes: bool = False
    ) -> Trace:
        """Everything that the engine counts and keeps; see :meth:`run`."""
        channels = with_clocks(events, self.netlist.clocks)
        return engine.simulate(self._engine, channels, lengths=lengths, spikes=spikes, membranes=membranes)


machine_of = TrueNorth


def load(path: str | os.PathLike[str]) -> TrueNorth:
    """Read a netlist file and hold it against every rule of its chip; FormatError or CapacityError."""
    machine = TrueNorth(read_crossbars(path))
    machine.legal()
    return machine
