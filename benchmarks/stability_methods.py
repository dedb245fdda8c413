"""Where methods fail: the float model, its chips and other networks side by side, under single events and dead taxels.

    python benchmarks/stability_methods.py DATA OUT.json --float NETWORK --chips NAME=NET.loom …

Every dead taxel of every test recording is run in all of them, every single event in the chips. The float model, in
float32 (:func:`interpret.float_simulation`), beside the first netlist, runs each changed recording from the first step
to the last, half a minute a recording of Objects: single events are tried where one alters the decision of a chip. What
OUT.json holds already is not run again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from made import made
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from tqdm import tqdm

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import float_simulation
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.changes import Changes, Effects, by_running, single
from spikeloom.runtime.studies.stability.neighbours import cells_of, channels_of
from spikeloom.runtime.studies.stability.results import PHASES

Json = dict[str, Any]

COLOURS = {"neither": "#dfe7ef", "a dead taxel": "#f2a65a", "one event": "#b3261e"}


class Floats:
    """The float model beside a netlist, as far as it is asked like a machine."""

    def __init__(self, file: str, netlist: Any) -> None:
        checkpoint = read_checkpoint(shipped(file), weights=netlist.provenance["weights"])
        _, seen = propagation(checkpoint, build_graph(netlist.provenance["graph"]), file)
        network = expand(checkpoint, seen)
        self.netlist, self.readout = netlist, network.readout
        self.model = float_simulation(network, np.float32)

    def votes(self, channels: Any) -> Any:
        """Spikes of each class, (samples, classes), of recordings (samples, channels, steps)."""
        events = np.ascontiguousarray(channels.transpose(0, 2, 1)).astype(np.bool_)
        fired = self.model.run(events).spikes[self.readout.population].sum(axis=1)
        each = range(self.netlist.classes)
        return np.stack([fired[:, self.readout.label == label].sum(axis=1) for label in each], axis=1)

    def effects(self, channels: Any, changes: Changes) -> Effects:
        """What changes of a recording bring about."""
        return by_running(self.votes, channels, changes)


def main() -> None:
    """Run what is missing, write after each recording, count, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--float", required=True, dest="floats", metavar="NETWORK")
    parser.add_argument("--chips", nargs="+", required=True, metavar="NAME=NET.loom")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    test = load_data(arguments.recordings, "test")
    known = json.loads(arguments.output.read_text())["each"] if arguments.output.exists() else {}
    found: Json = made(load_data(arguments.recordings, "train"), test) | {"data": Path(arguments.recordings).name}
    chips: dict[str, Any] = {n: machine_for(file) for n, _, file in (each.partition("=") for each in arguments.chips)}
    machines = chips | {"float": Floats(arguments.floats, next(iter(chips.values())).netlist)}
    found["each"] = {name: known.get(name, {}) for name in machines}
    for name, machine in machines.items():
        rows = found["each"][name]
        for index in tqdm(range(len(test)), desc=name, disable=None):
            events, row = test.events[index, ..., : test.steps_of(index)], rows.setdefault(str(index), {})
            if "dead" not in row:
                row |= {"label": int(test.labels[index])} | dead(machine, events)
            others = [found["each"][chip][str(index)] for chip in chips] if name == "float" else []
            if "event" not in row and (name != "float" or any(falls(other, "event") for other in others)):
                row |= {"event": event(machine, events)}
                arguments.output.write_text(json.dumps(found))
    found["methods"] = {name: summary(rows) for name, rows in found["each"].items()}
    found["fall"] = {kind: side_by_side(found["each"], kind) for kind in ("dead", "event")}
    arguments.output.write_text(json.dumps(found) + "\n")
    if arguments.picture:
        picture(found["each"], arguments.picture)


def dead(machine: Any, events: Any) -> Json:
    """What is decided, and taxels whose failure alters that."""
    without = events[None] * (1 - np.eye(len(events), dtype=np.uint8))[:, :, None, None]
    decided = machine.votes(channels_of(np.concatenate([events[None], without]), machine.netlist)).argmax(axis=1)
    return {"decided": int(decided[0]), "dead": np.flatnonzero(decided[1:] != decided[0]).tolist()}


def event(machine: Any, events: Any) -> Json:
    """Single events that alter the decision: how many of those that go and of those that come; taxels, phases."""
    channels, cells = channels_of(events[None], machine.netlist)[0], cells_of(events, machine.netlist)
    votes = machine.votes(channels[None])[0]
    after = (machine.effects(channels, single(cells.cells)).votes + votes).argmax(axis=1)
    hits = np.flatnonzero((after != votes.argmax()) & (cells.cost == 1))
    channel, step = cells.cells[hits].T
    phases = np.bincount(step * PHASES // (int(cells.cells[-1, 1]) + 1), minlength=PHASES)
    taxels = np.unique(channel // machine.netlist.polarities)
    gone = int(cells.there[hits].sum())
    return {"removed": gone, "added": len(hits) - gone, "taxels": taxels.tolist(), "phases": phases.tolist()}


def falls(row: Json, kind: str) -> bool:
    """Whether some change of a kind alters the decision, as far as it was tried."""
    return bool(row["dead"]) if kind == "dead" else "event" in row and any(row["event"]["phases"])


def summary(rows: Json) -> Json:
    """Recordings that are right and that stand; taxels, classes and phases in which the others fall, most first."""
    tried = [row for row in rows.values() if "event" in row]
    taxels = np.bincount([taxel for row in rows.values() for taxel in row["dead"]], minlength=1)
    classes = np.bincount([row["label"] for row in rows.values() if row["dead"]], minlength=1)
    return {
        "recordings": len(rows),
        "right": sum(row["decided"] == row["label"] for row in rows.values()),
        "dead": sum(not row["dead"] for row in rows.values()),
        "tried": len(tried),
        "event": sum(not falls(row, "event") for row in tried),
        "removed": sum(not row["event"]["removed"] for row in tried),
        "added": sum(not row["event"]["added"] for row in tried),
        "phases": np.sum([row["event"]["phases"] for row in tried], axis=0).tolist(),
        "taxels": [[int(t), int(taxels[t])] for t in np.argsort(-taxels, kind="stable")[:5]],
        "classes": [[int(c), int(classes[c])] for c in np.argsort(-classes, kind="stable")[:5]],
    }


def side_by_side(each: Json, kind: str) -> Json:
    """Recordings that fall in all networks and in some; in each of them though the floats stand, and the other way."""
    fall = {n: {i for i, row in rows.items() if falls(row, kind)} for n, rows in each.items()}
    floats = fall["float"]
    counts = {
        name: {"fall": len(own), "new": len(own - floats), "gone": len(floats - own)} for name, own in fall.items()
    }
    return {"in_all": len(set.intersection(*fall.values())), "in_some": len(set.union(*fall.values()))} | counts


def picture(each: Json, to: Path) -> None:
    """What alters each decision, networks below each other, recordings that little alters first."""

    def level(row: Json) -> int:
        if falls(row, "event"):
            return 2
        return 1 if row["dead"] else 0

    names = ["float", *(name for name in each if name != "float")]
    levels = np.array([[level(each[name][index]) for index in sorted(each[name], key=int)] for name in names])
    levels = levels[:, np.lexsort([*levels[::-1], levels.sum(axis=0)])]
    figure, axes = plt.subplots(figsize=(9.6, 0.34 * len(names) + 1.2), layout="constrained")
    axes.imshow(levels, cmap=ListedColormap(list(COLOURS.values())), vmin=0, vmax=2, aspect="auto")
    axes.set(yticks=range(len(names)), yticklabels=names, xticks=[], xlabel=f"{levels.shape[1]} test recordings")
    axes.set_title("floats: single events only where one alters a chip's decision", fontsize=8)
    axes.set_yticks(np.arange(0.5, len(names)), minor=True)
    axes.grid(which="minor", color="white", lw=2)
    axes.tick_params(which="both", length=0)
    handles = [Patch(color=colour, label=name) for name, colour in COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False, title="A decision is altered by")
    figure.savefig(to, dpi=130)


if __name__ == "__main__":
    main()
