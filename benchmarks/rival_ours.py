"""Our engine as a worker: ``rival_ours.py TASK.npz MODE all|few``; recordings go in all at once, or one by one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from worker import Job, Task, UnfitError, serve

from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist
from spikeloom.compiler.types import BoolArray
from spikeloom.runtime.machines.loihi1.costs import cost, timing
from spikeloom.runtime.machines.loihi1.engine import prepare, simulate
from spikeloom.runtime.machines.loihi1.trace import Trace, unpack

Run = Callable[[Any], Trace]
"""Runs events (recordings, channels, steps); what it computes beyond the trace is computed and thrown away."""


def spikes(netlist: Netlist) -> Run:
    """Every spike of every layer, kept at a bit each."""
    engine = prepare(netlist)
    return lambda events: simulate(engine, events, threads=1, packed=True)


def totals(netlist: Netlist) -> Run:
    """Spikes and updates of every neuron, summed over the recording."""
    engine = prepare(netlist)
    return lambda events: simulate(engine, events, threads=1)


def counts(netlist: Netlist) -> Run:
    """Events and energy of every recording, and the time of every step by the simple model."""
    chip = load_target(netlist.target)
    latencies, meter = timing.prepare(netlist, chip, chip.time[0]), cost.prepare(netlist, chip)
    engine, charges = prepare(netlist), timing.charges(latencies)

    def run(events: Any) -> Trace:
        trace = simulate(engine, events, threads=1, charges=charges)
        assert trace.charged is not None
        steps = np.full(len(events), events.shape[2])
        timing.simple_times(latencies, trace.charged, steps + netlist.max_depth)
        cost.price(meter, trace.counts, steps + netlist.max_depth)
        return trace

    return run


def cycle(netlist: Netlist) -> Run:
    """The same, and the time of every step with queues and mesh."""
    chip = load_target(netlist.target)
    latencies, meter = timing.prepare(netlist, chip, chip.time[0]), cost.prepare(netlist, chip)
    engine, charges = prepare(netlist), timing.charges(latencies)

    def run(events: Any) -> Trace:
        trace = simulate(engine, events, threads=1, spikes=True, updated=True, charges=charges)
        assert trace.spikes is not None
        assert trace.updated is not None
        assert trace.charged is not None
        steps = np.full(len(events), events.shape[2])
        timing.simple_times(latencies, trace.charged, steps + netlist.max_depth)
        timing.detailed(latencies, trace.spikes, trace.updated, events)
        cost.price(meter, trace.counts, steps + netlist.max_depth)
        return trace

    return run


MODES: dict[str, Callable[[Netlist], Run]] = {
    "spikes": spikes,
    "totals": totals,
    "counts": counts,
    "cycle": cycle,
}
"""What can be measured, under the names that rivals.py asks for."""


def _kept(netlist: Netlist, trace: Trace) -> BoolArray | None:
    """Spikes of a run that kept them."""
    return trace.spikes if trace.packed is None else unpack(trace.packed, netlist.n_compartments)


def prepare_job(task: Task, options: list[str]) -> Job:
    mode, share = options
    if mode not in MODES:
        raise UnfitError(f"there is no mode {mode}, only {', '.join(MODES)}")
    netlist = read_netlist(task.path.with_suffix(".loom"))
    run = MODES[mode](netlist)
    events = np.ascontiguousarray(task.events.transpose(0, 2, 1))
    units = [events] if share == "all" else [events[i : i + 1] for i in task.few]

    def differing(results: list[Trace]) -> list[int]:
        """Of the spikes where they were kept, else of the sums over the recording."""
        which = task.few if share == "all" else slice(None)
        found = []
        for layer, entry in enumerate(netlist.layers):
            expected, ids = task.expected("aligned", layer), netlist.compartments_of(layer)
            kept = [_kept(netlist, result) for result in results]
            if kept[0] is not None:
                window = slice(entry.depth, entry.depth + events.shape[2])
                spiked = np.concatenate(kept)[which][:, window, ids]
                found.append(int(np.count_nonzero(spiked != expected)))
            else:
                summed = np.concatenate([result.counts.spikes for result in results])[which][:, ids]
                found.append(int(np.abs(summed - expected.sum(axis=1)).sum()))
        return found

    return Job(
        name=f"spikeloom, mode {mode}",
        units=len(units),
        recordings=sum(len(unit) for unit in units),
        run=lambda unit: run(units[unit]),
        differing=differing,
    )


if __name__ == "__main__":
    serve(prepare_job)
