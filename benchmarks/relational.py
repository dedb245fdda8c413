"""Whether float model and chip decide alike whichever single event of a recording is added or removed: all are run.

    python benchmarks/relational.py Ev-Objects.zip relational.json --float objects_manual.t7 --chip NET.loom --every 12

The float model, in float32 (:func:`interpret.float_simulation`), runs each changed recording from the first step to
the last, half a minute a recording of Objects. What relational.json holds already is not run again.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import Simulation, float_simulation
from spikeloom.compiler.ir import Readout
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.changes import by_running, single
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of


def float_model(file: str, netlist: Any) -> tuple[Simulation, Readout]:
    """What a netlist was made of, and who votes."""
    checkpoint = read_checkpoint(shipped(file), weights=netlist.provenance["weights"])
    _, seen = propagation(checkpoint, build_graph(netlist.provenance["graph"]), file)
    network = expand(checkpoint, seen)
    return float_simulation(network, np.float32), network.readout


def row(machine: Any, model: Simulation, readout: Readout, events: Any, label: int) -> dict[str, int]:
    """How many single events there are; how many alter a decision, on each side; and with how many the sides differ.

    `right` is the float model's decision without any.
    """
    netlist = machine.netlist
    channels = channels_of(events[None], netlist)[0]
    cells = cells_of(events, netlist)
    changes = single(cells.cells[cells.cost == 1])  # a bin of several events is no single one

    def votes(runs: Any) -> Any:
        spikes = model.run(np.ascontiguousarray(runs.transpose(0, 2, 1)).astype(np.bool_)).spikes
        fired = spikes[readout.population].sum(axis=1)
        return np.stack([fired[:, readout.label == c].sum(axis=1) for c in range(netlist.classes)], axis=1)

    of_model = votes(channels[None])[0]
    of_chip = machine.votes(channels[None])[0]
    by_model = (by_running(votes, channels, changes).votes + of_model).argmax(axis=1)
    by_chip = (machine.effects(channels, changes).votes + of_chip).argmax(axis=1)
    return {
        "right": int(of_model.argmax() == label),
        "changes": len(by_chip),
        "alike_unchanged": int(of_model.argmax() == of_chip.argmax()),
        "differ": int(np.count_nonzero(by_model != by_chip)),
        "alter_model": int(np.count_nonzero(by_model != of_model.argmax())),
        "alter_chip": int(np.count_nonzero(by_chip != of_chip.argmax())),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--float", required=True, dest="model", metavar="NETWORK")
    parser.add_argument("--chip", required=True, metavar="NET.loom")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="of N test recordings the last")
    arguments = parser.parse_args()
    test = load_data(arguments.recordings, "test")
    machine = machine_for(arguments.chip)
    model, readout = float_model(arguments.model, machine.netlist)
    output = arguments.output
    each = json.loads(output.read_text())["each"] if output.exists() else {}
    for index in range(arguments.every - 1, len(test), arguments.every):
        events = test.events[index, ..., : test.steps_of(index)]
        each.setdefault(test.files[index], None)
        each[test.files[index]] = each[test.files[index]] or row(
            machine, model, readout, events, int(test.labels[index])
        )
        sums = {key: sum(one[key] for one in each.values()) for key in next(iter(each.values()))}
        alike = sum(one["alike_unchanged"] and not one["differ"] for one in each.values())
        unaltered = sum(not one["alter_model"] for one in each.values())
        found = {
            "recordings": len(each),
            "alike_for_every_event": alike,
            "unaltered_model": unaltered,
            "together": sums,
            "each": each,
        }
        output.write_text(
            json.dumps(made(load_data(arguments.recordings, "train"), test) | found, indent=1) + "\n"
        )
