"""What training on lost events and taxels does to decisions: how many hold, whichever event or taxel is changed.

    python benchmarks/robust.py DATA OUT.json [--join 10] [--epochs 50] [--seeds 2] [--chances 0 0.1 0.2] [--test 0 X]

Networks as ``spikeloom train --robust X`` makes them, released recipe, last epoch. A chance is chosen on a fifth of the
training split that these left out; networks of the chances of `--test` are trained on all of it and read on the test
split. Compiled at 8 bits with scales of the recordings they were trained on. Runs that OUT.json holds are not repeated.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from made import made

import spikeloom
from spikeloom.compiler.systems import TACTILESGNET
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import joined_bins, load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training import usual
from spikeloom.models.training.kinds import Plan, seen_by
from spikeloom.models.training.recipes import RELEASED
from spikeloom.models.training.train import train, validation_split
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.changes import single
from spikeloom.runtime.studies.stability.bounds import lower_bound, needed
from spikeloom.runtime.studies.stability.neighbours import cells_of, channels_of

Json = dict[str, Any]

MOST = 8

COUNTED = ("recordings", "right", "both", "one", "two", "dead")


def main() -> None:
    """Train, certify, write after each network."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--join", type=int, default=10)
    parser.add_argument("--epochs", type=int, default=50)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--chances", type=float, nargs="+", default=[0, 0.1, 0.2])
    parser.add_argument("--test", type=float, nargs="*", default=[])
    arguments = parser.parse_args()
    training, test = (load_data(arguments.recordings, split) for split in ("train", "test"))
    found: Json = made(training, test) | {"data": Path(arguments.recordings).name, "held_out": [], "test": []}
    if arguments.output.exists():
        before = json.loads(arguments.output.read_text())
        found |= {part: before[part] for part in ("held_out", "test")}
    parts = {"held_out": (arguments.chances, *validation_split(training)), "test": (arguments.test, training, test)}
    for part, (chances, seen, asked) in parts.items():
        for seed in range(arguments.seeds):
            for chance in chances:
                about = {"seed": seed, "robust": chance}
                if any(about.items() <= each.items() for each in found[part]):
                    continue
                machine = trained(seen, asked, arguments.join, arguments.epochs, seed, chance)
                found[part].append(about | certified(machine, asked))
                arguments.output.write_text(json.dumps(found))
    found["together"] = {name: together(found[name]) for name in parts}
    arguments.output.write_text(json.dumps(found, indent=1) + "\n")


def trained(seen: Recordings, beside: Recordings, bins: int, epochs: int, seed: int, chance: float) -> Machine:
    """A TactileSGNet on the chip, trained on some recordings; on those `beside` it is only looked at."""
    recipe = replace(RELEASED, robust=chance)
    plan = Plan(
        system=TACTILESGNET,
        graph=build_graph("manual"),
        grid=None,
        recipe=recipe,
        copies=None,
        bins=bins,
        classes=int(seen.labels.max()) + 1,
        steps=seen.steps,
    )
    data = joined_bins(seen, bins), joined_bins(beside, bins)
    run = train(*data, seen_by(plan), usual.architecture(plan), epochs=epochs, seed=seed, recipe=recipe)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "network.pt")
        usual.save(file, {"last": run.last}, plan, {})
        compiled = spikeloom.compile(str(file), calibrate=seen, weight_bits="8")  # its file goes when it does
        return machine_for(compiled.path)


def certified(machine: Machine, data: Recordings) -> Json:
    """Recordings that are right, that bear 1 to `MOST` events, that do both, and that bear any dead taxel."""
    bear, right, both, dead, ahead = np.zeros(MOST + 1, np.int64), 0, 0, 0, []
    for events, label in zip(data.events, data.labels.tolist(), strict=True):
        channels, cells = channels_of(events[None], machine.netlist)[0], cells_of(events, machine.netlist)
        votes = machine.votes(channels[None])[0]
        decision, gaps = needed(votes)
        effects = machine.effects(channels, single(cells.cells))
        altered = ((effects.votes + votes).argmax(axis=1) != decision) & (cells.cost == 1)
        if not altered.any():
            known = machine.forgetting(channels)
            both += decision == label
            bear[: 1 + (1 if known is None else max(1, lower_bound(votes, cells, effects, known, MOST)))] += 1
        without = events[None] * (1 - np.eye(len(events), dtype=np.uint8))[:, :, None, None]
        dead += int((machine.votes(channels_of(without, machine.netlist)).argmax(axis=1) == decision).all())
        right += decision == label
        ahead.append(int(np.delete(gaps, decision).min()))
    counts = {"recordings": len(data), "right": right, "bear": bear[1:].tolist(), "both": both, "dead": dead}
    return counts | {"ahead": float(np.median(ahead))}


def together(runs: list[Json]) -> dict[str, Json]:
    """Sums over the seeds of each chance; beside them how much more, and how much less of what is missing."""
    found: dict[str, Json] = {}
    for run in runs:
        sums = found.setdefault(f"{run['robust']:g}", dict.fromkeys(COUNTED, 0))
        counts = {"one": run["bear"][0], "two": run["bear"][1]} | run
        for name in sums:
            sums[name] += counts[name]
    plain = dict(found.get("0", {}))
    for sums in found.values():
        for name in ("one", "two", "dead") if plain else ():
            gain = sums[name] / sums["recordings"] - plain[name] / plain["recordings"]
            sums[f"{name}_more"] = gain / (plain[name] / plain["recordings"])
            sums[f"{name}_of_missing"] = gain / (1 - plain[name] / plain["recordings"])
        if plain:
            sums["points"] = 100 * (sums["right"] / sums["recordings"] - plain["right"] / plain["recordings"])
    return found


if __name__ == "__main__":
    main()
