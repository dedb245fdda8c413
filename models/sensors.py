"""Other sensors: taxel positions and hand-drawn edges from CSV files, and the checks that they need.

What makes a graph wrong is an error (a taxel that does not exist, two taxels in one place, an edge from a taxel to
itself). What may be meant but rarely is (taxels without edges, a graph in parts, an edge listed again) is a
warning: text that the caller shows.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import DataError, OptionError
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.graphs import CHOICES, MAX_TAXELS, Graph, build_graph
from spikeloom.models.recordings.csvtable import Table, read_table

MAX_MILLIMETRES = 1e6

_SHOWN = 8  # numbers that a warning lists


def read_taxels(path: str | os.PathLike[str]) -> FloatArray:
    """Read the positions of the taxels, (n, 2) or (n, 3): lines ``x,y`` or ``x,y,z`` in millimetres, taxel 0 first.

    DataError if the file is not such a table, a position is not finite, or two taxels share one.
    """
    table = read_table(path, ("x", "y"), ("z",))
    places = np.stack([table.columns[name] for name in ("x", "y", "z") if name in table.columns], axis=1)
    if len(places) > MAX_TAXELS:
        raise DataError(f"{table.where}: {len(places)} taxels, the limit is {MAX_TAXELS}; give a part of the sensor")
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
        raise OptionError(f"--taxels {word}: allowed are 1..{MAX_TAXELS} taxels; give another number, or a CSV file")
    return int(word), None


def read_edges(
    path: str | os.PathLike[str], n: int | None, *, directed: bool = False
) -> tuple[IntArray, tuple[str, ...]]:
    """Read the edges of a graph of `n` taxels, sorted, each once: lines ``source,target``, counted from 0.

    Unless `directed`, each counts in both directions, listed once or twice. Edges that the file lists again make a
    warning.

    DataError if the file is not such a table, or an edge names a taxel that does not exist or joins one to itself.
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
    kept, first = np.unique(edges, axis=0, return_index=True)
    warnings = _repeats(table, edges, first)
    if not directed:
        kept = np.unique(np.concatenate([kept, kept[:, ::-1]]), axis=0)
    return kept, warnings


def sensor_graph(
    *,
    graph: str | None = None,
    taxels: str | os.PathLike[str] | None = None,
    edges: str | os.PathLike[str] | None = None,
    directed: bool = False,
) -> tuple[Graph, tuple[str, ...]]:
    """Build the graph that the command line asks for, by name or from a file; the warnings are one line each.

    It is named as in `graph`, or ``edges:FILE``. A sensor given by edges alone has no positions; its taxels then stand
    on a line in their order, which nothing that is computed from edges uses.

    OptionError, DataError if the options exclude each other, the graph does not suit the sensor, or a file cannot be
    used.
    """
    if (graph is None) == (edges is None):
        found = "neither was given" if graph is None else "both were given"
        raise OptionError(f"--graph and --edges: {found}, allowed is one of them; --graph takes {CHOICES}")
    if directed and edges is None:
        raise OptionError("--directed: only edges from a file have directions; give --edges or omit it")
    count, places = (None, None) if taxels is None else read_layout(taxels)
    if edges is None:
        assert graph is not None  # the first check left one of them
        if taxels is None:
            return build_graph(graph), ()
        if places is None:
            raise OptionError(f"--taxels {taxels}: --graph {graph} needs positions; give a CSV file with x,y in mm")
        built = build_graph(graph, places)
        return built, connection_warnings(f"{Path(taxels).name}, {built.name}", built.edges, built.n_taxels)
    drawn, warnings = read_edges(edges, count, directed=directed)
    n = int(drawn.max()) + 1 if count is None else count
    if places is None:
        places = np.arange(float(n))[:, None]
    name = Path(edges).name
    built = Graph(name=f"edges:{name}", coordinates=places, edges=drawn)
    return built, warnings + connection_warnings(name, drawn, n)


def connection_warnings(where: str, edges: IntArray, n: int) -> tuple[str, ...]:
    """Say which of `n` taxels no edge touches, and whether the others fall into parts.

    Examples
    --------
    >>> for line in connection_warnings("edges.csv", np.array([[0, 1], [2, 3], [3, 4]]), 6):
    ...     print(line)
    edges.csv: taxel 5 has no edge, it receives its own events only; add edges if it should not
    edges.csv: the graph has 2 parts, of 3 and 2 taxels (with taxels 2 and 0); touch does not spread between them
    """
    warnings = []
    part = _parts(edges, n)
    first, sizes = np.unique(part, return_counts=True)
    isolated = first[sizes == 1].tolist()
    if isolated:
        have = "has no edge, it receives its" if len(isolated) == 1 else "have no edges, each receives its"
        should = "it" if len(isolated) == 1 else "they"
        taxel = "taxel" if len(isolated) == 1 else "taxels"
        warnings.append(
            f"{where}: {taxel} {_listed(isolated)} {have} own events only; add edges if {should} should not"
        )
    order = np.argsort(-sizes, kind="stable")
    several = [index for index in order.tolist() if sizes[index] > 1]
    if len(several) > 1:
        warnings.append(
            f"{where}: the graph has {len(several)} parts, of {_listed([int(sizes[i]) for i in several])} taxels "
            f"(with taxels {_listed([int(first[i]) for i in several])}); touch does not spread between them"
        )
    return tuple(warnings)


def _parts(edges: IntArray, n: int) -> IntArray:
    """Lowest taxel that each taxel is joined to, over edges in either direction, (n,)."""
    from scipy import sparse  # a tenth of a second that named graphs need not wait

    links = sparse.coo_array((np.ones(len(edges)), edges.T), (n, n))
    part = sparse.csgraph.connected_components(links, directed=False)[1]
    lowest: IntArray = np.unique(part, return_index=True)[1][part]
    return lowest


def _repeats(table: Table, edges: IntArray, first: IntArray) -> tuple[str, ...]:
    """Warn of rows that occurred before."""
    again = np.ones(len(edges), dtype=bool)
    again[first] = False
    if not again.any():
        return ()
    row = int(np.argmax(again))
    source, target = edges[row].tolist()
    count = int(again.sum())
    lines = "1 line repeats an edge" if count == 1 else f"{count} lines repeat edges"
    place = table.at(row).rpartition(": ")[2]
    return (f"{table.where}: {lines} (first {source},{target} at {place}); each counts once",)


def _listed(numbers: list[int]) -> str:
    """Numbers with commas and an ``and``, the first few of many."""
    if len(numbers) > _SHOWN:
        return f"{', '.join(map(str, numbers[:_SHOWN]))} and {len(numbers) - _SHOWN} more"
    return " and ".join(filter(None, [", ".join(map(str, numbers[:-1])), str(numbers[-1])]))
