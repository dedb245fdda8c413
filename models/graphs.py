"""Tactile graphs: which taxels exchange events, and with what weight.

A graph is a list of directed edges over taxels with coordinates. The released code builds three kinds (a
hand-drawn one, nearest neighbours, a spanning tree with or without all pairs nearer than sigma) and lists
some edges twice, which changes the normalised weights. Both readings exist here: ``released:NAME`` keeps the
repeats, plain ``NAME`` collapses them.

The NeuTouch layout is symmetric, so neighbours and spanning trees are full of ties. A checkpoint only works
with the very edges that it was trained on: the choices that the released code made are data
(``neutouch.toml``). On any other layout, ties go to the lower index pair.
"""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spikeloom.compiler.arrays import read_only, read_only_float
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.types import FloatArray, IntArray

CHOICES = "manual, knn:K (K 1..8) or mst:SIGMA (mm, 0 = tree only), each also as released:NAME"
MAX_TAXELS = 4096  # twice what fills a chip with 64 features each

MAX_NEIGHBOURS = 8

_LAYOUT = tomllib.loads(Path(__file__).with_name("neutouch.toml").read_text(encoding="utf-8"))

NEUTOUCH = read_only_float(_LAYOUT["coordinates_mm"])
"""The 39 taxels of a NeuTouch finger, (39, 2) float64, millimetres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """Taxels and the directed edges between them; ModelError if either is malformed."""

    name: str  # For humans and for provenance, for example ``released:knn:3``
    coordinates: FloatArray  # (n, d) float64; positions in millimetres
    edges: IntArray  # (e, 2) int64; source and target taxel of each edge; a repeated row counts twice

    def __post_init__(self) -> None:
        coordinates = read_only_float(check_coordinates(self.coordinates))
        object.__setattr__(self, "coordinates", coordinates)
        object.__setattr__(self, "edges", read_only(check_edges(self.edges, len(coordinates))))

    @property
    def n_taxels(self) -> int:
        """Number of taxels."""
        return len(self.coordinates)


def check_coordinates(coordinates: ArrayLike) -> FloatArray:
    """Return the coordinates as (n, d) float64; ModelError if they are not, or not finite."""
    array = np.asarray(coordinates, dtype=np.float64)
    if array.ndim != 2 or 0 in array.shape:
        raise ModelError(
            f"coordinates: shape {array.shape}, allowed is (taxels, dimensions); give one row per taxel"
        )
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ModelError(f"coordinates: taxel {row} has a position that is not finite; give millimetres")
    return array


def check_edges(edges: ArrayLike, n: int) -> IntArray:
    """Return the edges of a graph with `n` taxels as (e, 2) int64; ModelError if they are none."""
    array = np.asarray(edges)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ModelError(
            f"edges: shape {array.shape}, allowed is (edges, 2); give source and target taxel per row"
        )
    if array.dtype.kind not in "iu":
        raise ModelError(f"edges: dtype {array.dtype}, allowed are integers; give taxel indices")
    outside = ((array < 0) | (array >= n)).any(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        source, target = (int(index) for index in array[row])
        raise ModelError(
            f"edges: row {row} joins {source} and {target}, taxels are 0..{n - 1}; "
            "count from 0 and use the layout that the edges were drawn on"
        )
    return array.astype(np.int64)


def build_graph(name: str, coordinates: ArrayLike = NEUTOUCH) -> Graph:
    """Build a graph by name.

    The name is ``manual``, ``knn:K`` or ``mst:SIGMA``, with or without the prefix ``released:``, and becomes
    the canonical one: ``mst:2.0`` is ``mst:2``. The layout `coordinates` (n, d) is in millimetres; the
    hand-drawn graph exists for `NEUTOUCH` only. OptionError if the name, K or SIGMA is not one of the
    choices, or does not suit it.

    ``released:knn:K`` lists a mutual pair twice in each direction, ``released:mst:SIGMA`` repeats the tree
    edges shorter than sigma; the plain names keep the first of equal rows. Distances are compared after
    rounding to 1e-9 mm, because positions are typed in decimals and equal distances differ in their last
    bits.
    """
    layout = check_coordinates(coordinates)
    neutouch = np.array_equal(layout, NEUTOUCH)
    plain = name.removeprefix("released:")
    kind, colon, value = plain.partition(":")
    if plain == "manual":
        if not neutouch:
            raise OptionError(
                f"graph {name!r}: drawn by hand for the NeuTouch layout, not for this one of {len(layout)} taxels; "
                "use knn:K or mst:SIGMA"
            )
        canonical = "manual"
        edges = _manual_edges()
    elif kind == "knn" and colon:
        k = _read_k(name, value, len(layout))
        canonical = f"knn:{k}"
        edges = _knn_edges(_distances(layout), k, neutouch=neutouch)
    elif kind == "mst" and colon:
        sigma = _read_sigma(name, value)
        canonical = f"mst:{int(sigma) if sigma.is_integer() else sigma!r}"
        edges = _mst_edges(_distances(layout), sigma, neutouch=neutouch)
    else:
        raise OptionError(f"graph {name!r}: unknown; choose {CHOICES}")
    if plain == name:
        edges = edges[np.sort(np.unique(edges, axis=0, return_index=True)[1])]  # every row once
    else:
        canonical = f"released:{canonical}"
    return Graph(name=canonical, coordinates=layout, edges=edges)


def normalised_adjacency(edges: ArrayLike, n: int) -> FloatArray:
    """Dense D^-1/2 A D^-1/2 without self loops, (n, n) float64.

    ``A[target, source]`` counts the edges, so repeats add up; D is the in-degree, as in torch_geometric's
    ``gcn_norm``. A taxel that no edge enters has a zero row and a zero column, never NaN.

    ModelError if the edges are malformed (see `check_edges`).
    """
    source, target = check_edges(edges, n).T
    adjacency = np.zeros((n, n))
    np.add.at(adjacency, (target, source), 1.0)
    degree = adjacency.sum(axis=1)
    scale = np.zeros(n)
    scale[degree > 0] = 1.0 / np.sqrt(degree[degree > 0])
    return scale[:, None] * adjacency * scale[None, :]


def _read_k(name: str, value: str, n: int) -> int:
    """K of ``knn:K`` on a layout of `n` taxels."""
    most = min(MAX_NEIGHBOURS, n - 1)
    if not (value.isascii() and value.isdigit() and len(value) < 4 and 1 <= int(value) <= most):
        why = "" if most == MAX_NEIGHBOURS else f" (the layout has {n} taxels)"
        raise OptionError(
            f"graph {name!r}: K is {value!r}, allowed are whole numbers 1..{most}{why}; choose another K"
        )
    return int(value)


def _read_sigma(name: str, value: str) -> float:
    """SIGMA of ``mst:SIGMA``, in millimetres."""
    try:
        sigma = float(value)
    except ValueError:
        sigma = math.nan
    if not (math.isfinite(sigma) and sigma >= 0):
        raise OptionError(
            f"graph {name!r}: SIGMA is {value!r}, allowed are millimetres from 0 (tree only); choose another SIGMA"
        )
    return abs(sigma)  # -0.0 is 0


def _distances(coordinates: FloatArray) -> FloatArray:
    """Pairwise distances in mm, (n, n), rounded to 1e-9 so that ties are equal numbers."""
    squares = np.zeros((len(coordinates), len(coordinates)))
    for axis in coordinates.T:
        difference = axis[:, None] - axis[None, :]
        squares += difference * difference
    return np.sqrt(squares).round(9)


def _manual_edges() -> IntArray:
    """Hand-drawn edges: for each taxel those to its higher neighbours, then those back."""
    rows: list[tuple[int, int]] = []
    for taxel, neighbours in enumerate(_LAYOUT["manual"]["higher_neighbours"]):
        rows += [(taxel, other) for other in neighbours]
        rows += [(other, taxel) for other in neighbours]
    return np.array(rows, dtype=np.int64)


def _knn_edges(distance: FloatArray, k: int, *, neutouch: bool) -> IntArray:
    """All edges taxel to neighbour, then all of them reversed: a mutual pair is listed twice."""
    n = len(distance)
    away = distance.copy()
    np.fill_diagonal(away, np.inf)
    neighbours = np.argsort(away, axis=1, kind="stable")[:, :k]  # stable: ties go to the lower index
    if neutouch:
        for taxel, chosen in _LAYOUT["ties"]["knn"][str(k)].items():
            neighbours[int(taxel)] = chosen
    out = np.stack([np.repeat(np.arange(n), k), neighbours.reshape(-1)], axis=1)
    return np.concatenate([out, out[:, ::-1]])


def _mst_edges(distance: FloatArray, sigma: float, *, neutouch: bool) -> IntArray:
    """Spanning tree, then all pairs nearer than `sigma`: short tree edges are listed twice."""
    ties: dict[str, Any] = _LAYOUT["ties"]["mst"] if neutouch else {"start": 0, "first": []}
    low, high = np.triu_indices(len(distance), 1)
    near = distance[low, high] < sigma
    tree = _tree(distance, ties["start"], ties["first"])
    pairs = np.concatenate([tree, np.stack([low[near], high[near]], axis=1)])
    return np.stack([pairs, pairs[:, ::-1]], axis=1).reshape(-1, 2)


def _tree(distance: FloatArray, start: int, first: list[list[int]]) -> IntArray:
    """Minimum spanning tree by Prim's growth from `start`, (n - 1, 2), in the order of growth.

    Equally long pairs are ranked by their place in `first`, then by lower index, then by higher index, so
    that no two pairs tie and `start` decides the order of growth only.
    """
    n = len(distance)
    low, high = np.triu_indices(n, 1)
    preference = np.full((n, n), len(first))
    for rank, (a, b) in enumerate(first):
        preference[min(a, b), max(a, b)] = rank
    order = np.lexsort((high, low, preference[low, high], distance[low, high]))
    place = np.full((n, n), len(order))
    place[low[order], high[order]] = np.arange(len(order))
    place = np.minimum(place, place.T)

    outside = np.ones(n, dtype=bool)
    outside[start] = False
    nearest = place[start].copy()
    origin = np.full(n, start)
    rows = np.empty((n - 1, 2), dtype=np.int64)
    for row in rows:
        end = int(np.argmin(np.where(outside, nearest, len(order) + 1)))
        row[:] = origin[end], end
        outside[end] = False
        closer = place[end] < nearest
        nearest[closer] = place[end][closer]
        origin[closer] = end
    return rows
