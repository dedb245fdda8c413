"""TrueNorth as a :class:`machines.base.Machine`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.targets.base import with_tables
from spikeloom.compiler.targets.truenorth.legalize import require_legal
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.targets.truenorth.netlist_file import read_crossbars
from spikeloom.runtime.machines.base import EventArray, Machine, Price, Run
from spikeloom.runtime.machines.truenorth import cost, engine
from spikeloom.runtime.machines.truenorth.describe import describe
from spikeloom.runtime.machines.truenorth.trace import Trace
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.sections import Outcome

TICK = "tick"
"""Name of the one time table: every tick takes the same time, whatever happens in it."""


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

    def legal(self) -> None:
        """Refuse a netlist that breaks a rule."""
        require_legal(self.netlist, self.target)

    def run(
        self, events: EventArray, *, lengths: IntArray | None = None, spikes: bool = False, threads: int | None = None
    ) -> Run:
        """Decisions, and spikes by tick; one recording runs at a time, whatever `threads` says."""
        return self._run(self._simulate(events, lengths, spikes=spikes))

    def price(
        self,
        events: EventArray,
        *,
        bin_s: float,
        lengths: IntArray | None = None,
        detail: str = "counts",
        table: str | None = None,
        spikes: bool = False,
        progress: Callable[[int], object] | None = None,
    ) -> tuple[Run, Price]:
        """Decisions and costs."""
        self.require_detail(detail)
        chip = self.target if table is None else with_tables(self.target, table)
        trace = self._simulate(events, lengths, spikes=spikes)
        found = cost.estimate(self.netlist, chip, trace.counts)
        return self._run(trace), Price(
            synaptic_operations=found.synaptic_events.sum(axis=1),
            energy_j={name: each.total_j for name, each in found.energy.items()},
            time_s={TICK: found.time_s},
            step_s={TICK: self.netlist.bin_ticks * chip.limit("tick.length") * 1e-6},
            outcome=cost.summarise(self.netlist, chip, found, trace.counts, bin_s),
        )

    def batch(self, steps: int) -> int:
        """Recordings whose counts are held at a time."""
        return 16

    def describe(self, sha256: str) -> Outcome:
        """Sizes, layers, and the fullest core by each limit."""
        return describe(self.netlist, self.target, sha256)

    def stream(self) -> NoReturn:
        """Whole recordings only."""
        raise OptionError(
            f"{self.target.title}: runs whole recordings, not bin after bin; give a netlist for another chip"
        )

    def _simulate(self, events: EventArray, lengths: IntArray | None, *, spikes: bool) -> Trace:
        return engine.simulate(self._engine, with_clocks(events, self.netlist.clocks), lengths=lengths, spikes=spikes)

    def _run(self, trace: Trace) -> Run:
        layer, spikes = self.netlist.layer, trace.spikes
        return Run(
            votes=class_counts(self.netlist, trace.counts.votes),
            spikes=None
            if spikes is None
            else {name: spikes[:, :, layer == index] for index, name in enumerate(self.netlist.layers)},
        )


machine_of = TrueNorth


def load(path: str | os.PathLike[str]) -> TrueNorth:
    """Read a netlist file and hold it against every rule of its chip.

    Raises
    ------
    FormatError, CapacityError
        If it is no such file, or breaks a rule.
    """
    machine = TrueNorth(read_crossbars(path))
    machine.legal()
    return machine
