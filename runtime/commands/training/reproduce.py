"""The command ``reproduce``: both tables of the paper, cell by cell, from whatever is there already."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.models.graphs import NEUTOUCH, build_graph
from spikeloom.models.recordings.events import BIN_S
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.schedule import EPOCHS
from spikeloom.runtime.commands.options import DATA_HELP
from spikeloom.runtime.studies.jobs.sweep import add_place_arguments, require_place_to_work
from spikeloom.runtime.studies.paper import noise as paper_noise
from spikeloom.runtime.studies.paper import picture as paper_picture
from spikeloom.runtime.studies.paper import table as paper_table
from spikeloom.runtime.studies.paper import text as paper_text
from spikeloom.runtime.studies.paper.cell_work import Work, make
from spikeloom.runtime.studies.paper.cells import (
    FULL_SEEDS,
    GRAPHS,
    SAME_AS,
    SHORT_EPOCHS,
    TABLES,
    Part,
    Row,
    cell_file,
    data_name,
    in_turn,
    network_file,
    plan,
    read_cells,
)

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DataSet:
    """Recordings that were asked for.

    Parameters
    ----------
    path : str
        As typed.
    training, test : Recordings
        Both splits.
    sha256 : str
        Over both.
    """

    path: str
    training: Recordings
    test: Recordings
    sha256: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the options of the command."""
    parser.add_argument("--data", action="append", default=[], metavar="PATH", help=f"may be repeated: {DATA_HELP}")
    parser.add_argument("--table", metavar="|".join(TABLES), help="one table (default: both)")
    parser.add_argument(
        "--graph",
        action="append",
        metavar="NAME",
        help=f"row of the graphs' table; may be repeated (default: {len(GRAPHS)})",
    )
    parser.add_argument("--same-padding", action="store_true", help="a grid-cnn of same padding too, 15,808 neurons")
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="trainings a row (default: methods 5, grid-cnn 3, graphs 3)"
    )
    parser.add_argument(
        "--epochs",
        type=int,
        metavar="N",
        help="of each training, the rate falls every 40 (default: {methods} and {graphs})".format(**SHORT_EPOCHS),
    )
    parser.add_argument("--full", action="store_true", help=f"{FULL_SEEDS} seeds of {EPOCHS} epochs, as in the paper")
    parser.add_argument("--resume", action="store_true", help="go on with what the folder holds of this")
    parser.add_argument(
        "--no-train", action="store_true", help="measure networks that are finished and rebuild the tables, no more"
    )
    add_place_arguments(parser, "; they read --data and write to -o by the same paths, so share both folders")
    parser.add_argument("--device", default="cpu", help="to train on: cpu or cuda (default: cpu)")
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER")


def run(arguments: argparse.Namespace) -> tuple[Json, Callable[[Json], str], int]:
    """Run the command; exit code 1 where trainings are missing in the end.

    Raises
    ------
    SpikeloomError
        If an option, the recordings or what the folder holds cannot be used.
    KeyboardInterrupt
        On an interrupt or a request to end; its text says what is kept.
    """
    graphs = _check(arguments)
    folder = Path(arguments.output)
    known = read_cells(folder)
    sets = _data_sets(arguments.data)
    _require_same_data(folder, known, sets)
    there = sorted({cell["data"] for cell in known.values()})
    if not sets and not there:
        raise OptionError(f"-o {arguments.output}: holds no cells to make tables of; name a data set with --data")
    parts = _plan(arguments, sets or there, graphs)
    shown = _plan(arguments, dict.fromkeys([*sets, *there]), graphs)
    cells = in_turn(parts)
    wanted = [(row, seed) for row, seed in cells if row.cell(seed) not in known and row.data in sets]
    work = _work(arguments, folder, sets, wanted)
    _require_resume(arguments, folder, [row.cell(seed) for row, seed in cells], work)
    if arguments.no_train:
        from spikeloom.runtime.studies.training.seeds import finished

        work = [each for each in work if finished(each.job)]
    for name in ("cells", "networks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    known_already = sum(row.cell(seed) in known for row, seed in cells)
    make(
        work,
        folder,
        there=known_already,
        planned=len(cells),
        jobs=arguments.jobs,
        scheduler=arguments.scheduler,
        after=lambda: write_tables(folder, shown, pictures=False),
    )
    report = write_tables(folder, shown, pictures=True) | _completeness(folder, parts)
    return report, paper_text.terminal, 1 if report["missing"] else 0


def _plan(arguments: argparse.Namespace, names: Iterable[str], graphs: Sequence[str]) -> tuple[Part, ...]:
    """What the options ask for on some data sets."""
    return plan(
        names,
        [arguments.table] if arguments.table else TABLES,
        seeds=arguments.seeds,
        epochs=arguments.epochs,
        full=arguments.full,
        same_padding=arguments.same_padding,
        graphs=graphs,
    )


def _check(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Refuse options that cannot be meant; return the graphs by their canonical names."""
    from spikeloom.models.training.train import require_device

    require_device(arguments.device)
    require_place_to_work(arguments.jobs, arguments.scheduler)
    for option in ("seeds", "epochs"):
        value = getattr(arguments, option)
        if value is not None and value < 1:
            raise OptionError(f"--{option} {value}: allowed are 1 or more; choose another")
        if value is not None and arguments.full:
            raise OptionError(f"--{option} {value}: --full says how many; leave one of them away")
    if arguments.table is not None and arguments.table not in TABLES:
        raise OptionError(f"--table {arguments.table}: unknown; choose from {', '.join(TABLES)}")
    if arguments.graph and arguments.table == "methods":
        raise OptionError("--graph: chooses rows of the table of graphs; leave it or --table methods away")
    if arguments.same_padding and arguments.table == "graphs":
        raise OptionError("--same-padding: adds a row to the table of methods; leave it or --table graphs away")
    if not arguments.data and not arguments.no_train:
        raise OptionError("reproduce: no data set; name one or more with --data")
    place = Path(arguments.output)
    if place.exists() and not place.is_dir():
        raise OptionError(f"-o {arguments.output}: is not a folder; give the name of one")
    if not place.absolute().parent.is_dir():
        raise OptionError(f"-o {arguments.output}: the folder that it shall be in does not exist; make it first")
    names = [build_graph(name).name for name in arguments.graph or GRAPHS]
    return tuple(dict.fromkeys(SAME_AS.get(name, name) for name in names))


def _data_sets(paths: Sequence[str]) -> dict[str, DataSet]:
    """Read the recordings; by the names that their cells bear."""
    from spikeloom.models.training.protocols import data_digest
    from spikeloom.runtime.commands.training.train import both_splits

    found: dict[str, DataSet] = {}
    for path in paths:
        name = data_name(path)
        if name in found:
            raise OptionError(f"--data {path}: is called {name} as {found[name].path} is; give each data set once")
        training, test = both_splits(path, len(NEUTOUCH), BIN_S)
        found[name] = DataSet(path=path, training=training, test=test, sha256=data_digest(training, test))
    return found


def _require_same_data(folder: Path, known: Mapping[str, Json], sets: Mapping[str, DataSet]) -> None:
    """Refuse to mix cells of different recordings under one name."""
    for name, cell in known.items():
        data = cell["data"]
        if data in sets and cell["data_sha256"] != sets[data].sha256:
            raise DataError(
                f"{cell_file(folder, name)}: is of other recordings named {data}; give those, or another -o"
            )


def _work(
    arguments: argparse.Namespace, folder: Path, sets: Mapping[str, DataSet], wanted: Iterable[tuple[Row, int]]
) -> list[Work]:
    """Every cell that is not there, its training as ``spikeloom train`` would do it."""
    from spikeloom.runtime.cli import build_parser
    from spikeloom.runtime.commands.training.train import planned

    parser, found = build_parser(), list[Work]()
    for row, seed in wanted:
        data = sets[row.data]
        name = row.cell(seed)
        words = ["train", "--data", data.path, *row.words(), "--seed", str(seed), "--device", arguments.device]
        words += ["-o", str(network_file(folder, name)), "--resume"]
        (job,) = planned(parser.parse_args(words), data.training, data.test)
        job = replace(job, position=len(found) % (arguments.jobs or os.cpu_count() or 1))  # of its progress bar
        place = cell_file(folder, name)
        found.append(Work(row=row, seed=seed, job=job, place=place, data=data.path, sha256=data.sha256))
    return found


def _require_resume(arguments: argparse.Namespace, folder: Path, cells: Sequence[str], work: Sequence[Work]) -> None:
    """Go on only where that was asked for."""
    from spikeloom.runtime.studies.training.seeds import states

    if arguments.resume or arguments.no_train:
        return
    there = sum(cell_file(folder, name).exists() for name in cells)
    begun = sum(bool(states(each.job)) or each.output.exists() for each in work)
    if there or begun:
        raise OptionError(
            f"-o {arguments.output}: holds {there} of these cells and {begun} more that are begun; go on with "
            "--resume, or give another folder"
        )


# -- tables ------------------------------------------------------------------------------------------------------------


def write_tables(folder: Path, parts: Sequence[Part], *, pictures: bool) -> Json:
    """Rebuild the tables from the cells that are there, and say what they hold.

    Returns
    -------
    dict
        ``methods`` and ``graphs``: rows; ``methods_differences``, ``graphs_differences``; ``schedule``; ``elsewhere``:
        cells of no row; ``files``.
    """
    cells = read_cells(folder)
    report: Json = {}
    files: dict[str, bytes] = {}
    shown: set[str] = set()
    for part in parts:
        rows = paper_table.rows(part, cells)
        shown |= {name for row in rows for name in row["cells"]}
        noise = paper_noise.differences(rows)
        shorter = paper_table.schedules(cells, part.epochs) if part.table == "graphs" else []
        report |= {part.table: rows, f"{part.table}_differences": noise}
        report |= {"schedule": shorter} if part.table == "graphs" else {}
        files[f"{part.table}.csv"] = paper_text.csv_text(rows).encode()
        files[f"{part.table}.md"] = paper_text.markdown(part.table, part.epochs, rows, noise, shorter).encode()
        if pictures:
            files |= paper_picture.pictures(part.table, rows)
    report["elsewhere"] = len(cells.keys() - shown)
    report["files"] = [str(folder / name) for name in files]
    for name, content in files.items():
        with write_atomically(folder / name) as file:
            file.write(content)
    return report


def _completeness(folder: Path, parts: Sequence[Part]) -> Json:
    """How many cells were asked for, how many are there, and the names of the others."""
    names = list(dict.fromkeys(name for part in parts for name in part.cells()))
    missing = [name for name in names if not cell_file(folder, name).exists()]
    return {"planned": len(names), "finished": len(names) - len(missing), "missing": missing}
