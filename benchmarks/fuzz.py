"""Damaged files for every reader of ``tests/readers.py``: how many are read, or refused in one line, or neither."""

import argparse
import json
import os
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

from made import made
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import readers

KEYS = "tried", "read", "refused", "did_not"

ROUNDS = 20
"""After each of which the output is written."""


def run(name: str, seeds: range, row: dict[str, Any]) -> None:
    """Add outcomes of a reader to its row, and the first inputs that should not be."""
    for seed in tqdm(seeds, name, disable=None):
        said = readers.outcome(name, *readers.damaged(name, seed))
        row["tried"] += 1
        row[said if said in row else "did_not"] += 1
        if said not in row and len(row.setdefault("first", {})) < 5:
            row["first"][seed] = said


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--inputs", type=int, default=100_000, help="of all readers together")
    arguments = parser.parse_args()
    output, facts, shares = arguments.output.absolute(), made(), sum(each.share for each in readers.READERS.values())
    warnings.simplefilter("ignore")
    table = {name: dict.fromkeys(KEYS, 0) for name in readers.READERS}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for name in readers.READERS:  # kernels compile
            readers.meant(name, 0)
        for turn in range(ROUNDS):
            for name, reader in readers.READERS.items():
                each = int(arguments.inputs * reader.share / shares / ROUNDS) + 1
                run(name, range(turn * each, (turn + 1) * each), table[name])
            sums = {key: sum(row[key] for row in table.values()) for key in KEYS}
            output.write_text(json.dumps(facts | sums | {"readers": table}, indent=1) + "\n")
