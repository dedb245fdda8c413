"""Time onnxruntime on the integer graph beside our engine: CPU milliseconds a recording, one thread, in one run.

    OMP_NUM_THREADS=1 python benchmarks/onnx_engine.py NET.loom RECORDINGS -o RESULTS.json [--split test] [--rounds 5]

Both keep every spike of every recording, in the same array. They take turns, in batches of one and of 144 recordings;
a figure is the median of its laps, a ratio the median of those within a round. Every lap's spikes are compared with
those of our engine.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from spikeloom.compiler import __version__
from spikeloom.compiler.files import sha256_of, write_atomically
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.netlist_file import read_netlist
from spikeloom.models.recordings.evtouch import load_recordings
from spikeloom.runtime.machines.loihi1 import engine, onnx_engine

FEW = 8
"""Recordings of a lap in which each goes in alone."""

Run = Callable[[np.ndarray], np.ndarray]
"""From events (recordings, channels, steps) to the spikes of a trace."""


def contenders(netlist: Netlist) -> tuple[dict[str, Run], dict[str, float]]:
    """What takes turns, and seconds that each needs to get ready."""

    def ours() -> Run:
        prepared = engine.prepare(netlist)
        return lambda events: engine.simulate(prepared, events, spikes=True, threads=1).spikes

    def onnx_form(form: str) -> Run:
        prepared = onnx_engine.prepare(netlist, form=form)
        return lambda events: onnx_engine.simulate(prepared, events).spikes

    runs, ready = {}, {}
    for name, make in (("ours", ours), ("scan", lambda: onnx_form("scan")), ("step", lambda: onnx_form("step"))):
        begun = time.perf_counter()
        runs[name] = make()
        ready[name] = round(time.perf_counter() - begun, 3)
    return runs, ready


def measure(runs: dict[str, Run], units: list[np.ndarray], rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds a recording, ratios to ours, and spikes that differ."""
    laps: dict[str, list[float]] = {name: [] for name in runs}
    differing = dict.fromkeys(runs, 0)
    expected = [runs["ours"](unit) for unit in units]
    recordings = sum(len(unit) for unit in units)
    for run in runs.values():
        run(units[0])  # first calls allocate
    for _ in range(rounds):
        for name, run in runs.items():
            begun = time.process_time()
            found = [run(unit) for unit in units]
            laps[name].append((time.process_time() - begun) * 1e3 / recordings)
            differing[name] += sum(int(np.count_nonzero(a != b)) for a, b in zip(found, expected, strict=True))
    return {
        name: {
            "ms": round(statistics.median(own), 3),
            "times_ours": round(statistics.median(a / b for a, b in zip(own, laps["ours"], strict=True)), 2),
            "differing_spikes": differing[name],
        }
        for name, own in laps.items()
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("netlist")
    parser.add_argument("recordings")
    parser.add_argument("--split", default="test")
    parser.add_argument("--batch", type=int, default=144)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("-o", "--output", required=True)
    arguments = parser.parse_args()

    netlist = read_netlist(arguments.netlist)
    recorded = load_recordings(arguments.recordings, arguments.split, limit=arguments.batch).events
    events = np.ascontiguousarray(recorded.reshape(len(recorded), netlist.n_inputs, -1))
    runs, ready = contenders(netlist)
    batches = {"1": [events[i : i + 1] for i in range(min(FEW, len(events)))], str(len(events)): [events]}
    report = {
        "netlist_sha256": sha256_of(arguments.netlist),
        "recordings": Path(arguments.recordings).name,
        "steps": events.shape[2],
        "spikeloom": __version__,
        "onnx": onnx.__version__,
        "onnxruntime": onnxruntime.__version__,
        "python": platform.python_version(),
        "threads": 1,
        "rounds": arguments.rounds,
        "ready_s": ready,
        "by_batch": {size: measure(runs, units, arguments.rounds) for size, units in batches.items()},
    }
    with write_atomically(arguments.output) as file:
        file.write(f"{json.dumps(report, indent=2)}\n".encode())
    for size, found in report["by_batch"].items():
        for name, figures in found.items():
            print(
                f"batch {size:>3}  {name:5} {figures['ms']:8.3f} ms a recording  x {figures['times_ours']:.2f}  "
                f"{figures['differing_spikes']} differing spikes"
            )


if __name__ == "__main__":
    main()
