"""Which operators of a graph are needed, in which order, and which tensors are held against a threshold."""

from __future__ import annotations

from collections.abc import Container

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.onnx.evaluate import COMPARISONS
from spikeloom.compiler.formats.onnx.file import Graph, Node

COMPARING = frozenset((*COMPARISONS, "Sign"))
_SHIFTS = frozenset(("Add", "Cast", "Div", "Identity", "Mul", "Sub"))
"""Operators that may stand between a membrane and its comparison, as in ``u - theta > 0``."""


def inner(node: Node) -> tuple[Graph, ...]:
    """Graphs that are attributes of an operator."""
    return tuple(value for value in node.attributes.values() if isinstance(value, Graph))


def reads(node: Node) -> tuple[str, ...]:
    """Values that an operator needs, those that its inner graphs take from outside among them."""
    found = [name for name in node.inputs if name]
    for graph in inner(node):
        made = {value.name for value in graph.inputs} | set(graph.constants)
        made |= {name for each in graph.nodes for name in each.outputs}
        wanted = [name for each in graph.nodes for name in reads(each)]
        found += [name for name in [*wanted, *graph.outputs] if name and name not in made]
    return tuple(found)


def _makers(graph: Graph) -> dict[str, Node]:
    makers: dict[str, Node] = {}
    for node in graph.nodes:
        for name in node.outputs:
            if name and (name in makers or name in graph.constants):
                raise ModelError(f"{node}: makes {printable(name)} again, each value is made once; export it again")
            makers[name] = node
    return makers


def ordered(graph: Graph, known: Container[str]) -> list[Node]:
    """Operators that the outputs need, each after those that it needs itself; `known` are values from outside.

    Raises
    ------
    ModelError
        If a value is made twice, not at all, or from itself.
    """
    makers = _makers(graph)
    order: list[Node] = []
    state: dict[int, bool] = {}  # by operator: False while those that it needs are being placed, True once it is
    for output in graph.outputs:
        if output not in makers and output not in known:
            raise ModelError(f"output {printable(output)}: nothing makes it; export it again")
        pending = [(makers[output], iter(reads(makers[output])))] if output in makers else []
        while pending:
            node, left = pending[-1]
            if state.get(id(node)):
                pending.pop()
                continue
            state[id(node)] = False
            for name in left:
                maker = makers.get(name)
                if maker is None:
                    if name not in known:
                        raise ModelError(f"{node}: reads {printable(name)}, which nothing makes; export it again")
                elif state.get(id(maker)) is False:
                    raise ModelError(f"{node}: needs its own result, a cycle; state must go in and out of the graph")
                elif not state.get(id(maker)):
                    pending.append((maker, iter(reads(maker))))
                    break
            else:
                state[id(node)] = True
                order.append(node)
                pending.pop()
    return order


def membranes(order: list[Node], outputs: tuple[str, ...], varying: set[str]) -> set[str]:
    """Values that vary and are held against a threshold; a shift just before the comparison is looked through."""
    makers = {name: node for node in order for name in node.outputs}
    users: dict[str, list[Node]] = {}
    for node in order:
        for name in reads(node):
            users.setdefault(name, []).append(node)
    moving = set(varying)
    for node in order:
        if moving & set(reads(node)):
            moving |= set(node.outputs)
    found = set()
    for node in order:
        if node.op not in COMPARING:
            continue
        for name in node.inputs:
            place = name
            while place in moving and place in makers and makers[place].op in _SHIFTS:
                before = [other for other in makers[place].inputs if other in moving]
                only_compared = place not in outputs and all(user.op in COMPARING for user in users[place])
                if len(before) != 1 or not only_compared:
                    break
                if len(users[before[0]]) < 2 and before[0] not in outputs:
                    break
                place = before[0]
            if place in moving:
                found.add(place)
    return found
