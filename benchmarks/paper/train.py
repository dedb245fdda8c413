"""Train and measure what the paper's tables lack: ``python benchmarks/paper/train.py Ev-Objects.zip -o FOLDER``.

Weeks of one core for all 132 cells. Networks are kept in FOLDER/networks and are gone on with when the script is run
again; figures go to FOLDER/cells.json, from which ``tables.py`` makes the tables.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

from cells import EPOCHS, Cell, Row, planned, read_cells, write_cells
from joblib import Parallel, delayed
from measured import measure

from spikeloom.compiler.files import sha256_of
from spikeloom.compiler.formats.checkpoint_reader import read_checkpoint
from spikeloom.models.recordings.events import load_data

KEPT = (
    "command",
    "data_sha256",
    "test_samples",
    "best",
    "last",
    "clean",
    "validation",
    "spikeloom",
    "torch",
    "numpy",
)


def make(row: Row, seed: int, data: str, network: Path) -> tuple[str, Cell]:
    """Train a cell, or take over its network, and measure it."""
    if not network.exists():
        resume = ["--resume"] if list(network.parent.glob(f"{network.name}.state*")) else []
        words = ["train", "--data", data, *row.words(), "--seed", str(seed), *resume, "-o", str(network)]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        subprocess.run([sys.executable, "-m", "spikeloom", *words], check=True, env=environment)
    record = read_checkpoint(network).training or {}
    splits = (load_data(data, split) for split in ("train", "test"))
    found = {"data": row.data, "system": row.system, "form": row.form, "epochs": row.epochs, "seed": seed}
    found |= {key: record[key] for key in KEPT}
    found["checkpoint_sha256"] = sha256_of(network)
    return row.cell(seed), found | {"chip": measure(network, *splits)}


def main() -> None:
    """Make all cells that are not there, the first seed of each row first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", nargs="+", help="Ev-Objects.zip, Ev-Containers.zip")
    parser.add_argument("--table", choices=tuple(EPOCHS), help="one of the two tables")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (default: one a core)")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    networks = arguments.output / "networks"
    networks.mkdir(parents=True, exist_ok=True)
    paths = {Path(path).stem.lower().removeprefix("ev-"): path for path in arguments.data}
    cells = read_cells(arguments.output)
    rows = [
        row
        for table in EPOCHS
        if arguments.table in (None, table)
        for row in planned(table, tuple(paths)).items()
    ]
    wanted = sorted(((seed, row) for row, seeds in rows for seed in range(seeds)), key=lambda cell: cell[0])
    work = [
        delayed(make)(row, seed, paths[row.data], networks / f"{row.cell(seed)}.pt")
        for seed, row in wanted
        if row.cell(seed) not in cells
    ]
    for name, cell in Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(work):
        cells[name] = cell
        write_cells(arguments.output, cells)
        print(f"{len(cells)} of {len(wanted)}: {name}")


if __name__ == "__main__":
    main()
