"""Time the main job on one core: compile, run by the engine, run by the float model.

    OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/main_job.py CHECKPOINT RECORDINGS [--graph manual] [--repeats 5]

All parts are timed side by side in one process, alternating, after a warm-up that compiles the kernels; the figures
are CPU seconds (minimum and median over the repeats), so that a busy machine disturbs them less.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

from spikeloom.compiler import Options, compile_network
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.machines.loihi1 import engine


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of an action, and its result."""
    start = time.process_time()
    result = action()
    return time.process_time() - start, result


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint")
    parser.add_argument("recordings")
    parser.add_argument("--graph", default="manual")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()

    checkpoint = read_checkpoint(arguments.checkpoint)
    graph = build_graph(arguments.graph)
    adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
    train = load_data(arguments.recordings, "train").events
    test = load_data(arguments.recordings, "test").events
    netlist = compile_network(expand(checkpoint, adjacency), Options(training_events=train)).netlist
    flat = test.reshape(len(test), netlist.n_inputs, -1)
    prepared = engine.prepare(netlist)

    jobs: dict[str, Callable[[], Any]] = {
        "compile, calibrated": lambda: compile_network(expand(checkpoint, adjacency), Options(training_events=train)),
        "compile, from the weights": lambda: compile_network(expand(checkpoint, adjacency)),
        "engine, all recordings": lambda: engine.simulate(prepared, flat, threads=1),
        "engine, one recording": lambda: engine.simulate(prepared, flat[:1], threads=1),
        "float model, all recordings": lambda: float_spikes(checkpoint, adjacency, test, dtype="float32"),
    }
    for job in jobs.values():
        job()
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(arguments.repeats):
        for name, job in jobs.items():
            seconds[name].append(timed(job)[0])
    report = {
        name: {"min_s": round(min(values), 4), "median_s": round(statistics.median(values), 4)}
        for name, values in seconds.items()
    }
    engine_s = min(seconds["engine, all recordings"])
    print(
        json.dumps(
            {
                "recordings": len(test),
                "cpu_seconds": report,
                "engine_recordings_per_s": round(len(test) / engine_s, 1),
                "engine_faster_than_float_model": round(min(seconds["float model, all recordings"]) / engine_s, 2),
                "threads": os.environ.get("OMP_NUM_THREADS", "all"),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
