"""What a run costs: events, energies and simple times, added up in the run; in detail ``cycle`` also detailed times.

Every message is scheduled for these, and energy is told by core. Spikes are the same in both details.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_count, require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1 import engine, timing
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.cost import Costs
from spikeloom.runtime.machines.loihi1.timing import DetailedTimes, SimpleTimes
from spikeloom.runtime.machines.loihi1.trace import Counts, side_by_side

PART = 16
"""Recordings whose spikes are kept at a time in detail ``cycle``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Costs of a batch of recordings.

    Events and energies by layer; data steps; times by table; and, in detail ``cycle`` only, detailed times and joules
    by table and core.
    """

    costs: Costs
    steps: IntArray
    simple: Mapping[str, SimpleTimes]
    detailed: Mapping[str, DetailedTimes]
    cores: Mapping[str, FloatArray]


def estimate(
    netlist: Netlist,
    target: Target,
    events: engine.EventArray,
    *,
    lengths: IntArray | None = None,
    detail: str = "counts",
    spikes: BoolArray | None = None,
    progress: Callable[[int], object] | None = None,
) -> tuple[Counts, Estimate]:
    """Run recordings and say what they cost.

    `events` are (samples, n_inputs, T), `lengths` (samples,) the data steps of each, `detail` is ``counts`` or
    ``cycle``; `spikes` (samples, chip steps, compartments) bool is filled, `progress` called with the recordings done.

    Raises
    ------
    DataError, NumericRangeError
        As the engine says.
    OptionError
        If several chips shall be simulated by the cycle. Their events are counted and priced but not timed: links
        between chips have no public latency.
    """
    if detail == "cycle":
        require_one_chip(netlist.core_tile, target, "--detail cycle")
    timed = target.time if chip_count(netlist.core_tile, target) == 1 else ()
    latencies = {table.name: timing.prepare(netlist, target, table) for table in timed}
    charges = side_by_side([timing.charges(each) for each in latencies.values()]) if latencies else None
    prepared = engine.prepare(netlist, charges=charges)
    steps = np.full(len(events), events.shape[2]) if lengths is None else np.asarray(lengths, np.int64)
    detailed: dict[str, DetailedTimes] = {}
    if detail == "cycle":
        counts, charged, detailed, updates = _deep(prepared, latencies, events, steps, spikes, progress)
    else:
        trace = engine.simulate(prepared, events, lengths=steps, spikes=spikes is not None)
        counts, charged = trace.counts, trace.charged
        if spikes is not None:
            spikes[:] = trace.spikes
    chip_steps = steps + netlist.max_depth
    sums = [] if charged is None else np.split(charged, len(latencies), axis=2)
    simple = {
        name: timing.simple_times(each, own, chip_steps)
        for (name, each), own in zip(latencies.items(), sums, strict=True)
    }
    cores: Mapping[str, FloatArray] = {}
    if detail == "cycle":
        by_core = replace(counts, updates=updates)
        cores = cost.estimate(cost.prepare(netlist, target, "core"), by_core, chip_steps).energy
    costs = cost.estimate(cost.prepare(netlist, target), counts, chip_steps)
    return counts, Estimate(costs=costs, steps=steps, simple=simple, detailed=detailed, cores=cores)


def _deep(
    prepared: engine.Engine,
    latencies: Mapping[str, timing.Latencies],
    events: engine.EventArray,
    steps: IntArray,
    spikes: BoolArray | None,
    progress: Callable[[int], object] | None,
) -> tuple[Counts, IntArray | None, dict[str, DetailedTimes], IntArray]:
    """Counts, charges, detailed times and updates of each core; some recordings at a time, as their spikes are kept."""
    found: dict[str, list[DetailedTimes]] = {name: [] for name in latencies}
    counts, charged, updates = [], [], []
    for first in range(0, len(events), PART):
        part = slice(first, first + PART)
        trace = engine.simulate(prepared, events[part], lengths=steps[part], spikes=True, updated=True)
        assert trace.spikes is not None, "spikes were wanted"
        assert trace.updated is not None, "updates were wanted"
        counts.append(trace.counts)
        charged += [] if trace.charged is None else [trace.charged]
        updates.append(cost.updates_by_core(prepared.netlist, trace.updated))
        own = steps[part] + prepared.netlist.max_depth
        given = events[part] * (np.arange(events.shape[2]) < steps[part, None, None])  # nothing after a recording's end
        for name, each in latencies.items():
            found[name].append(timing.detailed(each, trace.spikes, trace.updated, given, steps=own))
        if spikes is not None:
            spikes[part] = trace.spikes
        if progress is not None:
            progress(min(first + PART, len(events)))
    joined = {
        name: DetailedTimes(
            **{f.name: np.concatenate([getattr(t, f.name) for t in times]) for f in fields(DetailedTimes)}
        )
        for name, times in found.items()
    }
    whole = Counts(**{f.name: np.concatenate([getattr(c, f.name) for c in counts]) for f in fields(Counts)})
    return whole, np.concatenate(charged) if charged else None, joined, np.concatenate(updates)
