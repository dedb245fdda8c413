"""What a run costs: events, energies and simple times, added up in the run; in detail ``cycle`` also detailed times.

Every message is scheduled for these, and energy is told by core. Spikes are the same in both details.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.injection import input_events
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost, timing
from spikeloom.runtime.machines.loihi1.costs.cost import Costs, Meter
from spikeloom.runtime.machines.loihi1.costs.timing import (
    DetailedSpent,
    DetailedTimes,
    SimpleSpent,
    SimpleTimes,
)
from spikeloom.runtime.machines.loihi1.costs.timing_kernel import Tables
from spikeloom.runtime.machines.loihi1.trace import Charges, Trace, side_by_side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Totals:
    """What is kept of recordings that were run.

    Amounts of events by layer, and in detail ``cycle`` by core, (samples, groups); events and clock ticks that come
    in, (samples,); steps at the sensor's pace, blank ones too, and steps of the chip; times by table.
    """

    amounts: Mapping[str, FloatArray]
    by_core: Mapping[str, FloatArray]
    inputs: IntArray
    steps: IntArray
    chip_steps: IntArray
    simple: Mapping[str, SimpleSpent]
    detailed: Mapping[str, DetailedSpent]

    def costs(self, target: Target) -> Costs:
        """Events and energies by layer."""
        return cost.costs_of(target, self.amounts, self.chip_steps)

    def core_energies(self, target: Target) -> Mapping[str, FloatArray]:
        """Joules by table and core, (samples, cores); none where updates were not counted by core."""
        return cost.costs_of(target, self.by_core, self.chip_steps).energy if self.by_core else {}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Costs of a batch of recordings: what is kept of them, times of each step by table, detailed ones in ``cycle``."""

    target: Target
    totals: Totals
    simple: Mapping[str, SimpleTimes]
    detailed: Mapping[str, DetailedTimes]

    @property
    def costs(self) -> Costs:
        """Events and energies by layer."""
        return self.totals.costs(self.target)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimator:
    """A netlist and a chip's tables, prepared for batches of recordings by :func:`prepare`."""

    engine: engine.Engine
    target: Target
    deep: bool
    latencies: Mapping[str, Tables]
    charges: Charges | None
    meter: Meter
    core_meter: Meter

    def estimate(self, events: EventArray, lengths: IntArray | None) -> tuple[Trace, Estimate]:
        """Run a batch; see :func:`estimate`."""
        netlist = self.engine.netlist
        steps = np.full(len(events), events.shape[2]) if lengths is None else np.asarray(lengths, np.int64)
        chip_steps = steps + netlist.drain
        trace = engine.simulate(
            self.engine, events, lengths=steps, spikes=self.deep, updated=self.deep, charges=self.charges
        )
        sums = [] if trace.charged is None else np.split(trace.charged, len(self.latencies), axis=2)
        simple = {
            name: timing.simple_times(tables, charged, chip_steps)
            for (name, tables), charged in zip(self.latencies.items(), sums, strict=True)
        }
        detailed = {}
        by_core = {}
        if trace.spikes is not None and trace.updated is not None:
            within = np.arange(events.shape[2]) < steps[:, None, None]
            run = trace.spikes, trace.updated, events * within
            for name, tables in self.latencies.items():
                detailed[name] = timing.detailed(tables, *run, steps=chip_steps)
            updates = cost.updates_by_core(netlist, trace.updated)
            by_core = cost.count(self.core_meter, replace(trace.counts, updates=updates), chip_steps)
        cores = netlist.n_cores
        totals = Totals(
            amounts=cost.count(self.meter, trace.counts, chip_steps),
            by_core=by_core,
            inputs=input_events(events, steps),
            steps=steps + netlist.blank,
            chip_steps=chip_steps,
            simple={name: times.spent(cores) for name, times in simple.items()},
            detailed={name: times.spent(cores) for name, times in detailed.items()},
        )
        kept = Trace(counts=trace.counts, spikes=None, membranes=None)
        return kept, Estimate(target=self.target, totals=totals, simple=simple, detailed=detailed)


def prepare(prepared: engine.Engine, target: Target, detail: str) -> Estimator:
    """Look up what events cost; OptionError if several chips shall be simulated by the cycle."""
    netlist = prepared.netlist
    deep = detail == "cycle"
    if deep:
        require_one_chip(netlist.core_tile, target, "--detail cycle")
    latencies = timing.tables_of(netlist, target)
    return Estimator(
        engine=prepared,
        target=target,
        deep=deep,
        latencies=latencies,
        charges=side_by_side([timing.charges(each) for each in latencies.values()]) if latencies else None,
        meter=cost.prepare(netlist, target),
        core_meter=cost.prepare(netlist, target, "core"),
    )


def estimate(
    netlist: Netlist | engine.Engine,
    target: Target,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    detail: str = "counts",
) -> tuple[Trace, Estimate]:
    """Run a batch of recordings, and say what they cost.

    `events` are (samples, n_inputs, T), `lengths` (samples,) the data steps of each, `detail` is ``counts``
    or ``cycle``. The trace holds counts alone.

    DataError and NumericRangeError as the engine says; OptionError if several chips shall be simulated by
    the cycle. Their events are counted and priced but not timed: links between chips have no public latency.
    """
    prepared = netlist if isinstance(netlist, engine.Engine) else engine.prepare(netlist)
    return prepare(prepared, target, detail).estimate(events, lengths)
