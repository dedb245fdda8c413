"""Our engine against other simulators of the same network, in one run: CPU time, memory, and whether spikes agree.

    python benchmarks/rivals.py RECORDINGS [--netlist NET.loom] -o rivals.json [--chart rivals]
        [--python brian2=/path/to/python] [--python nengo=…] [--python sanafe=…] [--only onnx,ours] [--rounds 5]

Runs the busy network of workload.py and, with ``--netlist``, a compiled one. Every rival is a process of its own, in
the interpreter that ``--python NAME=PATH`` names (else this one), on one processor and one thread; what is not
installed there is skipped and said so. All are started and checked against an integer reference first. Then, round
by round, each rival runs once, and right before it that mode of ours which hands over the same: ratios are taken
within these pairs. Set-up, compilation, loading and resets of rivals do not count, ours included.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import workload
from made import made
from rivals_chart import digits, draw

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist, write_netlist
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.report.sections import Table

HERE = Path(__file__).parent
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One line of the result.

    Parameters
    ----------
    name : str
        Ours begin with ``spikeloom``.
    rival : str
        What ``--python`` and ``--only`` call it; its script is ``rival_NAME.py``.
    options : tuple of str
        Of the script.
    computes : str
        What it hands over.
    together : bool
        Whether all recordings go in at once, or a few typical ones one by one.
    against : str
        Mode of ours that hands over the same; empty for ours.
    """

    name: str
    rival: str
    options: tuple[str, ...]
    computes: str
    together: bool
    against: str = ""


SPIKES = "every spike of every layer"
COUNTS = "spikes of every neuron, events, energy and simple time of a recording"
CYCLE = "the same, and the time of every step with queues and mesh"

ENTRIES = (
    *(
        Entry(
            name=f"spikeloom {mode}, {'all at once' if together else 'one at a time'}",
            rival="ours",
            options=(mode, "all" if together else "few"),
            computes=computes,
            together=together,
        )
        for mode, computes in (
            ("spikes", f"{SPIKES}; integers"),
            ("totals", "spikes and updates of every neuron in a recording; integers"),
            ("counts", COUNTS),
            ("cycle", CYCLE),
        )
        for together in (True, False)
    ),
    Entry(
        name="onnxruntime, integers, all at once",
        rival="onnx",
        options=("all",),
        computes=f"{SPIKES}; integers",
        together=True,
        against="spikes",
    ),
    Entry(
        name="onnxruntime, integers, one at a time",
        rival="onnx",
        options=("few",),
        computes=f"{SPIKES}; integers",
        together=False,
        against="spikes",
    ),
    Entry(
        name="torch, layer by layer, all at once",
        rival="torch",
        options=("layers", "all"),
        computes=f"{SPIKES}; float32",
        together=True,
        against="spikes",
    ),
    Entry(
        name="torch, layer by layer, one at a time",
        rival="torch",
        options=("layers", "few"),
        computes=f"{SPIKES}; float32",
        together=False,
        against="spikes",
    ),
    Entry(
        name="torch, step by step, one at a time",
        rival="torch",
        options=("steps", "few"),
        computes=f"{SPIKES}; float32, in the form of the released code",
        together=False,
        against="spikes",
    ),
    Entry(
        name="brian2-loihi",
        rival="brian2",
        options=(),
        computes=f"{SPIKES}; integers",
        together=False,
        against="spikes",
    ),
    Entry(
        name="nengo-loihi emulator, blocks of a core",
        rival="nengo",
        options=("cores",),
        computes=f"{SPIKES}; integers",
        together=False,
        against="spikes",
    ),
    Entry(
        name="nengo-loihi emulator, blocks of a layer",
        rival="nengo",
        options=("layers",),
        computes=f"{SPIKES}; integers; blocks beyond the size of a core",
        together=False,
        against="spikes",
    ),
    Entry(
        name="SANA-FE, simple",
        rival="sanafe",
        options=("simple",),
        computes=COUNTS,
        together=False,
        against="counts",
    ),
    Entry(
        name="SANA-FE, detailed",
        rival="sanafe",
        options=("detailed",),
        computes=CYCLE,
        together=False,
        against="cycle",
    ),
)


class Worker:
    """A rival's process."""

    def __init__(self, entry: Entry, python: str, task: Path, log: Path) -> None:
        self.entry = entry
        self.log = log
        with log.open("w") as errors:
            self.process = subprocess.Popen(
                [python, str(HERE / f"rival_{entry.rival}.py"), str(task), *entry.options],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(HERE.parent)},
            )

    def answer(self) -> dict[str, Any]:
        """Next answer; ``skipped`` with the last line of its errors if the process has ended."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if line:
            return dict(json.loads(line))
        said = self.log.read_text(errors="replace").strip().splitlines()
        return {"skipped": f"it ended: {said[-1] if said else 'without a word'}"}

    def lap(self) -> dict[str, Any]:
        """Let it run once."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write("\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # the answer says why
        return self.answer()

    def close(self) -> None:
        """End the process, by closing its input."""
        self.process.communicate()


def write_task(path: Path, netlist: Netlist, events: workload.SpikeArray, few: Any) -> dict[str, Any]:
    """Write what the workers read, the netlist beside it; facts about the workload."""
    chain = workload.chain_of(netlist)
    arrays: dict[str, Any] = {"layers": len(chain), "events": events.view(np.uint8), "few": few}
    for index, stage in enumerate(chain):
        arrays |= stage.arrays(index)
    chosen = events[few]
    padded = np.concatenate([chosen, np.zeros_like(chosen[:, : len(chain)])], axis=1)
    aligned = workload.reference(chain, chosen)
    for kind, found in (
        ("aligned", aligned),
        ("piped0", workload.reference(chain, padded, delay=1)),
        ("piped1", workload.reference(chain, padded, delay=1, first_delay=1)),
    ):
        arrays |= {f"{kind}{index}": np.packbits(spikes) for index, spikes in enumerate(found)}
    np.savez(path, **arrays)
    write_netlist(netlist, path.with_suffix(".loom"))
    return {
        "compartments": netlist.n_compartments,
        "synapses": netlist.n_synapses,
        "recordings": len(events),
        "steps": events.shape[1],
        "one_at_a_time": [int(i) for i in few],
        "activity": [round(float(spikes.mean()), 4) for spikes in aligned],
        "synaptic_operations": round(workload.synaptic_operations(chain, chosen, aligned)),
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    """Least, median and largest of some rounds."""
    return {
        "min": float(f"{min(values):.4g}"),
        "median": float(f"{statistics.median(values):.4g}"),
        "max": float(f"{max(values):.4g}"),
    }


def measure(task: Path, entries: Sequence[Entry], pythons: dict[str, str], *, rounds: int) -> dict[str, Any]:
    """Start all workers, check them, run the rounds; a result for each entry by its name."""
    workers: dict[str, Worker] = {}
    found: dict[str, dict[str, Any]] = {}
    for index, entry in enumerate(entries):
        worker = Worker(entry, pythons.get(entry.rival, sys.executable), task, task.with_suffix(f".{index}"))
        first = worker.answer()
        found[entry.name] = {
            "computes": entry.computes,
            "together": entry.together,
            "compared_with": f"mode {entry.against}" if entry.against else None,
            "against": None,
        } | first
        print(f"  {entry.name}: {first.get('skipped') or first['tool']}", file=sys.stderr, flush=True)
        if "skipped" in first:
            worker.close()
        else:
            workers[entry.name] = worker
    laps: dict[str, list[float]] = {name: [] for name in workers}
    ratios: dict[str, list[float]] = {name: [] for name in workers}
    peaks: dict[str, int] = {}

    def lap(name: str) -> float:
        result = workers[name].lap()
        if "skipped" in result:
            raise SystemExit(f"rivals: {name}: {result['skipped']}")
        laps[name].append(result["cpu_s"])
        peaks[name] = result["peak_bytes"]
        return float(result["cpu_s"])

    for entry in entries:
        twin = (entry.against, "all" if entry.together else "few")
        name = next((ours.name for ours in entries if ours.options == twin), None)
        found[entry.name]["against"] = name if name in workers else None
    paired = {found[name]["against"] for name in workers}
    for number in range(rounds):
        print(f"  round {number + 1} of {rounds}", file=sys.stderr, flush=True)
        for name in workers:
            against = found[name]["against"]
            if against is not None:
                ours = lap(against)
                ratios[name].append(lap(name) / ours)
            elif name not in paired:  # the others run before each of their rivals
                lap(name)
    for name, worker in workers.items():
        worker.close()
        found[name] |= {
            "cpu_ms": spread([1e3 * s for s in laps[name]]),
            "laps": len(laps[name]),
            "peak_mb": round(peaks[name] / 1e6, 1),
        }
        if ratios[name]:
            found[name]["ratio"] = spread(ratios[name])
    return found


def text(name: str, facts: dict[str, Any]) -> str:
    """One workload for people."""
    rows, notes = [], []
    for entry, result in facts["entries"].items():
        if "skipped" in result:
            notes.append(f"  {entry}: skipped, {result['skipped']}")
            continue
        ratio = result.get("ratio")
        if result["compared_with"] and not ratio:
            notes.append(f"  {entry}: no ratio, {result['compared_with']} of ours was not measured")
        rows.append(
            [
                entry,
                digits(result["cpu_ms"]["median"]),
                digits(result["cpu_ms"]["min"]),
                f"{digits(ratio['median'])} ({digits(ratio['min'])} … {digits(ratio['max'])})"
                if ratio
                else "",
                f"{result['peak_mb']:.0f}",
                f"{sum(result['differing_spikes'])}",
            ]
        )
    head = ["CPU ms per recording, one thread", "median", "least", "× ours", "peak MB", "differing spikes"]
    activity = ", ".join(f"{100 * share:.1f}" for share in facts["activity"])
    return "\n".join(
        [
            f"{name}: {facts['compartments']} neurons, {facts['synapses']} synapses, {facts['steps']} steps; "
            f"{activity} % spikes a step; {facts['synaptic_operations']:,} synaptic operations",
            str(Table(head, rows)),
            *notes,
        ]
    )


def options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", help="folder or zip in the released layout, 39 taxels")
    parser.add_argument("--netlist", help="a compiled network to run as well")
    parser.add_argument("--no-busy", action="store_true", help="leave the busy network out")
    parser.add_argument("-o", "--output", required=True, help="JSON file to write")
    parser.add_argument("--chart", help="also draw CHART.svg and CHART.png")
    parser.add_argument(
        "--python", action="append", default=[], metavar="NAME=PATH", help="interpreter of a rival"
    )
    parser.add_argument("--only", help="rivals to run, comma-separated, of " + ", ".join(rivals()))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--few", type=int, default=3, help="typical recordings for what runs them one by one"
    )
    parser.add_argument("--processor", type=int, default=max(os.sched_getaffinity(0)))
    return parser.parse_args()


def rivals() -> tuple[str, ...]:
    """Names of the rivals, ours among them."""
    return tuple(dict.fromkeys(entry.rival for entry in ENTRIES))


def main() -> None:
    """Measure, write, print."""
    asked = options()
    pythons = dict(pair.split("=", 1) for pair in asked.python)
    only = asked.only.split(",") if asked.only else list(rivals())
    if unknown := {*pythons, *only} - set(rivals()):
        raise SystemExit(
            f"rivals: {', '.join(sorted(unknown))}: no such rival; there are {', '.join(rivals())}"
        )
    os.sched_setaffinity(0, {asked.processor})  # every worker inherits it
    data = load_data(asked.recordings, "test", taxels=39)
    # by number, as the busy network was defined, not by letter
    order = sorted(
        range(len(data)), key=lambda i: [int(digits) for digits in re.findall(r"\d+", data.files[i])]
    )
    events = data.events[order].reshape(len(data), -1, data.steps).transpose(0, 2, 1).astype(np.bool_)
    few = workload.typical(events, asked.few)
    netlists = (
        {} if asked.no_busy else {"busy": workload.place_chain(workload.build_chain(events), taxels=39)}
    )
    if asked.netlist:
        netlists[Path(asked.netlist).name] = read_netlist(asked.netlist)
    result: dict[str, Any] = made(load_data(asked.recordings, "train", taxels=39), data) | {
        "machine": {"processor": processor_name(), "python": platform.python_version(), "threads": 1},
        "units": "CPU milliseconds per recording; ratios are rival over ours within one round",
        "workloads": {},
    }
    for name, netlist in netlists.items():
        print(name, file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            task = Path(folder) / "task.npz"
            facts = write_task(task, netlist, events, few)
            entries = [entry for entry in ENTRIES if entry.rival in only]
            facts["entries"] = measure(task, entries, pythons, rounds=asked.rounds)
        result["workloads"][name] = facts
        print(text(name, facts))
    with write_atomically(asked.output) as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())
    if asked.chart:
        draw(result, asked.chart)


def processor_name() -> str:
    """Model name of the processor."""
    lines = Path("/proc/cpuinfo").read_text(encoding="ascii").splitlines()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "unknown")


if __name__ == "__main__":
    main()
