"""Loihi 1 as a :class:`machines.base.Machine`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.compiler.targets.base import with_tables
from spikeloom.compiler.targets.loihi1.legalize import measure, require_legal
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.runtime.machines.base import BoolArray, EventArray, Machine, Price, Run
from spikeloom.runtime.machines.loihi1 import description, engine
from spikeloom.runtime.machines.loihi1.blocks import obstacle
from spikeloom.runtime.machines.loihi1.stream import Stream, open_stream
from spikeloom.runtime.machines.loihi1.trace import aligned
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.sections import Outcome

SUMS = 1 << 24
"""Sums of the time model that are held at a time: 128 MiB."""


@dataclass(frozen=True)
class Loihi(Machine):
    """A netlist and its simulator."""

    netlist: Netlist
    details = ("counts", "cycle")

    @cached_property
    def _engine(self) -> engine.Engine:
        return engine.prepare(self.netlist)

    @cached_property
    def _stepwise(self) -> engine.Engine:
        """Shared by all streams."""
        return engine.prepare(self.netlist, stepwise=True)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers."""
        return tuple(layer.name for layer in self.netlist.layers)

    @property
    def kernel(self) -> str:
        """Which kernel the engine takes."""
        found = obstacle(self.netlist)
        return "layer by layer, 64 neurons at a time" if found is None else f"step by step: {found}"

    def legal(self) -> None:
        """Refuse a netlist that uses too much of a limit."""
        require_legal(self.netlist, self.target)

    def run(
        self, events: EventArray, *, lengths: IntArray | None = None, spikes: bool = False, threads: int | None = None
    ) -> Run:
        """Decisions, and spikes as the float model counts time."""
        channels = with_clocks(events, self.netlist.clocks)
        trace = engine.simulate(self._engine, channels, lengths=lengths, spikes=spikes, threads=threads)
        return self._run(trace.counts.spikes, trace.spikes)

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
        """Decisions and costs, of the cores' tiles and times too."""
        from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
        from spikeloom.runtime.machines.loihi1.costs.result import cost_report
        from spikeloom.runtime.machines.loihi1.costs.sections import sections

        self.require_detail(detail)
        chip = self.target if table is None else with_tables(self.target, table)
        shape = len(events), events.shape[-1] + self.netlist.max_depth, self.netlist.n_compartments
        kept = np.zeros(shape, np.bool_) if spikes else None
        counts, found = estimate(
            self.netlist,
            chip,
            with_clocks(events, self.netlist.clocks),
            lengths=lengths,
            detail=detail,
            spikes=kept,
            progress=progress,
        )
        report = cost_report(self.netlist, chip, found, bin_s=bin_s * self.netlist.bins)
        return self._run(counts.spikes, kept), Price(
            synaptic_operations=found.costs.synaptic_operations.sum(axis=1),
            energy_j={name: each.sum(axis=1) for name, each in found.costs.energy.items()},
            time_s={name: times.duration_ns.sum(axis=1) * 1e-9 for name, times in found.simple.items()},
            step_s={name: float(times.duration_ns.max() * 1e-9) for name, times in found.simple.items()},
            outcome=Outcome(report, sections),
        )

    def batch(self, steps: int) -> int:
        """As many recordings as keep the sums of the time model small."""
        held = (steps + self.netlist.max_depth) * 2 * self.netlist.n_cores * max(1, len(self.target.time))
        return max(1, SUMS // held)

    def describe(self, sha256: str) -> Outcome:
        """Layers, scales, cores, and the fill of every limit."""
        facts = description.describe(self.netlist, measure(self.netlist, self.target), sha256)
        return Outcome(facts, description.sections)

    def stream(self) -> Stream:
        """One grasp, bin after bin."""
        return open_stream(self._stepwise)

    def _run(self, counts: IntArray, spikes: BoolArray | None) -> Run:
        layers = self.netlist.layers
        held = (
            None if spikes is None else {each.name: aligned(self.netlist, spikes, i) for i, each in enumerate(layers)}
        )
        return Run(votes=class_counts(self.netlist, counts), spikes=held)


machine_of = Loihi


def load(path: str | os.PathLike[str]) -> Loihi:
    """Read a netlist file.

    Raises
    ------
    FormatError
        As :func:`netlist_file.read_netlist` does.
    """
    return Loihi(read_netlist(path))
