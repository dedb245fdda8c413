"""Votes of RANC's own C++ simulator beside ours, from what ``export --to ranc`` writes, on the first test recordings.

``python benchmarks/ranc_simulator.py RANC_SIM OUT.json NET.loom=DATA …``
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from made import made

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.files import sha256_of, write_atomically
from spikeloom.compiler.formats import ranc
from spikeloom.compiler.targets.truenorth.netlist import read_crossbars
from spikeloom.models.recordings.events import load_data, of_length
from spikeloom.models.recordings.evtouch import data_digest
from spikeloom.runtime.machines.truenorth.machine import TrueNorth


def compared(simulator: Path, path: str, data: str, limit: int) -> dict[str, Any]:
    """Votes of every tick of the first recordings, and how many differ."""
    netlist = read_crossbars(path)
    machine, voters = TrueNorth(netlist), np.flatnonzero(netlist.readout_class >= 0)
    test = of_length(load_data(data, "test", taxels=netlist.taxels), netlist.clocks.length)
    votes = differing = 0
    for index in range(limit):
        events = with_clocks(test.events[index : index + 1, ..., : test.steps_of(index)], netlist.clocks)[0]
        spikes = machine.simulate(events[None], spikes=True).spikes[0][:, voters]
        with tempfile.TemporaryDirectory() as folder:
            given, out = (str(Path(folder) / name) for name in ("net.json", "out.csv"))
            Path(given).write_text("\n".join(ranc.export(netlist, events)), "utf-8")
            words = [str(simulator.resolve()), given, out, given, str(len(spikes) + 1)]
            subprocess.run(words, check=True, capture_output=True)
            lines = Path(out).read_text("utf-8-sig").splitlines()[1:]
        theirs = np.array([line.split() for line in lines if line.strip()], int)[:, : len(voters)]
        votes += int(spikes.sum())
        differing += int(np.count_nonzero(theirs != spikes))
    return {"recordings": limit, "votes": votes, "differing": differing, "netlist_sha256": sha256_of(path)}


def main() -> None:
    """Compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("simulator", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("networks", nargs="+", metavar="NET.loom=DATA")
    parser.add_argument("--limit", type=int, default=20)
    asked = parser.parse_args()
    pairs = [network.split("=", 1) for network in asked.networks]
    found: dict[str, Any] = made() | {"data_sha256": {}, "networks": {}}
    for path, data in pairs:
        found["networks"][Path(path).stem] = compared(asked.simulator, path, data, asked.limit)
        found["data_sha256"][data] = data_digest(
            *(load_data(data, split, taxels=39) for split in ("train", "test"))
        )
    with write_atomically(asked.output) as file:
        file.write((json.dumps(found, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
