"""What the first layer of each system sees of a sensor: its taxel graph, its taxels one by one, or a grid over them."""

import numpy as np

from spikeloom.compiler.arrays import read_only
from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET, Grid
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import NEUTOUCH, Graph, normalised_adjacency

KERNEL = 3
"""Side of the window of a grid-based CNN."""

HOPS = 3
"""K of the graph convolution of a TactileSGNet."""

PADDINGS = {"none": (2, 0), "same": (1, KERNEL // 2)}
"""Forms of its first layer: cells that the window moves by, and empty ones around the grid ("same" keeps the size)."""

NO_GRAPH = "none"
"""Name of the graph of a system that has none."""

MAX_CELLS = 256
"""Cells along a side of the grid."""


def grid_cells(coordinates: FloatArray = NEUTOUCH) -> IntArray:
    """Row and column of each taxel on a grid of 1 mm cells, counted from the outermost taxels; (taxels, 2).

    Halves round to the even number, as the released code's ``rint`` does.

    DataError if the sensor has three dimensions or is too large.

    >>> grid_cells().max(axis=0).tolist(), grid_cells()[1].tolist()
    ([12, 18], [1, 6])
    """
    if coordinates.shape[1] == 1:
        raise DataError(
            "grid-cnn: where the taxels lie is not known; give --taxels a file with x and y of each"
        )
    if coordinates.shape[1] != 2:
        raise DataError(
            f"grid-cnn: positions have {coordinates.shape[1]} numbers each, a grid needs x and y; give a flat sensor"
        )
    cells = np.rint(coordinates)
    cells -= cells.min(axis=0)
    if cells.max() >= MAX_CELLS:
        raise DataError(
            f"grid-cnn: the sensor spans {int(cells.max()) + 1} mm, a grid of 1 mm cells has up to {MAX_CELLS} a side; "
            "give smaller positions"
        )
    return read_only(cells)


def sensor_grid(coordinates: FloatArray, padding: str) -> Grid:
    """The smallest grid over a sensor; refuses unknown paddings, and a sensor over which no grid or window fits."""
    if padding not in PADDINGS:
        raise OptionError(f"--padding {padding}: unknown; choose from {', '.join(PADDINGS)}")
    cells = grid_cells(coordinates)
    stride, empty = PADDINGS[padding]
    rows, columns = (int(most) + 1 for most in cells.max(axis=0))
    grid = Grid(rows=rows, columns=columns, stride=stride, padding=empty, cells=cells)
    if 0 in grid.places(KERNEL):
        raise DataError(
            f"grid-cnn: the grid has {grid.rows} * {grid.columns} cells, a window of {KERNEL} * {KERNEL} does not fit "
            "into it; give --padding same"
        )
    return grid


def taxels_alone(coordinates: FloatArray) -> Graph:
    """A sensor without a graph, for systems that have none."""
    return Graph(name=NO_GRAPH, coordinates=coordinates, edges=np.zeros((0, 2), np.int64))


def propagation_of(system: str, edges: IntArray, taxels: int, grid: Grid | None, filters: int) -> FloatArray:
    """What the first layer of a system sees, in the form that :func:`expand.stack_of` takes.

    `edges` are unused by systems without a graph, `grid` and the number of `filters`, which says how large
    its window is, by all but the grid-based CNN.
    """
    match system:
        case "tactilesgnet":
            return normalised_adjacency(edges, taxels)
        case "gcn":
            loops = np.repeat(np.arange(taxels)[:, None], 2, axis=1)
            return normalised_adjacency(np.concatenate([edges, loops]), taxels)[None]
        case "mlp":
            return np.eye(taxels)[:, None, :]
    assert system == GRID_CNN, "systems are checked where they are named"
    assert grid is not None, "a grid-based CNN has a grid"
    return grid.propagation(round(filters**0.5))


def filters_of(system: str, taxels: int, hops: int) -> int:
    """Number of filters of the first layer."""
    return {TACTILESGNET: hops + 1, GCN: 1, MLP: taxels, GRID_CNN: KERNEL * KERNEL}[system]
