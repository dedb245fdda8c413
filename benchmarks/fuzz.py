"""Damaged files for every reader of ``tests/readers.py`` and for commands: how many are read, or refused in one line.

An output that is there already goes on where it ended, if the same command wrote it.
"""

import argparse
import json
import os
import sys
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from made import made
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import readers

KEYS = "tried", "read", "refused", "did_not"

ROUNDS = 40
"""After each of which the output is written."""


def run(name: str, seeds: range) -> dict[str, Any]:
    """Outcomes of a reader, and the first inputs that should not be."""
    row: dict[str, Any] = dict.fromkeys(KEYS, 0) | {"first": {}}
    for seed in seeds:
        said = readers.outcome(name, *readers.damaged(name, seed))
        row["tried"] += 1
        row[said if said in KEYS else "did_not"] += 1
        if said not in KEYS:
            row["first"][f"{name} {seed}"] = said
    return row


def in_a_folder() -> None:
    """Work in a folder of one's own."""
    warnings.simplefilter("ignore")
    os.chdir(tempfile.mkdtemp())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--inputs", type=int, default=100_000, help="of all readers together")
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    output, facts, names = arguments.output.absolute(), made(), list(readers.READERS)
    whole = sum(each.share for each in readers.READERS.values())
    each = [int(arguments.inputs * reader.share / whole / ROUNDS) + 1 for reader in readers.READERS.values()]
    found = json.loads(output.read_text()) if output.exists() else {}
    if any(found.get(key) != value for key, value in facts.items()):
        found = facts | {"first": {}, "readers": {name: dict.fromkeys(KEYS, 0) for name in names}}
    done = found["readers"][names[0]]["tried"] // each[0]
    with ProcessPoolExecutor(arguments.jobs, initializer=in_a_folder) as pool:
        for turn in tqdm(range(done, ROUNDS), initial=done, total=ROUNDS, disable=None):
            seeds = [range(turn * count, (turn + 1) * count) for count in each]
            for name, row in zip(names, pool.map(run, names, seeds), strict=True):
                found["readers"][name] = {key: found["readers"][name][key] + row[key] for key in KEYS}
                found["first"].update(row["first"])
            sums = {key: sum(row[key] for row in found["readers"].values()) for key in KEYS}
            table = found.pop("readers")
            found |= sums | {"readers": table}
            output.write_text(json.dumps(found, indent=1) + "\n")
