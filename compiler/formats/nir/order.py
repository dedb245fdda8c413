"""Order of the nodes of a NIR graph, and the loops in it that make a layer recurrent.

NIR says nothing of delays: its neurons are equations in continuous time. In steps, the frameworks that write or read
loops mean the spikes of the step before, as the chip does. So a loop through one spiking node, and stages that are no
neurons, is a recurrent layer, fed by its own spikes a step late. A loop through several layers is refused: it takes the
chip a step for each.
"""

from __future__ import annotations

from collections.abc import Mapping

import networkx as nx

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.nir.file import INPUT_NODE, Graph
from spikeloom.compiler.formats.nir.neurons import SPIKING

SHOWN = 8
"""Nodes of a circle that are named."""

Late = Mapping[str, tuple[str, ...]]
"""Recurrent spiking nodes, and the nodes from which that comes."""


def loops(graph: Graph) -> Late:
    """Recurrent nodes; ModelError if some feed each other in a circle that is no recurrent layer."""
    every = set(graph.edges)
    found: dict[str, tuple[str, ...]] = {}
    for members in nx.strongly_connected_components(nx.DiGraph(graph.edges)):
        if len(members) == 1 and not every & {(name, name) for name in members}:
            continue
        ring = [name for name in graph.nodes if name in members]
        neurons = [name for name in ring if graph.nodes[name].type in SPIKING]
        pairs = [(source, target) for source, target in graph.edges if {source, target} <= members]
        if len(neurons) > 1:
            raise ModelError(
                f"nodes feed each other in a circle ({_circle(pairs)}) with {len(neurons)} spiking ones in it; a spike "
                "takes the chip a step from one to the next, so it would come back late: only a layer may feed itself, "
                "train without the rest"
            )
        rest = [pair for pair in pairs if pair[1] not in neurons]
        if not nx.is_directed_acyclic_graph(nx.DiGraph(rest)):
            raise ModelError(
                f"nodes feed each other in a circle ({_circle(rest)}) without neurons, so nothing in it takes a step; "
                "put a spiking node into it or train without"
            )
        for source, target in graph.edges:
            if target in ring and target not in neurons and source not in members:
                raise graph.nodes[target].fail(
                    f"is in the loop of {printable(neurons[0])} and receives {printable(source)} too, of which nothing "
                    "tells the step; give each a stage of its own"
                )
        found[neurons[0]] = tuple(source for source, target in pairs if target == neurons[0])
    return found


def in_order(graph: Graph, late: Late) -> tuple[str, ...]:
    """Names of the nodes, each after those that feed it, apart from what comes a step late."""
    received: dict[str, set[str]] = {name: set() for name in graph.nodes}
    for source, target in graph.edges:
        if source not in late.get(target, ()):
            received[target].add(source)
    for name, node in graph.nodes.items():
        if not received[name] and node.type != INPUT_NODE:
            raise node.fail(
                f"receives nothing{' but its own spikes' if name in late else ''}, so the input does not reach it; "
                "remove it"
            )
    placed: dict[str, None] = {}
    while len(placed) < len(received):
        placed |= dict.fromkeys(n for n, sources in received.items() if n not in placed and sources <= placed.keys())
    return tuple(placed)


def _circle(pairs: list[tuple[str, str]]) -> str:
    """One circle among edges, in the direction in which it runs."""
    circle = [printable(source) for source, _ in nx.find_cycle(nx.DiGraph(pairs))]
    shown = circle if len(circle) <= SHOWN else [*circle[: SHOWN - 1], "…"]
    return " -> ".join([*shown, circle[0]])
