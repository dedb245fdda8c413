"""How long the engine of crossbar cores takes for a recording, decisions and counts, on one thread.

    python benchmarks/truenorth_engine.py Ev-Objects.zip NET.loom … [--limit 20] [--rounds 5]

Files of ``compile --target truenorth``. Each runs as it is, and those of one tick a data step also with 20: events come
every 20 ticks, and all else goes on in between. Time is CPU time, of each recording the least of the rounds.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from spikeloom.compiler.dynamics import Clocks, with_clocks
from spikeloom.compiler.targets.truenorth.codebook import BIN_TICKS
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist, read_crossbars
from spikeloom.models.recordings.events import load_data
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.truenorth import engine
from spikeloom.runtime.report.sections import Table


def stretched(netlist: CrossbarNetlist) -> CrossbarNetlist:
    """The same network with 20 ticks a data step."""
    return replace(netlist, bin_ticks=BIN_TICKS)


def measured(netlist: CrossbarNetlist, data: Recordings, rounds: int) -> list[float]:
    """Milliseconds of CPU for each recording, the least of the rounds."""
    clocks: Clocks = netlist.clocks
    events, prepared = with_clocks(data.events, clocks), engine.prepare(netlist)
    engine.simulate(prepared, events[:1])
    found = np.full(len(data), np.inf)
    for _ in range(rounds):
        for index in range(len(data)):
            part = events[index : index + 1, :, : data.steps_of(index)]
            began = time.process_time()
            engine.simulate(prepared, part)
            found[index] = min(found[index], time.process_time() - began)
    return [1e3 * seconds for seconds in found.tolist()]


def main() -> None:
    """Print a table, one line a network and number of ticks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("netlists", nargs="+")
    parser.add_argument("--limit", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    data = load_data(arguments.data, "test", limit=arguments.limit)
    rows = []
    for name in arguments.netlists:
        netlist = read_crossbars(name)
        for own in (netlist, stretched(netlist)) if netlist.bin_ticks == 1 else (netlist,):
            found = measured(own, data, arguments.rounds)
            rows.append(
                [
                    Path(name).stem,
                    str(own.bin_ticks),
                    f"{own.n_cores}",
                    f"{own.n_neurons:,}",
                    f"{own.ticks(data.steps):,}",
                    f"{np.mean(found):.2f}",
                    f"{max(found):.2f}",
                ]
            )
    head = ["network", "ticks a step", "cores", "neurons", "ticks", "ms a recording", "slowest"]
    print(Table(head, rows))


if __name__ == "__main__":
    main()
