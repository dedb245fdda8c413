"""What a run costs: events, energies and simple times, added up in the run; in detail ``cycle`` also detailed times.

Every message is scheduled for these, and energy is told by core. Spikes are the same in both details.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.base import Done
from spikeloom.runtime.machines.injection import input_events
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.costs import cost, timing
from spikeloom.runtime.machines.loihi1.costs.cost import Costs
from spikeloom.runtime.machines.loihi1.costs.timing import DetailedTimes, SimpleTimes
from spikeloom.runtime.machines.loihi1.trace import Counts, Trace, side_by_side

T = TypeVar("T", Counts, SimpleTimes, DetailedTimes)

HELD = 1 << 27
"""Bytes of spikes and updates, or of sums of the time model, that are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Costs of a batch of recordings.

    Events and energies by layer; events and clock ticks that come in, (samples,); steps at the sensor's pace,
    blank ones too; times by table; and, in detail ``cycle`` only, detailed times and joules by table and core.
    """

    costs: Costs
    inputs: IntArray
    steps: IntArray
    simple: Mapping[str, SimpleTimes]
    detailed: Mapping[str, DetailedTimes]
    cores: Mapping[str, FloatArray]


def estimate(
    netlist: Netlist | engine.Engine,
    target: Target,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    detail: str = "counts",
    progress: Done = None,
) -> tuple[Trace, Estimate]:
    """Run recordings, some at a time, and say what they cost.

    `events` are (samples, n_inputs, T), `lengths` (samples,) the data steps of each, `detail` is ``counts``
    or ``cycle``; `progress` is called with the number of recordings done. The trace holds counts alone.

    DataError and NumericRangeError as the engine says; OptionError if several chips shall be simulated by
    the cycle. Their events are counted and priced but not timed: links between chips have no public latency.
    """
    prepared = netlist if isinstance(netlist, engine.Engine) else engine.prepare(netlist)
    netlist = prepared.netlist
    deep = detail == "cycle"
    if deep:
        require_one_chip(netlist.core_tile, target, "--detail cycle")
    latencies = timing.tables_of(netlist, target)
    charges = side_by_side([timing.charges(each) for each in latencies.values()]) if latencies else None
    steps = np.full(len(events), events.shape[2]) if lengths is None else np.asarray(lengths, np.int64)
    chip_steps = steps + netlist.drain
    simple: dict[str, list[SimpleTimes]] = {name: [] for name in latencies}
    detailed: dict[str, list[DetailedTimes]] = {name: [] for name in latencies if deep}
    counts = []
    updates = []
    charged_by = 0 if charges is None else charges.sources.shape[1]
    entries = 2 * netlist.n_compartments if deep else 8 * max(1, charged_by)
    size = max(1, HELD // (entries * (events.shape[2] + netlist.drain)))
    for first in range(0, max(1, len(events)), size):
        part = slice(first, first + size)
        trace = engine.simulate(
            prepared, events[part], lengths=steps[part], spikes=deep, updated=deep, charges=charges
        )
        counts.append(trace.counts)
        sums = [] if trace.charged is None else np.split(trace.charged, len(latencies), axis=2)
        for (name, tables), charged in zip(latencies.items(), sums, strict=True):
            simple[name].append(timing.simple_times(tables, charged, chip_steps[part]))
        if trace.spikes is not None and trace.updated is not None:
            updates.append(cost.updates_by_core(netlist, trace.updated))
            within = np.arange(events.shape[2]) < steps[part, None, None]
            run = trace.spikes, trace.updated, events[part] * within
            for name, times in detailed.items():
                times.append(timing.detailed(latencies[name], *run, steps=chip_steps[part]))
        if progress is not None:
            progress(min(first + size, len(events)))
    whole = _joined(Counts, counts)
    by_core = replace(whole, updates=np.concatenate(updates)) if deep else None
    return Trace(counts=whole, spikes=None, membranes=None), Estimate(
        costs=cost.price(cost.prepare(netlist, target), whole, chip_steps),
        inputs=input_events(events, steps),
        steps=steps + netlist.blank,
        simple={name: _joined(SimpleTimes, times) for name, times in simple.items()},
        detailed={name: _joined(DetailedTimes, times) for name, times in detailed.items()},
        cores=_core_energies(netlist, target, by_core, chip_steps),
    )


def _core_energies(
    netlist: Netlist, target: Target, by_core: Counts | None, chip_steps: IntArray
) -> Mapping[str, FloatArray]:
    """Joules of each core, where updates were counted by core."""
    if by_core is None:
        return {}
    return cost.price(cost.prepare(netlist, target, "core"), by_core, chip_steps).energy


def _joined(kind: type[T], parts: Sequence[T]) -> T:
    """One dataclass of arrays from those of some recordings each."""
    return kind(
        **{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(kind)}
    )
