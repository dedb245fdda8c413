"""Read a NIR file as a flat graph of nodes in order, nested graphs resolved, trusting nothing in it.

The layout is that of nir 1.0: ``version``; ``node``, a graph with ``type``, ``nodes`` (a group each, with
``type`` and its parameters) and ``edges`` (pairs of names). A nested graph is a node; what goes into it
reaches its Input, what comes out of it comes from its Output.

References
----------
.. [1] J. E. Pedersen et al., "Neuromorphic intermediate representation: A unified instruction set for interoperable
   brain-inspired computing", Nature Communications 15, 8122, 2024; layout as in the package nir 1.0.8.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain

import networkx as nx
import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.hdf5 import AGAIN, Part, Tree, entry_of
from spikeloom.compiler.formats.names import named, printable

GRAPH = "NIRGraph"
INPUT_NODE = "Input"
OUTPUT_NODE = "Output"

WRITER = "spikeloom"
"""What files of our own say of their writer."""

SPIKING = ("CubaLIF", "IF", "LIF", "Threshold")

SHOWN = 8
"""Nodes of a circle that are named."""

Late = Mapping[str, tuple[str, ...]]
"""Recurrent spiking nodes, and the nodes from which that comes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Node(Part):
    """A node that is no graph."""

    name: str  # With the names of the graphs that it is in, ``a.b``
    type: str  # ``LIF`` …
    metadata: Tree  # What it says beside them

    def __str__(self) -> str:
        return f"node {printable(self.name)} ({printable(self.type)})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """Nodes by name, pairs of names, and what the file says about itself."""

    nodes: Mapping[str, Node]  # No graphs
    edges: tuple[tuple[str, str], ...]  # From, to
    version: str  # Of the format
    metadata: Tree  # Of the whole
    sha256: str  # Of the file


def graph_of(tree: Tree, sha256: str) -> Graph:
    """Graph of the content of a file; ModelError, without the path, if it is none or inconsistent."""
    root = entry_of(tree, "node", dict)
    if "type" not in root:
        raise ModelError(f"has no node, so it is no NIR file; {AGAIN}")
    if entry_of(root, "type", str) != GRAPH:
        root = {"type": GRAPH, "nodes": {"node": root}, "edges": []}
    nodes, edges = _flat(root, "")
    metadata = entry_of(root, "metadata", dict)
    if entry_of(metadata, "writer", str) == WRITER:
        # HDF5 sorts by name; edges are in the order of the netlist's layers
        nodes = {name: nodes[name] for name in dict.fromkeys(chain.from_iterable(edges))} | nodes
    return Graph(
        nodes=nodes,
        edges=tuple(dict.fromkeys(edges)),
        version=entry_of(tree, "version", str),
        metadata=metadata,
        sha256=sha256,
    )


def _flat(graph: Tree, above: str) -> tuple[dict[str, Node], list[tuple[str, str]]]:
    """Nodes and edges of a graph, with those of the graphs in it in place of these."""
    where = f"graph {printable(above)}" if above else "the graph"
    members = entry_of(graph, "nodes", dict)
    if not members:
        raise ModelError(f"{where} has no nodes; {AGAIN}")
    nodes: dict[str, Node] = {}
    edges: list[tuple[str, str]] = []
    ends: dict[str, tuple[str, str]] = {}
    for name, entry in members.items():
        full = f"{above}.{name}" if above else name
        kind = entry_of(entry, "type", str) if isinstance(entry, dict) else ""
        if not kind:
            raise ModelError(f"node {printable(full)} has no type; {AGAIN}")
        if kind == GRAPH:
            inner, pairs = _flat(entry, full)
            with named(f"graph {printable(full)}"):
                ends[name] = only(inner, INPUT_NODE).name, only(inner, OUTPUT_NODE).name
            # Input and Output of a nested graph pass on what they get
            inner |= {end: replace(inner[end], type="Identity", values={}) for end in ends[name]}
            nodes |= inner
            edges += pairs
        else:
            values = {key: value for key, value in entry.items() if key not in ("type", "metadata")}
            nodes[full] = Node(
                name=full, type=kind, values=values, metadata=entry_of(entry, "metadata", dict)
            )
            ends[name] = (full, full)
    for source, target in _pairs(graph, where):
        for name in (source, target):
            if name not in ends:
                raise ModelError(
                    f"{where} has an edge {printable(source)} -> {printable(target)}, there is no node "
                    f"{printable(name)}; {AGAIN}"
                )
        edges.append((ends[source][1], ends[target][0]))
    return nodes, edges


def only(nodes: Mapping[str, Node], kind: str) -> Node:
    """The only node of a type; ModelError if there are none or several."""
    matching = [node for node in nodes.values() if node.type == kind]
    if len(matching) != 1:
        shown = f" ({', '.join(printable(node.name) for node in matching)})" if matching else ""
        raise ModelError(
            f"has {len(matching)} nodes of type {kind}{shown}, one is allowed; export one network"
        )
    return matching[0]


def _pairs(graph: Tree, where: str) -> list[tuple[str, str]]:
    edges = graph.get("edges")
    if isinstance(edges, np.ndarray) and not edges.size:
        return []  # without edges the array has no type of its own
    if not isinstance(edges, list) or any(
        not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair)
        for pair in edges
    ):
        raise ModelError(f"{where} has no list of edges; {AGAIN}")
    return [(source, target) for source, target in edges]


def loops(graph: Graph) -> Late:
    """Recurrent nodes; ModelError if some feed each other in a circle that is no recurrent layer.

    NIR says nothing of delays: its neurons are equations in continuous time. In steps, the frameworks that
    write or read loops mean the spikes of the step before, as the chip does. So a loop through one spiking
    node, and stages that are no neurons, is a recurrent layer, fed by its own spikes a step late. A loop
    through several layers is refused: it takes the chip a step for each.
    """
    every = set(graph.edges)
    recurrent: dict[str, tuple[str, ...]] = {}
    for members in nx.strongly_connected_components(nx.DiGraph(graph.edges)):
        if len(members) == 1 and not every & {(name, name) for name in members}:
            continue
        ring = [name for name in graph.nodes if name in members]
        neurons = [name for name in ring if graph.nodes[name].type in SPIKING]
        pairs = [(source, target) for source, target in graph.edges if {source, target} <= members]
        rest = [pair for pair in pairs if pair[1] not in neurons]
        if len(neurons) > 1 or not nx.is_directed_acyclic_graph(nx.DiGraph(rest)):
            around = rest if len(neurons) == 1 else pairs
            circle = [printable(source) for source, _ in nx.find_cycle(nx.DiGraph(around))]
            shown = circle if len(circle) <= SHOWN else [*circle[: SHOWN - 1], "…"]
            raise ModelError(
                f"nodes feed each other in a circle ({' -> '.join([*shown, circle[0]])}) with "
                f"{len(neurons)} spiking ones in the loop; a spike takes the chip a step from one to the next: only a "
                "layer may feed itself, through stages in a row; train without the rest"
            )
        for source, target in graph.edges:
            if target in ring and target not in neurons and source not in members:
                raise graph.nodes[target].fail(
                    f"is in the loop of {printable(neurons[0])} and receives {printable(source)} too, of which nothing "
                    "tells the step; give each a stage of its own"
                )
        recurrent[neurons[0]] = tuple(source for source, target in pairs if target == neurons[0])
    return recurrent


def in_order(graph: Graph, late: Late) -> tuple[str, ...]:
    """Names of the nodes, each after those that feed it, apart from what comes a step late."""
    now = nx.DiGraph()
    now.add_nodes_from(graph.nodes)
    now.add_edges_from(
        (source, target) for source, target in graph.edges if source not in late.get(target, ())
    )
    for name, node in graph.nodes.items():
        if not now.in_degree(name) and node.type != INPUT_NODE:
            raise node.fail(
                f"receives nothing{' but its own spikes' if name in late else ''}, so the input does not reach it; "
                "remove it"
            )
    place = {name: number for number, name in enumerate(graph.nodes)}
    return tuple(
        name for ready in nx.topological_generations(now) for name in sorted(ready, key=place.__getitem__)
    )
