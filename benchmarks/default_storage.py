"""What the storage that ``compile --calibrate`` chooses keeps and costs, beside plain 8 bits, over several networks.

    python benchmarks/default_storage.py RECORDINGS NETWORK.pt=GRAPH... OUT.json

Storage and scales are chosen on the training split; the test split is decided once by each.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler import KEEP, Options, Packing, compile_network
from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.graphs import build_graph, normalised_adjacency
from spikeloom.models.networks.reference import float_spikes
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import BIN_S
from spikeloom.runtime.machines.backends import machine_of

SCHEMES: dict[str, dict[str, Any]] = {"8 bits": {"packings": (Packing(),)}, "default": {"keep": KEEP}}


def main() -> None:
    """Measure every network and store what was found."""
    recordings, *networks, output = sys.argv[1:]
    training, test = (load_data(recordings, split) for split in ("train", "test"))
    found: list[dict[str, Any]] = []
    for path, _, name in (each.partition("=") for each in networks):
        graph = build_graph(name)
        adjacency = normalised_adjacency(graph.edges, graph.n_taxels)
        checkpoint = read_checkpoint(path)
        model = vote(list(float_spikes(checkpoint, adjacency, test.events).values())[-1].sum(axis=1, dtype=np.int64))
        schemes: dict[str, Any] = {}
        for scheme, options in SCHEMES.items():
            done = compile_network(expand(checkpoint, adjacency), Options(training_events=training.events, **options))
            ran, price = machine_of(done.netlist).price(test.events, bin_s=test.bin_s or BIN_S)
            schemes[scheme] = {
                "predictions": ran.decisions.tolist(),
                "operations": float(price.synaptic_operations.mean()),
                "energy_davies2018": float(price.energy_j["davies2018"].mean()),
                "cores": done.netlist.n_cores,
                "storage": {key: done.netlist.provenance.get(key, 1) for key in ("planes", "scale_groups")},
                "equal": float(np.mean(ran.decisions == model)),
            }
        network = {"name": Path(path).stem, "sha256": checkpoint.sha256, "float": model.tolist(), "schemes": schemes}
        found.append(network)
        with write_atomically(Path(output)) as file:
            file.write(json.dumps(made(training, test) | {"networks": found}, indent=1).encode())


if __name__ == "__main__":
    main()
