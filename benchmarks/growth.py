"""How the cost of our engine grows: with activity, steps, synapses, and processors of the host; a chart each.

Command: ``python benchmarks/growth.py -o growth.json --chart growth``

Networks are synthetic: random channels, two layers of the same width and 36 neurons that vote, all connected to all,
thresholds set so that each layer spikes about as often as the channels. What really spiked is in the file. Times are
those of `simulate` alone, spikes kept, the least of some repeats: CPU time of one thread, but wall time where threads
are compared.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import workload
from growth_chart import draw
from made import made

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1.engine import Engine, prepare, simulate

DENSITIES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.5)
STEPS = (30, 100, 300, 1000, 3000)
WIDTHS = (64, 128, 256, 512, 1024, 1536)
CHANNELS, VOTERS = 256, 36
WIDTH, DENSITY, LENGTH, BATCH = 768, 0.05, 250, 8
"""What stays as it is while something else varies."""

CALIBRATION_STEPS = 60


def recordings(density: float, steps: int, *, count: int = BATCH, seed: int = 0) -> workload.SpikeArray:
    """Independent random events, (recordings, steps, channels)."""
    return np.random.default_rng(seed).random((count, steps, CHANNELS)) < density


def network(width: int, density: float, *, seed: int = 0) -> Netlist:
    """A chain whose layers spike about as often as its input."""
    rng = np.random.default_rng(seed)
    sizes = (CHANNELS, width, width, VOTERS)
    # more positive than negative weights, so that half of the neurons can be made to spike
    weights = [workload.rounded(rng.uniform(-0.5, 1, (post, pre))) for pre, post in pairwise(sizes)]
    events = recordings(density, CALIBRATION_STEPS, count=16, seed=seed + 1)
    layers = workload.build_chain(events, weights=weights, rates=(density,) * len(weights), seed=seed)
    return workload.place_chain(layers, taxels=CHANNELS // 2)


def least(run: Callable[[], object], clock: Callable[[], float], repeats: int) -> float:
    """Seconds of the fastest of some runs, after one to warm up."""
    run()
    found = []
    for _ in range(repeats):
        begun = clock()
        run()
        found.append(clock() - begun)
    return min(found)


def measure(
    engine: Engine, events: workload.SpikeArray, *, repeats: int, threads: int = 1
) -> dict[str, Any]:
    """Time of one recording, and what happened in it."""
    netlist = engine.netlist
    given = np.ascontiguousarray(events.transpose(0, 2, 1)).view(np.uint8)

    def run() -> object:
        return simulate(engine, given, threads=threads, spikes=True)

    clock = time.process_time if threads == 1 else time.perf_counter
    seconds = least(run, clock, repeats)
    counts = simulate(engine, given).counts
    fan_out = np.bincount(
        netlist.axon_source, np.diff(netlist.axon_synapses), netlist.n_inputs + netlist.n_compartments
    )
    operations = np.concatenate([counts.inputs, counts.spikes], axis=1) @ fan_out
    return {
        "ms": float(f"{1e3 * seconds / len(events):.4g}"),
        "steps": events.shape[1],
        "synapses": netlist.n_synapses,
        "input_density": round(float(events.mean()), 5),
        "hidden_density": round(float(counts.spikes.sum() / (counts.spikes.size * events.shape[1])), 5),
        "synaptic_operations": round(float(operations.mean())),
    }


def threads_of_host(engine: Engine, *, repeats: int) -> list[dict[str, Any]]:
    """The same recordings on one thread and more, up to the processors that this process may use."""
    events = recordings(DENSITY, LENGTH, count=8 * BATCH)
    given = np.ascontiguousarray(events.transpose(0, 2, 1)).view(np.uint8)
    found = []
    for threads in range(1, len(os.sched_getaffinity(0)) + 1):
        seconds = least(
            lambda n=threads: simulate(engine, given, threads=n, spikes=True), time.perf_counter, repeats
        )
        found.append({"threads": threads, "ms": float(f"{1e3 * seconds / len(events):.4g}")})
    return found


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", required=True, help="JSON file to write")
    parser.add_argument("--chart", help="also draw CHART-activity.svg and .png, and so on")
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()

    middle = prepare(network(WIDTH, DENSITY))
    result = made() | {
        "machine": {"processors": len(os.sched_getaffinity(0)), "python": platform.python_version()},
        "units": "milliseconds per recording: CPU time of one thread, wall time where threads vary",
        "activity": [
            measure(prepare(network(WIDTH, density)), recordings(density, LENGTH), repeats=asked.repeats)
            for density in DENSITIES
        ],
        "steps": [measure(middle, recordings(DENSITY, steps), repeats=asked.repeats) for steps in STEPS],
        "synapses": [
            measure(prepare(network(width, DENSITY)), recordings(DENSITY, LENGTH), repeats=asked.repeats)
            for width in WIDTHS
        ],
        "threads": threads_of_host(middle, repeats=asked.repeats),
    }
    with write_atomically(asked.output) as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
    if asked.chart:
        draw(result, asked.chart)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
