"""Which trainings the paper's tables need, what the paper has, and ``cells.json``: what each training gave."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spikeloom.compiler.files import write_atomically
from spikeloom.compiler.systems import GCN, GRAPH_SYSTEMS, GRID_CNN, MLP, SYSTEMS, TACTILESGNET

Cell = dict[str, Any]

RESULTS = Path(__file__).parents[1] / "results" / "paper"
DATA = ("objects", "containers")
METHODS = ((TACTILESGNET, "manual"), (GRID_CNN, "none"), (MLP, "none"), (GCN, "manual"))
"""System, and its graph or the padding of its grid, in the order of the paper's table."""

GRAPHS = (
    "manual",
    *(f"knn:{k}" for k in range(1, 9)),
    "mst:0",
    "released:mst:1.5",
    *(f"mst:{radius}" for radius in ("2", "2.5", "3", "3.5", "4")),
)
"""The tree joins all taxels nearer than 1.5 mm: only the released list, with four edges twice, tells 1.5 from 0."""

SEEDS = {"methods": 5, "graphs": 3}
GRID_SEEDS = 3
EPOCHS = {"methods": 100, "graphs": 60}
"""The graphs' 60 are the beginning of a whole training: the learning rate falls after 40 in both."""

RUNS = 10
PUBLISHED: dict[tuple[str, str, str], tuple[float, float]] = {
    ("objects", TACTILESGNET, "manual"): (89.44, 0.55),
    ("containers", TACTILESGNET, "manual"): (64.17, 2.75),
    ("objects", GRID_CNN, "none"): (88.40, 1.14),
    ("containers", GRID_CNN, "none"): (60.17, 2.78),
    ("objects", MLP, "none"): (85.97, 0.85),
    ("containers", MLP, "none"): (58.83, 2.49),
    ("objects", GCN, "manual"): (85.14, 1.51),
    ("containers", GCN, "manual"): (58.83, 2.84),
}
"""Mean and standard deviation of ``RUNS`` runs of 100 epochs, in percent: F. Gu et al., "TactileSGNet: A Spiking Graph
Neural Network for Event-based Tactile Object Recognition", IROS 2020, tables II and III. The text does not say which
epoch was read, and names no padding of the grid-based CNN."""

for graph, of_objects, of_containers in (
    ("knn:1", (88.75, 0.64), (62.67, 2.53)),
    ("knn:2", (88.75, 0.79), (63.33, 1.18)),
    ("knn:3", (89.24, 1.00), (66.00, 0.91)),
    ("knn:4", (88.96, 0.69), (67.00, 1.39)),
    ("knn:5", (89.44, 0.44), (65.67, 2.79)),
    ("knn:6", (89.31, 0.67), (62.00, 0.75)),
    ("knn:7", (89.65, 0.83), (64.67, 4.31)),
    ("knn:8", (89.51, 0.83), (60.33, 1.39)),
    ("mst:0", (89.03, 0.64), (63.67, 2.17)),
    ("released:mst:1.5", (88.68, 0.93), (65.33, 3.80)),
    ("mst:2", (89.44, 0.55), (63.00, 0.75)),
    ("mst:2.5", (89.31, 0.94), (65.00, 2.36)),
    ("mst:3", (89.51, 0.69), (64.33, 1.49)),
    ("mst:3.5", (89.17, 0.94), (63.00, 3.80)),
    ("mst:4", (89.03, 0.85), (62.00, 1.39)),
):
    PUBLISHED["objects", TACTILESGNET, graph] = of_objects
    PUBLISHED["containers", TACTILESGNET, graph] = of_containers


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One row of a table on one data set: a cell for each seed."""

    data: str
    system: str
    form: str
    epochs: int

    def cell(self, seed: int) -> str:
        """Name of a cell: ``objects-tactilesgnet-mst-2.5-e60-s2``."""
        return f"{self.data}-{self.system}-{self.form.replace(':', '-')}-e{self.epochs}-s{seed}"

    def words(self) -> list[str]:
        """Options of ``spikeloom train``."""
        graph = ["--graph", self.form] if self.system in GRAPH_SYSTEMS else []
        return ["--system", self.system, *graph, "--epochs", str(self.epochs)]


def planned(table: str, data: tuple[str, ...] = DATA) -> dict[Row, int]:
    """Rows of ``methods`` or ``graphs``, in order, and how many seeds each has."""
    forms = METHODS if table == "methods" else [(TACTILESGNET, graph) for graph in GRAPHS]
    forms = sorted(forms, key=lambda form: SYSTEMS.index(form[0]))
    return {
        Row(data=name, system=system, form=form, epochs=EPOCHS[table]): GRID_SEEDS
        if system == GRID_CNN
        else SEEDS[table]
        for name in data
        for system, form in forms
    }


def read_cells(folder: Path) -> dict[str, Cell]:
    """Cells of a folder by name; none if there is no ``cells.json``."""
    path = folder / "cells.json"
    return json.loads(path.read_text()) if path.exists() else {}


def write_cells(folder: Path, cells: dict[str, Cell]) -> None:
    """One line a cell, so that a difference shows which."""
    lines = (f"{json.dumps(name)}: {json.dumps(cells[name], allow_nan=False)}" for name in sorted(cells))
    with write_atomically(folder / "cells.json") as file:
        file.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())
