"""Every spike of other simulators of Loihi beside ours, on all test recordings, once; SANA-FE's energy and time too.

``python benchmarks/agreement.py DATA OUT.json NET.loom … --python lava=PATH --limit lava=4 …`` goes on where OUT.json
ends.

No simulator knows windows, so all layers of ours are open throughout, and biases act from the first step. SANA-FE loads
what ``export --to sanafe`` writes; its energy and simple time are compared under its conventions, and with what
``estimate --detail cycle`` prints.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import workload
from made import made
from rivals import Entry, Worker

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats import sanafe
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.loihi1.netlist import Netlist, read_netlist
from spikeloom.models.recordings.events import joined_bins, load_data, of_length
from spikeloom.runtime.machines.loihi1.costs.estimate import estimate
from spikeloom.runtime.machines.loihi1.engine import simulate

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import timing_oracle

RIVALS = {"brian2": (), "nengo": ("layers",), "lava": ()}
"""Those with a script of their own, and its options."""

FIRST, TOGETHER = 12, 36
"""Recordings of the first process, of which SANA-FE's detailed time is taken, and of the others."""


def without_windows(netlist: Netlist) -> Netlist:
    """All layers integrate in every step."""
    return replace(netlist, layers=tuple(replace(layer, depth=0) for layer in netlist.layers))


def later(events: Any, steps: int, *, first: int) -> Any:
    """Events (recordings, channels, T) from a step on, silence before and after; (recordings, channels, steps)."""
    padded = np.zeros((*events.shape[:2], steps), np.uint8)
    padded[:, :, first : first + events.shape[2]] = events
    return padded


def compare(
    name: str, python: str, netlist: Netlist, events: Any, folder: Path, _first: int
) -> dict[str, Any]:
    """Spikes of a simulator that is handed matrices; CPU seconds of its process, without others that it starts."""
    stages = workload.stages_of(netlist)
    arrays: dict[str, Any] = {
        "layers": len(stages),
        "events": events.transpose(0, 2, 1),
        "few": np.arange(len(events)),
    }
    for index, stage in enumerate(stages):
        arrays |= stage.arrays(index)
    for first in (0, 1):
        given = later(events, events.shape[2] + len(stages), first=first)
        trace = simulate(without_windows(netlist), given, spikes=True)
        assert trace.spikes is not None
        arrays |= {
            f"piped{first}{i}": np.packbits(trace.spikes[:, :, netlist.compartments_of(i)])
            for i in range(len(stages))
        }
    np.savez(folder / "task.npz", **arrays)
    entry = Entry(name=name, rival=name, options=RIVALS[name], computes="", together=False)
    worker = Worker(entry, python, folder / "task.npz", folder / "log")
    answer = worker.answer()
    worker.close()
    if "skipped" in answer:
        raise SystemExit(f"{name}: {answer['skipped']}")
    return {
        "tool": answer["tool"],
        "differing_spikes": sum(answer["differing_spikes"]),
        "cpu_s": answer["first_cpu_s"],
    }


def simple_times(chip: timing_oracle.Chip, spikes: Any, updated: Any, events: Any) -> Any:
    """Picoseconds of each step by the simple model, channels being neurons that send in the step before they act."""
    inputs, table = chip.netlist.n_inputs, chip.table
    fired = np.concatenate([np.zeros((len(spikes), inputs), np.int64), spikes], axis=1)
    fired[:-1, :inputs] = events[:, 1:].T
    worked = np.concatenate([np.zeros((len(spikes), inputs), np.int64), updated], axis=1)
    sums = np.zeros((2, len(spikes), len(chip.tile)), np.int64)
    for core, sources in enumerate(chip.sweep):
        access, update, spike = (
            0 if core >= chip.netlist.n_cores else table.picoseconds(event)
            for event in ("neuron_access", "neuron_update", "spike")
        )
        fan = [len(chip.deliveries.get(source, ())) for source in sources]
        each = spike + table.picoseconds("axon_out") * np.array(fan, np.int64)
        sums[0, :, core] = access * len(sources) + worked[:, sources] @ np.full(len(sources), update)
        sums[0, :, core] += fired[:, sources] @ each
    for source, deliveries in chip.deliveries.items():
        for core, work in deliveries:
            sums[1, :, core] += fired[:, source] * work
    return sums.max(axis=(0, 2)) + table.barrier(len(set(chip.tile)))


def compare_sanafe(
    _name: str, python: str, netlist: Netlist, events: Any, folder: Path, first: int
) -> dict[str, Any]:
    """Spikes, energy and times of SANA-FE for some recordings, by its conventions and as ``estimate`` prints them."""
    target, models = load_target(netlist.target), ("simple",) if first else ("simple", "detailed")
    version = "from importlib.metadata import version as v; print(v('sanafe'))"
    tool = subprocess.run([python, "-c", version], check=True, capture_output=True, text=True).stdout.strip()
    steps = events.shape[2] + netlist.max_depth + 1
    (folder / "net.yaml").write_text("\n".join(sanafe.export(netlist, target)) + "\n", "utf-8")
    np.savez(folder / "given.npz", events=events, steps=steps, models=models)
    words = [
        python,
        str(Path(__file__).with_name("sanafe_file.py")),
        *(str(folder / name) for name in ("net.yaml", "given.npz", "runs.json")),
    ]
    before = os.times().children_user
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    theirs = json.loads((folder / "runs.json").read_text("utf-8"))

    shifted = later(events, steps, first=1)
    trace = simulate(without_windows(netlist), shifted, spikes=True, membranes=True)
    assert trace.spikes is not None
    updated = timing_oracle.updates(netlist, shifted, trace.spikes, trace.membranes)
    tiles, dense = sanafe.input_tiles(netlist, target), timing_oracle.dense_synapses(netlist)
    chip = timing_oracle.Chip(netlist, target, target.time[0], tiles, dense)
    parts = timing_oracle.parts_of_energy(
        netlist, target, trace.counts, updated.sum(axis=(1, 2)), steps, tiles, dense
    )
    _, printed = estimate(netlist, target, events, detail="cycle")
    ours = {"simple": printed.simple["sanafe"].seconds, "detailed": printed.detailed["sanafe"].seconds}
    names, number = sanafe.group_names(netlist), netlist.number_in_layer()
    compartment = {(names[netlist.layer[c]], int(number[c])): c for c in range(netlist.n_compartments)}
    found: dict[str, Any] = {
        "tool": f"SANA-FE {tool}",
        "differing_spikes": 0,
        "cpu_s": os.times().children_user - before,
        "energy_off": 0.0,
        "simple_time_off": 0.0,
    }
    for i in range(len(events)):
        runs = theirs[len(models) * i : len(models) * (i + 1)]
        for run in runs:
            fired = np.zeros_like(trace.spikes[i])
            for step, group, k in run["spikes"]:
                fired[step, compartment[group, k]] = True
            found["differing_spikes"] += int(np.count_nonzero(fired != trace.spikes[i]))
        total = sum(runs[0]["energy"][part] for part in parts)
        energy = sum(float(joules[i].sum()) for joules in parts.values())
        found["energy_off"] = max(found["energy_off"], abs(energy / total - 1))
        seconds = [np.array(run["trace"]["sim_time"]) for run in runs]
        mine = simple_times(chip, trace.spikes[i], updated[i], shifted[i]) * 1e-12
        found["simple_time_off"] = max(found["simple_time_off"], float(np.abs(mine / seconds[0] - 1).max()))
        for name, each in zip(models, seconds, strict=True):
            off = float(ours[name][i] / each.sum() - 1)
            low, high = found.get(f"printed_{name}", (off, off))
            found[f"printed_{name}"] = (min(low, off), max(high, off))
    return found


def merged(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Of two parts of the recordings: sums of counts, the largest of what is off, the range of what is printed."""
    whole = dict(other)
    for key, value in one.items():
        if key.startswith("printed"):
            whole[key] = (
                value if key not in other else (min(value[0], other[key][0]), max(value[1], other[key][1]))
            )
        elif key != "tool":
            whole[key] = max(value, other[key]) if key.endswith("off") else value + other[key]
    return whole


def options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", help="folder or zip in the released layout, 39 taxels")
    parser.add_argument("output", help="JSON file to write, or to go on with")
    parser.add_argument("netlists", nargs="+", metavar="NET.loom")
    parser.add_argument(
        "--python", action="append", required=True, metavar="NAME=PATH", help="interpreter of a rival"
    )
    parser.add_argument(
        "--limit", action="append", default=[], metavar="NAME=N", help="recordings of a slow rival"
    )
    return parser.parse_args()


def write(path: Path, result: dict[str, Any]) -> None:
    """All that is known so far."""
    with write_atomically(path) as file:
        file.write((json.dumps(result, indent=1) + "\n").encode())


def main() -> None:
    """Compare, write after each simulator."""
    asked = options()
    pythons, limits = (dict(pair.split("=", 1) for pair in given) for given in (asked.python, asked.limit))
    train, data = (load_data(asked.data, split, taxels=39) for split in ("train", "test"))
    output = Path(asked.output)
    networks = json.loads(output.read_text("utf-8"))["networks"] if output.exists() else {}
    for path in asked.netlists:
        netlist = read_netlist(path)
        shown = of_length(joined_bins(data, netlist.bins), netlist.clocks.length)
        events = np.ascontiguousarray(with_clocks(shown.events, netlist.clocks) != 0).view(np.uint8)
        trace = simulate(
            without_windows(netlist), later(events, events.shape[2] + len(netlist.layers), first=0)
        )
        facts = networks.setdefault(Path(path).stem, {})
        facts |= {
            "recordings": len(events),
            "neurons": netlist.n_compartments,
            "steps": events.shape[2] + len(netlist.layers),
            "spikes": int(trace.counts.spikes.sum()),
        }
        for name, python in pythons.items():
            run: Callable[..., dict[str, Any]] = compare if name in RIVALS else compare_sanafe
            wanted = min(int(limits.get(name, len(events))), len(events))
            while (first := facts.get(name, {}).get("recordings", 0)) < wanted:
                last, begun = min(wanted, first + (TOGETHER if first else FIRST)), time.monotonic()
                part = events[first:last]
                with tempfile.TemporaryDirectory() as folder:
                    found = {"recordings": len(part)} | run(name, python, netlist, part, Path(folder), first)
                facts[name] = merged(facts[name], found) if name in facts else found
                print(
                    f"{path}, {name}, {time.monotonic() - begun:.0f} s: {facts[name]}",
                    file=sys.stderr,
                    flush=True,
                )
                write(output, made(train, data) | {"networks": networks})
    write(output, made(train, data) | {"networks": networks})


if __name__ == "__main__":
    main()
