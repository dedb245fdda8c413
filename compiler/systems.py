"""The spiking systems for touch: they differ in what their first layer sees, and in nothing else.

Neuron (place p, feature f) of the first layer gets ``sum_k sum_j M_k[p, j] <g_k[f], x_j> + b_f``, where x_j
are the polarities of taxel j: a stack of matrices M (filters, places, taxels), here called the
*propagation*, and one filter g_k (features, channels) for each of them.

===============  ======================================================  ======================
system           M_k                                                     places
===============  ======================================================  ======================
tactilesgnet     k-th power of the normalised adjacency [1]_             taxels
gcn              one: the adjacency with self loops, normalised [2]_     taxels
mlp              picks taxel k                                           one
grid-cnn         picks the taxels that cell k of the window covers       positions of the window
===============  ======================================================  ======================

References
----------
.. [1] J. Du et al., "Topology Adaptive Graph Convolutional Networks", 2017, arXiv:1710.10370.
.. [2] T. N. Kipf and M. Welling, "Semi-Supervised Classification with Graph Convolutional Networks", ICLR 2017,
   arXiv:1609.02907: the renormalisation trick.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray, JsonObject

TACTILESGNET = "tactilesgnet"
GRID_CNN = "grid-cnn"
MLP = "mlp"
GCN = "gcn"
SYSTEMS = (TACTILESGNET, GRID_CNN, MLP, GCN)

GRAPH_SYSTEMS = (TACTILESGNET, GCN)
"""Those that have a taxel graph."""

TITLES = {TACTILESGNET: "a TactileSGNet", GRID_CNN: "a grid-based CNN", MLP: "an MLP", GCN: "a GCN"}
"""What they are called in a sentence."""

SMALL_GRID = 4096
"""Cells along one side of a grid, at most."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """A grid of cells over a sensor, and how a window moves over it."""

    rows: int  # Cells
    columns: int
    stride: int  # Of the window
    padding: int  # Empty cells around the grid
    cells: IntArray  # (taxels, 2) int64; row and column of each taxel; two in one cell add up

    def places(self, kernel: int) -> tuple[int, int]:
        """Positions of a square window, down and across; zero where it is larger than the grid."""
        down, across = (
            max(0, (side + 2 * self.padding - kernel) // self.stride + 1)
            for side in (self.rows, self.columns)
        )
        return down, across

    def propagation(self, kernel: int) -> FloatArray:
        """Stack (kernel * kernel, places, taxels): which taxels each cell of the window covers, place by place."""
        down, across = self.places(kernel)
        stack = np.zeros((kernel * kernel, down * across, len(self.cells)))
        for taxel, (row, column) in enumerate((self.cells + self.padding).tolist()):
            for tap in range(kernel * kernel):
                i, left = divmod(row - tap // kernel, self.stride)
                j, over = divmod(column - tap % kernel, self.stride)
                if not left and not over and 0 <= i < down and 0 <= j < across:
                    stack[tap, i * across + j, taxel] = 1.0
        return stack

    def to_json(self) -> JsonObject:
        """JSON values."""
        return asdict(self) | {"cells": self.cells.tolist()}


def feature_major(system: str) -> bool:
    """Whether neurons of the first layer count ``feature * places + place``, as a flattened picture does.

    The others count ``place * features + feature``.
    """
    return system == GRID_CNN


def in_order(system: str, array: Any) -> Any:
    """(places, features, ...) to (neurons, ...), in the order of the system's neurons."""
    turned = array.swapaxes(0, 1) if feature_major(system) else array
    return turned.reshape(-1, *array.shape[2:])


def shape_faults(system: str, filters: int, places: int, taxels: int, grid: Grid | None) -> list[str]:
    """What is wrong about a first layer that was made for so many places.

    >>> shape_faults(MLP, 39, 1, 39, None), shape_faults(GCN, 2, 39, 39, None)
    ([], ['a GCN has 1 filter, conv1.hops has 2'])
    """
    match system:
        case "gcn" if filters != 1:
            return [f"a GCN has 1 filter, conv1.hops has {filters}"]
        case "mlp" if filters != taxels or places != 1:
            return [
                f"an MLP has a filter for each of its {taxels} taxels and one place, here {filters} and {places}"
            ]
        case "grid-cnn":
            kernel = math.isqrt(filters)
            if kernel**2 != filters or grid is None:
                return [f"a grid-based CNN has a grid and a square window, conv1.hops has {filters} cells"]
            if math.prod(grid.places(kernel)) != places or len(grid.cells) != taxels:
                fits = f"{math.prod(grid.places(kernel))} places and {len(grid.cells)} taxels"
                return [f"the grid has {fits}, the weights are for {places} and {taxels}"]
    return []
