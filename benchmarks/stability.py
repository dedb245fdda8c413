"""Decisions that no small change alters, by ``spikeloom certify``, in short; and quick runs held against whole ones.

    python benchmarks/stability.py DATA OUT.json [--picture OUT.png] [--brute]

`--picture` draws how many decisions of the first network depend on each taxel; `--brute` runs every single event
changed of its first three recordings from the first step to the last, and counts where the quick runs differ. Files are
read from the folder in which it runs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from figures import Session
from made import made
from PIL import Image

from spikeloom.models.recordings.events import load_data
from spikeloom.runtime.machines.backends import machine_for
from spikeloom.runtime.machines.changes import by_running, single
from spikeloom.runtime.report.encode import read_json
from spikeloom.runtime.studies.robustness.certify_sections import hanging_on
from spikeloom.runtime.studies.robustness.perturbations import EXHAUSTIVE
from spikeloom.runtime.studies.robustness.proofs.entries import cells_of, channels_of
from spikeloom.runtime.studies.robustness.results import PHASES, Certificates

Json = dict[str, Any]


NETWORKS = {  # Command that makes each
    "Ev-Objects.zip": {
        "released": "compile objects_manual.t7 --graph manual --calibrate Ev-Objects.zip",
        "counters": "compile pretrained:objects-counters",
    },
    "Ev-Containers.zip": {
        "shipped": "compile pretrained:containers",
        "counters": "compile pretrained:containers-counters",
    },
}


def main() -> None:
    """Compile, certify, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", choices=NETWORKS)
    parser.add_argument("output", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--brute", action="store_true")
    arguments = parser.parse_args()
    data = arguments.recordings
    test = load_data(data, "test")
    found: Json = made(load_data(data, "train"), test) | {"data": data}
    with tempfile.TemporaryDirectory() as folder:
        session = Session(Path.cwd(), Path(folder))
        results = {}
        for name, words in NETWORKS[data].items():
            first = not results
            session.run(f"{words} -o {name}.loom")
            results[name] = verdicts(session, name, data, "--picture taxels.png" if first else "")
            if first and arguments.picture:
                drawn = Image.open(session.folder / "taxels.png")
                drawn.convert("RGB").quantize(128).save(arguments.picture, optimize=True)
            if first and arguments.brute:
                found["brute_force"] = brute_force(str(session.folder / f"{name}.loom"), test)
    found["commands"] = session.commands
    found["networks"] = {name: summary(result) for name, result in results.items()}
    found["fall"] = {kind: fallen(list(results.values()), kind) for kind in EXHAUSTIVE}
    arguments.output.write_text(json.dumps(found, indent=1) + "\n")


def verdicts(session: Session, name: str, data: str, options: str = "") -> Certificates:
    """What ``certify`` says of a netlist in the folder of a session."""
    session.run(f"certify {name}.loom --data {data} {options}".rstrip() + f" -o {name}.json")
    return read_json(Certificates, session.folder / f"{name}.json", "certify", "spikeloom certify -o")


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
