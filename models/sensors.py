"""Other sensors: taxel positions and hand-drawn edges from CSV files, and the checks that they need.

What makes a graph wrong is an error (a taxel that does not exist, two taxels in one place, an edge from a
taxel to itself). A graph in parts may be meant but rarely is: a warning, text that the caller shows.
"""

import os
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import CHOICES, MAX_TAXELS, Graph, build_graph
from spikeloom.models.recordings.csvtable import read_table

MAX_MILLIMETRES = 1e6

_SHOWN = 8  # parts that a warning lists


def read_taxels(path: str | os.PathLike[str]) -> FloatArray:
    """Read the positions of the taxels, (n, 2) or (n, 3): lines ``x,y`` or ``x,y,z`` in millimetres, taxel 0 first.

    DataError if the file is not such a table, a position is not finite, or two taxels share one.
    """
    table = read_table(path, ("x", "y"), ("z",))
    places = np.stack([table.columns[name] for name in ("x", "y", "z") if name in table.columns], axis=1)
    if len(places) > MAX_TAXELS:
        raise DataError(
            f"{table.where}: {len(places)} taxels, the limit is {MAX_TAXELS}; give a part of the sensor"
        )
    broken = ~(np.abs(places) <= MAX_MILLIMETRES)  # true for NaN too
    if broken.any():
        row, axis = (int(index) for index in np.argwhere(broken)[0])
        raise DataError(
            f"{table.at(row)}: {'xyz'[axis]} is {places[row, axis]:g}, allowed are {-MAX_MILLIMETRES:g} to "
            f"{MAX_MILLIMETRES:g}; give millimetres"
        )
    _, first, same = np.unique(places, axis=0, return_index=True, return_inverse=True)
    earlier = first[same.reshape(-1)]
    again = earlier != np.arange(len(places))
    if again.any():
        row = int(np.argmax(again))
        raise DataError(
            f"{table.at(row)}: taxels {earlier[row]} and {row} share one position; give each taxel its own, in order"
        )
    return places


def read_layout(taxels: str | os.PathLike[str]) -> tuple[int, FloatArray | None]:
    """Number of taxels, and their positions where `taxels` is a file and not a number such as ``"25"``."""
    word = str(taxels)
    if not (word.isascii() and word.isdigit()):
        places = read_taxels(taxels)
        return len(places), places
    if len(word) > len(str(MAX_TAXELS)) or not 1 <= int(word) <= MAX_TAXELS:
        raise OptionError(
            f"--taxels {word}: allowed are 1..{MAX_TAXELS} taxels; give another number, or a CSV file"
        )
    return int(word), None


def read_edges(path: str | os.PathLike[str], n: int | None, *, directed: bool = False) -> IntArray:
    """Read the edges of a graph of `n` taxels, sorted, each once: lines ``source,target``, counted from 0.

    Unless `directed`, each counts in both directions, listed once or twice.

    DataError if the file is not such a table, or an edge names a taxel that does not exist or joins one to
    itself.
    """
    table = read_table(path, ("source", "target"))
    ends = np.stack([table.columns["source"], table.columns["target"]], axis=1)
    most = MAX_TAXELS if n is None else n
    wrong = ~((ends >= 0) & (ends < most) & (ends == np.floor(ends)))  # true for NaN too
    if wrong.any():
        row, side = (int(index) for index in np.argwhere(wrong)[0])
        raise DataError(
            f"{table.at(row)}: {('source', 'target')[side]} {ends[row, side]:g}, taxels are whole numbers "
            f"0..{most - 1}; count from 0 and use the layout that the edges were drawn on"
        )
    edges = ends.astype(np.int64)
    loops = edges[:, 0] == edges[:, 1]
    if loops.any():
        row = int(np.argmax(loops))
        raise DataError(
            f"{table.at(row)}: joins taxel {edges[row, 0]} to itself, allowed are two taxels; remove the line "
            "(every taxel receives its own events anyway)"
        )
    both = edges if directed else np.concatenate([edges, edges[:, ::-1]])
    return np.unique(both, axis=0)


def sensor_graph(
    *,
    graph: str | None = None,
    taxels: str | os.PathLike[str] | None = None,
    edges: str | os.PathLike[str] | None = None,
    directed: bool = False,
) -> tuple[Graph, str | None]:
    """Build the graph that the command line asks for, by name or from a file, and a warning if it is in parts.

    It is named as in `graph`, or ``edges:FILE``. A sensor given by edges alone has no positions; its taxels
    then stand on a line in their order, which nothing that is computed from edges uses.

    OptionError, DataError if the options exclude each other, the graph does not suit the sensor, or a file
    cannot be used.
    """
    if (graph is None) == (edges is None):
        given = "neither was given" if graph is None else "both were given"
        raise OptionError(f"--graph and --edges: {given}, allowed is one of them; --graph takes {CHOICES}")
    if directed and edges is None:
        raise OptionError("--directed: only edges from a file have directions; give --edges or omit it")
    count, places = (None, None) if taxels is None else read_layout(taxels)
    if edges is None:
        assert graph is not None  # the first check left one of them
        if taxels is None:
            return build_graph(graph), None
        if places is None:
            raise OptionError(
                f"--taxels {taxels}: --graph {graph} needs positions; give a CSV file with x,y in mm"
            )
        built = build_graph(graph, places)
        return built, parts_warning(f"{Path(taxels).name}, {built.name}", built.edges, built.n_taxels)
    drawn = read_edges(edges, count, directed=directed)
    n = int(drawn.max()) + 1 if count is None else count
    if places is None:
        places = np.arange(float(n))[:, None]
    name = Path(edges).name
    built = Graph(name=f"edges:{name}", coordinates=places, edges=drawn)
    return built, parts_warning(name, drawn, n)


def parts_warning(where: str, edges: IntArray, n: int) -> str | None:
    """Say whether a graph of `n` taxels falls into parts, over edges in either direction; the largest first.

    >>> print(parts_warning("edges.csv", np.array([[0, 1], [2, 3], [3, 4]]), 6))
    edges.csv: the graph has 3 parts, of 3, 2, 1 taxels (with taxels 2, 0, 5); touch does not spread between them
    """
    from scipy import sparse  # a tenth of a second that named graphs need not wait

    links = sparse.coo_array((np.ones(len(edges)), edges.T), (n, n))
    part = sparse.csgraph.connected_components(links, directed=False)[1]
    _, first, sizes = np.unique(part, return_index=True, return_counts=True)
    if len(first) == 1:
        return None
    order = np.lexsort((first, -sizes))
    of, lowest = (", ".join(map(str, each[order[:_SHOWN]].tolist())) for each in (sizes, first))
    more = f" and {len(first) - _SHOWN} more" if len(first) > _SHOWN else ""
    return (
        f"{where}: the graph has {len(first)} parts, of {of} taxels (with taxels {lowest}{more}); touch does not "
        "spread between them"
    )
