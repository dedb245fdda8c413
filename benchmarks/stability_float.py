"""Which decisions of the float model hold: what ``spikeloom certify`` decides, of the floats beside a netlist.

    python benchmarks/stability_float.py NETWORK NETLIST.loom DATA OUT.json [--limit N]

The float rule in float32 (:func:`interpret.float_simulation`); each change is run from the first step to the last:
half a minute for a recording of Objects.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import float_simulation
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.inputs.files import shipped
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.base import machine_for
from spikeloom.runtime.machines.changes import Changes, Effects, by_running
from spikeloom.runtime.report.encode import write_json
from spikeloom.runtime.studies.stability.study import stability


class Floats:
    """The float model, as far as :func:`stability` asks a machine."""

    layers = ()

    def __init__(self, network: Any, netlist: Any) -> None:
        self.netlist, self.readout = netlist, network.readout
        self.model = float_simulation(network, np.float32)

    def require_sensor(self, _events: Any) -> None:
        """It is the netlist's."""

    def forgetting(self, _channels: Any) -> None:
        """Of several events nothing is proven."""

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
    """Run, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("network")
    parser.add_argument("netlist")
    parser.add_argument("recordings")
    parser.add_argument("output")
    parser.add_argument("--limit", type=int, metavar="N", help="the first N recordings")
    arguments = parser.parse_args()
    netlist = machine_for(arguments.netlist).netlist
    checkpoint = read_checkpoint(shipped(arguments.network), weights=netlist.provenance["weights"])
    _, seen = propagation(checkpoint, build_graph(netlist.provenance["graph"]), arguments.network)
    machine: Any = Floats(expand(checkpoint, seen), netlist)
    data = load_data(arguments.recordings, "test")
    write_json(arguments.output, stability(machine, data.part(slice(arguments.limit)), jobs=1))


if __name__ == "__main__":
    main()
