"""Read a NIR file as a flat graph of nodes, nested graphs resolved, trusting nothing in it.

The layout is that of nir 1.0: ``version``; ``node``, a graph with ``type``, ``nodes`` (a group each, with ``type`` and
its parameters) and ``edges`` (pairs of names). A nested graph is a node; what goes into it reaches its Input, what
comes out of it comes from its Output.

References
----------
.. [1] J. E. Pedersen et al., "Neuromorphic intermediate representation: A unified instruction set for interoperable
   brain-inspired computing", Nature Communications 15, 8122, 2024; layout as in the package nir 1.0.8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.hdf5 import Part, Tree, read_hdf5
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.types import FloatArray

DAMAGED = "export it again"

GRAPH, INPUT_NODE, OUTPUT_NODE = "NIRGraph", "Input", "Output"

NODE_LIMIT = 10_000
NESTING = 8
"""Nodes of a file and graphs within graphs that are read."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Node(Part):
    """A node that is no graph."""

    name: str  # With the names of the graphs that it is in, ``a.b``
    type: str  # ``LIF`` …
    values: Tree  # Its parameters
    metadata: Tree  # What it says beside them

    def __str__(self) -> str:
        return f"node {printable(self.name)} ({printable(self.type)})"

    def has(self, key: str) -> bool:
        """Whether there is such a parameter."""
        return self.values.get(key) is not None

    def numbers(self, key: str) -> FloatArray:
        """A parameter as float64, of its own shape; ModelError if there is none, or it is no finite numbers."""
        found = self.values.get(key)
        if found is None:
            raise self.fail(f"has no {key}; {DAMAGED}")
        if not isinstance(found, np.ndarray):
            raise self.fail(f"{key} is no array of numbers; {DAMAGED}")
        array = found.astype(np.float64)
        if not np.all(np.isfinite(array)):
            bad = int(np.count_nonzero(~np.isfinite(array)))
            raise self.fail(f"{key} has {bad} of {array.size} values NaN or infinite; train it again")
        return array

    def whole(self, key: str, length: int | None = None) -> tuple[int, ...]:
        """A parameter as integers, flat; a single one is repeated to `length`."""
        array = self.numbers(key).ravel()
        if not array.size or np.any(array != np.rint(array)) or np.any(np.abs(array) > 2**31):
            raise self.fail(f"{key} is no whole number; {DAMAGED}")
        values = tuple(int(value) for value in array)
        if length is not None and len(values) == 1:
            values *= length
        if length is not None and len(values) != length:
            raise self.fail(f"{key} has {len(values)} values, wanted {length}; {DAMAGED}")
        return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """Nodes by name, pairs of names, and what the file says about itself."""

    nodes: Mapping[str, Node]  # No graphs
    edges: tuple[tuple[str, str], ...]  # From, to
    version: str  # Of the format
    metadata: Tree  # Of the whole
    sha256: str  # Of the file

    def one(self, kind: str) -> Node:
        """The only node of a type; ModelError if there are none or several."""
        found = [node for node in self.nodes.values() if node.type == kind]
        if len(found) != 1:
            shown = f" ({', '.join(printable(node.name) for node in found)})" if found else ""
            raise ModelError(f"has {len(found)} nodes of type {kind}{shown}, one is allowed; export one network")
        return found[0]


def read_graph(path: Path) -> Graph:
    """Read a file; ModelError, without the path, if it is none or inconsistent."""
    return graph_of(*read_hdf5(path, "NIR file", DAMAGED))


def graph_of(tree: Tree, sha256: str) -> Graph:
    """Graph of the content of a file; raises as :func:`read_graph`."""
    root = tree.get("node")
    if not isinstance(root, dict) or "type" not in root:
        raise ModelError(f"has no node, so it is no NIR file; {DAMAGED}")
    if _type(root) != GRAPH:
        root = {"type": GRAPH, "nodes": {"node": root}, "edges": []}
    nodes, edges = _flat(root, "", NESTING, [NODE_LIMIT])
    version = tree.get("version")
    return Graph(
        nodes=nodes,
        edges=tuple(dict.fromkeys(edges)),
        version=version if isinstance(version, str) else "",
        metadata=_metadata(root),
        sha256=sha256,
    )


def _type(entry: Tree) -> str:
    kind = entry.get("type")
    return kind if isinstance(kind, str) else ""


def _metadata(entry: Tree) -> Tree:
    found = entry.get("metadata")
    return found if isinstance(found, dict) else {}


def _flat(graph: Tree, above: str, nesting: int, left: list[int]) -> tuple[dict[str, Node], list[tuple[str, str]]]:
    """Nodes and edges of a graph, with those of the graphs in it in place of these."""
    where = f"graph {printable(above)}" if above else "the graph"
    if nesting < 0:
        raise ModelError(f"has graphs nested deeper than {NESTING}; export a flat one")
    members = graph.get("nodes")
    if not isinstance(members, dict) or not members:
        raise ModelError(f"{where} has no nodes; {DAMAGED}")
    nodes: dict[str, Node] = {}
    edges: list[tuple[str, str]] = []
    ends: dict[str, tuple[str, str]] = {}
    for name, entry in members.items():
        full = f"{above}.{name}" if above else name
        left[0] -= 1
        if left[0] < 0:
            raise ModelError(f"has more than {NODE_LIMIT} nodes; this is no network of one chip")
        if not isinstance(entry, dict) or not _type(entry):
            raise ModelError(f"node {printable(full)} has no type; {DAMAGED}")
        if _type(entry) == GRAPH:
            inner, pairs = _flat(entry, full, nesting - 1, left)
            ends[name] = (_end(inner, full, INPUT_NODE), _end(inner, full, OUTPUT_NODE))
            # Input and Output of a nested graph pass on what they get
            inner |= {end: replace(inner[end], type="Identity", values={}) for end in ends[name]}
            nodes |= inner
            edges += pairs
        else:
            values = {key: value for key, value in entry.items() if key not in ("type", "metadata")}
            nodes[full] = Node(name=full, type=_type(entry), values=values, metadata=_metadata(entry))
            ends[name] = (full, full)
    for source, target in _pairs(graph, where):
        for name in (source, target):
            if name not in ends:
                raise ModelError(
                    f"{where} has an edge {printable(source)} -> {printable(target)}, there is no node "
                    f"{printable(name)}; {DAMAGED}"
                )
        edges.append((ends[source][1], ends[target][0]))
    return nodes, edges


def _end(inner: Mapping[str, Node], where: str, kind: str) -> str:
    """The only Input or Output of a nested graph itself, not of those in it."""
    found = [name for name, node in inner.items() if node.type == kind]
    if len(found) != 1:
        raise ModelError(f"graph {printable(where)} has {len(found)} nodes of type {kind}, one is allowed; {DAMAGED}")
    return found[0]


def _pairs(graph: Tree, where: str) -> list[tuple[str, str]]:
    edges = graph.get("edges")
    if isinstance(edges, np.ndarray) and not edges.size:
        return []  # without edges the array has no type of its own
    if not isinstance(edges, list) or any(
        not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair)
        for pair in edges
    ):
        raise ModelError(f"{where} has no list of edges; {DAMAGED}")
    return [(source, target) for source, target in edges]
