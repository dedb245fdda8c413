"""How often votes that end early would have ended otherwise, over several networks of one data set.

    python benchmarks/anytime_seeds.py Ev-Objects.zip s0.pt s1.pt s2.pt s3.pt s4.pt

Compares factors calibrated on races for second place (what ``spikeloom anytime`` does) with factors calibrated on the
votes of the training recordings themselves.
"""

from __future__ import annotations

import argparse

import numpy as np

from spikeloom.compiler import compile_network
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.compiler.passes.expand import expand
from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.commands.choose.anytime import ALLOWED
from spikeloom.runtime.inputs.network import propagation
from spikeloom.runtime.machines.base import machine_of
from spikeloom.runtime.machines.integer import integer_machine
from spikeloom.runtime.report.sections import Table
from spikeloom.runtime.studies.anytime import exits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("checkpoint", nargs="+")
    arguments = parser.parse_args()
    splits = [load_data(arguments.data, split) for split in ("train", "test")]
    lengths = [np.full(len(data), data.steps) for data in splits]
    found: dict[tuple[str, float], list[tuple[float, int, int]]] = {}
    for path in arguments.checkpoint:
        checkpoint = read_checkpoint(path)
        netlist = compile_network(expand(checkpoint, propagation(checkpoint, None, path)[1])).netlist
        seen, reported = (
            integer_machine(machine_of(netlist)).cumulative(data.events, own).votes
            for data, own in zip(splits, lengths, strict=True)
        )
        at = exits.standing(reported, lengths[1])
        sure = exits.proven(reported, at, exits.most_votes(integer_machine(machine_of(netlist)), splits[1].steps))
        factors = {("proven", 0.0): np.inf}
        for name, race in (("races", exits.races(seen, lengths[0])), ("votes", exits.standing(seen, lengths[0]))):
            points = exits.turning_points(race)
            factors |= {(name, allowed): exits.calibrate(points, allowed).factor for allowed in ALLOWED}
        rows = np.arange(len(reported))
        for key, factor in factors.items():
            ends = exits.exits(sure, at, factor)
            early, depth = at.leader[rows, ends], integer_machine(machine_of(netlist)).read_out_lag
            saved = 1 - np.mean(ends + 1 + depth) / (splits[1].steps + netlist.max_depth)
            right = [np.count_nonzero(decided == splits[1].labels) for decided in (early, at.decision)]
            found.setdefault(key, []).append(
                (saved, int(np.count_nonzero(early != at.decision)), int(right[0] - right[1]))
            )
    total = len(splits[1]) * len(arguments.checkpoint)
    lines = []
    for (name, allowed), each in found.items():
        saved, differ, right = (np.array(column) for column in zip(*each, strict=True))
        told = "proven" if name == "proven" else f"calibrated on {name}, {100 * allowed:g} %"
        cells = [f"{100 * saved.mean():.1f} %", f"{differ.sum()} of {total}", f"{100 * differ.sum() / total:.2f} %"]
        lines.append([told, *cells, " ".join(f"{n:+d}" for n in right)])
    print(Table(["stop when", "steps saved", "differ", "", "right, each network"], lines))


if __name__ == "__main__":
    main()
