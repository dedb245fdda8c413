"""Cells of the paper's tables: what is trained for each, where it is kept, and which of them are there.

A *cell* is one training: data set, system, form of its first layer, epochs, seed. Its network is
``FOLDER/networks/NAME.pt``, an ordinary checkpoint of ``spikeloom train``; what was measured on it is
``FOLDER/cells/NAME.json``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.formats.atomic import write_atomically
from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, SYSTEMS, TACTILESGNET
from spikeloom.models.graphs import MAX_NEIGHBOURS
from spikeloom.models.systems import NO_GRAPH, PADDINGS
from spikeloom.models.training.schedule import DECAY_EPOCHS, EPOCHS

Json = dict[str, Any]

FORMAT = 1
"""Of a cell's file; goes up when its figures mean something else."""

NO_PADDING, SAME_PADDING = PADDINGS

KEYS = frozenset({"data_sha256", "decay_epochs", "test_samples", "last", "best", "clean", "chip"})
"""Of a cell's file, beside format, row and seed."""

ENERGIES = ("davies2018", "sanafe")
"""Tables that a cell's energies are priced by."""

TABLES = ("methods", "graphs")

METHODS = ((TACTILESGNET, "manual"), (GRID_CNN, NO_PADDING), (MLP, NO_GRAPH), (GCN, "manual"))
"""System, and form of its first layer: graph, or padding of a grid-based CNN; in the order of the paper's table."""

RADII = ("0", "2", "2.5", "3", "3.5", "4")
"""Sigma of the spanning trees with all pairs nearer than it, in millimetres."""

GRAPHS = (
    "manual",
    *(f"knn:{k}" for k in range(1, MAX_NEIGHBOURS + 1)),
    *(f"mst:{radius}" for radius in RADII),
)

SAME_AS = {"mst:1.5": "mst:0"}
"""A graph of the paper whose pairs are those of another on this sensor, so that one row stands for both: no two taxels
nearer than 1.5 mm are left unjoined by the tree. The released list of ``mst:1.5`` repeats four of them, see
``--graph released:mst:1.5``."""

SEEDS = {"methods": 5, "graphs": 3}
GRID_SEEDS = 3
"""Of a grid-based CNN, whose epochs take longest."""

SHORT_EPOCHS = {"methods": EPOCHS, "graphs": 60}
"""Of the graphs, the beginning of a whole training: its learning rate falls after 40 epochs, most best epochs come soon
after that."""
FULL_SEEDS = 10
"""As many as the paper has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One row of a table on one data set: a cell for each seed.

    Parameters
    ----------
    data : str
        Data set.
    system : str
        One of :data:`spikeloom.compiler.systems.SYSTEMS`.
    form : str
        Graph as ``--graph`` names it, padding of a grid-based CNN, or ``none``.
    epochs : int
        Of each training.
    """

    data: str
    system: str
    form: str
    epochs: int

    def cell(self, seed: int) -> str:
        """Name of a cell.

        Examples
        --------
        >>> Row(data="objects", system="tactilesgnet", form="mst:1.5", epochs=30).cell(2)
        'objects-tactilesgnet-mst-1.5-e30-s2'
        """
        return f"{self.data}-{self.system}-{file_safe(self.form)}-e{self.epochs}-s{seed}"

    def words(self) -> list[str]:
        """Options of ``train`` that name its system and schedule."""
        words = [] if self.system == TACTILESGNET else ["--system", self.system]
        words += ["--graph", self.form] if self.system in GRAPH_SYSTEMS else []
        words += ["--padding", self.form] if self.form == SAME_PADDING else []
        return [*words, "--epochs", str(self.epochs)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A table to make: its rows, in order, and the seeds of each.

    Parameters
    ----------
    table : str
        One of ``TABLES``.
    epochs : int
        Of every training.
    seeds : mapping of Row to int
        Planned seeds, counted from 0.
    usual : mapping of str to int
        Seeds that a row of each system has, for rows that are there without being planned.
    """

    table: str
    epochs: int
    seeds: Mapping[Row, int]
    usual: Mapping[str, int]

    def cells(self) -> list[str]:
        """Names of all planned cells."""
        return [row.cell(seed) for row, seeds in self.seeds.items() for seed in range(seeds)]


def file_safe(name: str) -> str:
    """What may stand in a file name.

    Examples
    --------
    >>> file_safe("released:knn:4"), file_safe("mst:2.5")
    ('released-knn-4', 'mst-2.5')
    """
    return re.sub(r"[^A-Za-z0-9.]+", "-", name).strip("-.")


def plan(
    data: Iterable[str],
    tables: Sequence[str],
    *,
    seeds: int | None = None,
    epochs: int | None = None,
    full: bool = False,
    same_padding: bool = False,
    graphs: Sequence[str] = GRAPHS,
) -> tuple[Part, ...]:
    """Rows of the tables that are asked for.

    Parameters
    ----------
    data : iterable of str
        Names of the data sets.
    tables : sequence of str
        Of ``TABLES``.
    seeds, epochs : int, optional
        Instead of those that a table usually has.
    full : bool
        As many seeds and epochs as the paper has.
    same_padding : bool
        A grid-based CNN that keeps the size of the grid, too.
    graphs : sequence of str
        Rows of the table of graphs.
    """
    names = tuple(data)
    parts = []
    for table in tables:
        length = EPOCHS if full else epochs or SHORT_EPOCHS[table]
        forms = [(TACTILESGNET, graph) for graph in graphs]
        if table == "methods":
            forms = [*METHODS[:2], *([(GRID_CNN, SAME_PADDING)] if same_padding else []), *METHODS[2:]]
        usual = {
            system: FULL_SEEDS if full else seeds or (GRID_SEEDS if system == GRID_CNN else SEEDS[table])
            for system in SYSTEMS
        }
        planned = {
            Row(data=name, system=system, form=form, epochs=length): usual[system]
            for name in names
            for system, form in forms
        }
        parts.append(Part(table=table, epochs=length, seeds=planned, usual=usual))
    return tuple(parts)


def in_turn(parts: Iterable[Part]) -> list[tuple[Row, int]]:
    """Row and seed of every planned cell, each once: the first seed of all rows, then the second, and so on."""
    planned = {(row, seed): None for part in parts for row, seeds in part.seeds.items() for seed in range(seeds)}
    return sorted(planned, key=lambda cell: cell[1])


# -- files -------------------------------------------------------------------------------------------------------------


def cell_file(folder: Path, name: str) -> Path:
    """Where the figures of a cell are kept."""
    return folder / "cells" / f"{name}.json"


def network_file(folder: Path, name: str) -> Path:
    """Where the network of a cell is kept."""
    return folder / "networks" / f"{name}.pt"


def write_cell(path: Path, found: Json) -> None:
    """Keep the figures of a cell, whole or not at all."""
    with write_atomically(path) as file:
        file.write((json.dumps(found, indent=1, allow_nan=False) + "\n").encode())


def read_cells(folder: Path) -> dict[str, Json]:
    """Figures of all cells in a folder, by name.

    Raises
    ------
    DataError
        If a file there is damaged, of another version, or bears the name of another cell, or if two data sets bear
        one name.
    """
    found: dict[str, Json] = {}
    first: dict[str, Json] = {}
    for file in sorted((folder / "cells").glob("*.json")):
        try:
            cell = json.loads(file.read_text("utf-8"))
            known = cell["format"] == FORMAT and row_of(cell).cell(cell["seed"]) == file.stem and set(cell) >= KEYS
            known = known and cell["decay_epochs"] == DECAY_EPOCHS and _adds_up(cell)
        except (OSError, ValueError, KeyError, TypeError):
            known = False
        if not known:
            raise DataError(f"{file}: no cell of that name, or one of another version; delete it to measure anew")
        other = first.setdefault(cell["data"], cell)
        if cell["data_sha256"] != other["data_sha256"]:
            raise DataError(
                f"{file}: is of other recordings named {cell['data']} than {row_of(other).cell(other['seed'])}; "
                "keep those of one data set"
            )
        found[file.stem] = cell
    return found


def _adds_up(cell: Json) -> bool:
    """Whether the figures of a cell are there, and shares of its test recordings."""
    samples, chip = cell["test_samples"], cell["chip"]
    held = [cell[which] for which in ("last", "best", "clean")]
    right = [figures["correct"] for figures in held]
    if "refused" not in chip:
        both = [chip[which] for which in ("last", "clean")]
        right += [figures[key] for figures in both for key in ("correct", "equal")]
        right += [figures["without_quiet"][key] for figures in both for key in ("correct", "equal_to_chip")]
        energies = [figures[key] for figures in both for key in ("energy_j", "first_layer_energy_j")]
        energies += [figures["without_quiet"]["energy_j"] for figures in both]
        if any(set(energy) != set(ENERGIES) for energy in energies):
            return False
    shares = all(figures["accuracy"] == figures["correct"] / samples for figures in held)
    return shares and all(type(count) is int and 0 <= count <= samples for count in right)


def row_of(cell: Mapping[str, Any]) -> Row:
    """Row that a cell belongs to."""
    return Row(data=cell["data"], system=cell["system"], form=cell["form"], epochs=cell["epochs"])


def data_name(path: str) -> str:
    """What a data set is called, from what names its file.

    Examples
    --------
    >>> data_name("../data/Ev-Objects.zip"), data_name("synthetic"), data_name("my grasps/")
    ('objects', 'synthetic', 'my-grasps')
    """
    stem = Path(path).name.lower().removesuffix(".zip").removeprefix("ev-")
    return file_safe(stem).replace(".", "-") or "data"
