"""What a run costs: events, energies and simple times, added up in the run; in detail ``cycle`` also detailed times.

Every message is scheduled for these, and energy is told by core. Spikes are the same in both details.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.place import require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.machines.loihi1 import engine, timing
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.cost import Costs
from spikeloom.runtime.machines.loihi1.timing import DetailedTimes, SimpleTimes
from spikeloom.runtime.machines.loihi1.trace import Counts, Trace, side_by_side

T = TypeVar("T", Counts, Trace, DetailedTimes)

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
    netlist: Netlist | engine.Engine,
    target: Target,
    events: engine.EventArray,
    *,
    lengths: IntArray | None = None,
    detail: str = "counts",
    spikes: bool = False,
    progress: Callable[[int], object] | None = None,
) -> tuple[Trace, Estimate]:
    """Run recordings, keep their spikes where wanted, and say what they cost.

    `events` are (samples, n_inputs, T), `lengths` (samples,) the data steps of each, `detail` is ``counts`` or
    ``cycle``; for that `progress` is called with the number of recordings done.

    Raises
    ------
    DataError, NumericRangeError
        As the engine says.
    OptionError
        If several chips shall be simulated by the cycle. Their events are counted and priced but not timed: links
        between chips have no public latency.
    """
    prepared = netlist if isinstance(netlist, engine.Engine) else engine.prepare(netlist)
    netlist, deep = prepared.netlist, detail == "cycle"
    if deep:
        require_one_chip(netlist.core_tile, target, "--detail cycle")
    latencies = timing.tables_of(netlist, target)
    charges = side_by_side([timing.charges(each) for each in latencies.values()]) if latencies else None
    steps = np.full(len(events), events.shape[2]) if lengths is None else np.asarray(lengths, np.int64)
    chip_steps = steps + netlist.max_depth
    detailed: dict[str, list[DetailedTimes]] = {name: [] for name in latencies if deep}
    traces, updates, size = [], [], PART if deep else max(1, len(events))
    for first in range(0, max(1, len(events)), size):
        part = slice(first, first + size)
        trace = engine.simulate(
            prepared, events[part], lengths=steps[part], spikes=deep or spikes, updated=deep, charges=charges
        )
        traces.append(replace(trace, spikes=trace.spikes if spikes else None, updated=None))
        if not deep:
            continue
        assert trace.spikes is not None, "spikes were wanted"
        assert trace.updated is not None, "updates were wanted"
        updates.append(cost.updates_by_core(netlist, trace.updated))
        given = events[part] * (np.arange(events.shape[2]) < steps[part, None, None])  # nothing after a recording's end
        for name, times in detailed.items():
            times.append(timing.detailed(latencies[name], trace.spikes, trace.updated, given, steps=chip_steps[part]))
        if progress is not None:
            progress(min(first + PART, len(events)))
    whole = traces[0] if len(traces) == 1 else _joined(Trace, traces)
    sums = [] if whole.charged is None else np.split(whole.charged, len(latencies), axis=2)
    cores: Mapping[str, FloatArray] = {}
    if deep:
        by_core = replace(whole.counts, updates=np.concatenate(updates))
        cores = cost.price(cost.prepare(netlist, target, "core"), by_core, chip_steps).energy
    return whole, Estimate(
        costs=cost.price(cost.prepare(netlist, target), whole.counts, chip_steps),
        steps=steps,
        simple={
            name: timing.simple_times(each, charged, chip_steps)
            for (name, each), charged in zip(latencies.items(), sums, strict=True)
        },
        detailed={name: _joined(DetailedTimes, times) for name, times in detailed.items()},
        cores=cores,
    )


def _joined(kind: type[T], parts: Sequence[T]) -> T:
    """One dataclass of arrays from those of some recordings each."""

    def join(values: Sequence[Any]) -> Any:
        if isinstance(values[0], Counts):
            return _joined(Counts, values)
        return None if values[0] is None else np.concatenate(values)

    return kind(**{field.name: join([getattr(part, field.name) for part in parts]) for field in fields(kind)})
