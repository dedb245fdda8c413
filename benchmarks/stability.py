"""What ``spikeloom certify`` found on networks, in short; and quick runs held against whole ones.

    python benchmarks/stability.py DATA OUT.json --verdicts 'released=objects-verdicts.json' … [--brute objects.loom]

`--verdicts` are what ``certify -o`` wrote; `--brute` runs every single event changed of the first three recordings from
the first step to the last, and counts where the quick runs differ.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import Counter
from pathlib import Path
from typing import Any

from made import made

from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.changes import by_running, single
from spikeloom.runtime.report.encode import read_json
from spikeloom.runtime.studies.robustness.certify_sections import hanging_on
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of
from spikeloom.runtime.studies.robustness.results import PHASES, Certificates

Json = dict[str, Any]


def main() -> None:
    """Read verdicts, run, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings")
    parser.add_argument("output", type=Path)
    parser.add_argument("--verdicts", nargs="+", default=[], metavar="NAME=FILE")
    parser.add_argument("--brute", metavar="FILE")
    arguments = parser.parse_args()
    test = load_data(arguments.recordings, "test")
    found: Json = made(load_data(arguments.recordings, "train"), test) | {
        "data": Path(arguments.recordings).name
    }
    results = {}
    for each in arguments.verdicts:
        name, _, file = each.partition("=")
        results[name] = read_json(Certificates, Path(file), "--verdicts", "spikeloom certify -o")
    found["networks"] = {name: summary(result) for name, result in results.items()}
    found["fall"] = {kind: fallen(list(results.values()), kind) for kind in EXHAUSTIVE}
    if arguments.brute:
        found["brute_force"] = brute_force(arguments.brute, test)
    arguments.output.write_text(json.dumps(found, indent=1) + "\n")


def fallen(results: list[Certificates], kind: str) -> Json:
    """Recordings whose decision some change of a kind alters in every network, and in some."""
    falls = [{each.file for each in result.certificates if each.kinds[kind].alter} for result in results]
    return {"in_all": len(set.intersection(*falls)), "in_some": len(set.union(*falls))}


def summary(result: Certificates) -> Json:
    """Counts over recordings, and a short line for each."""
    found = result.certificates
    sizes = {
        kind: [each.kinds[kind].least for each in found] for kind in ("shifted", "start cut", "end cut")
    }
    return {
        "recordings": len(found),
        "right": sum(each.right for each in found),
        "certified": {str(events): result.certified(events) for events in range(1, result.most + 1)},
        "least_certified": statistics.median(each.at_least for each in found),
        "exact": sum(each.exact for each in found),
        "attacked": sum(each.at_most is not None for each in found),
        "ratio": statistics.median(
            each.at_most / max(each.at_least + 1, 1) for each in found if each.at_most
        ),
        "stand": {kind: result.unaltered(kind) for kind in EXHAUSTIVE},
        "tried": {kind: sum(each.kinds[kind].tried for each in found) for kind in EXHAUSTIVE},
        "alter": {kind: sum(each.kinds[kind].alter for each in found) for kind in EXHAUSTIVE},
        "stand_sizes": {
            kind: statistics.median(999 if n is None else n for n in each) for kind, each in sizes.items()
        },
        "hanging": {kind: each.tolist() for kind, each in hanging_on(result).items()},
        "phases": [sum(each.phases[phase] for each in found) for phase in range(PHASES)],
        "fallen_by_label": Counter(str(each.label) for each in found if not each.at_least),
        "each": [
            [
                *(each.file, each.label, each.decision, each.ahead, each.at_least, each.at_most),
                *(each.kinds[kind].alter for kind in EXHAUSTIVE),
            ]
            for each in found
        ],
    }


def brute_force(file: str, test: Any, count: int = 3) -> Json:
    """Every single event changed of some recordings, quickly and from the first step to the last."""
    machine = machine_for(file)
    differ, tried, seconds = 0, 0, [0.0, 0.0]
    for index in range(count):
        events = test.events[index, ..., : test.steps_of(index)]
        channels = channels_of(events[None], machine.netlist)[0]
        changes = single(cells_of(events, machine.netlist).cells)
        machine.effects(channels, single(changes.cells[:1]))  # compiled by now
        begun = time.process_time()
        quick = machine.effects(channels, changes).votes
        between = time.process_time()
        slow = by_running(machine.votes, channels, changes).votes
        seconds[0] += between - begun
        seconds[1] += time.process_time() - between
        differ += int((quick != slow).sum())
        tried += len(slow)
    return {
        "recordings": count,
        "changes": tried,
        "differ": differ,
        "quick_s": seconds[0],
        "slow_s": seconds[1],
    }


if __name__ == "__main__":
    main()
