"""Run a graph on values that vary: operators in order, loops step by step, membranes set apart as they are met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import one_line, printable
from spikeloom.compiler.formats.onnx.affine import (
    INPUT_ATOM,
    MEMBRANE,
    Affine,
    Table,
    Value,
    as_affine,
    diagonal,
    picked,
    picked_of_all,
    require_finite,
)
from spikeloom.compiler.formats.onnx.file import Graph, Node
from spikeloom.compiler.formats.onnx.operators import MIRRORED, apply

STEP_LIMIT = 4096
"""Steps of a Scan that are unrolled."""

NODE_WORK = 2**14
"""What running one operator counts for beside its elements."""

_SHIFTS = frozenset(("Add", "Cast", "Div", "Identity", "Mul", "Sub"))
"""Operators that may stand between a membrane and its comparison, as in ``u - theta > 0``."""


def run(graph: Graph, outer: Mapping[str, Value], given: Mapping[str, Value], table: Table) -> list[Value]:
    """Values of a graph's outputs from those `outer` ones around it and those `given` for its inputs.

    Raises ModelError naming the operator that cannot be evaluated, or is not affine, and why.
    """
    values: dict[str, Value] = {**outer, **graph.constants, **given}
    order = needed(graph)
    held = membranes(
        order, graph.outputs, {name for name, value in values.items() if not isinstance(value, np.ndarray)}
    )
    last = {name: index for index, node in enumerate(order) for name in reads(node)}
    for index, node in enumerate(order):
        try:
            table.spend(NODE_WORK)
            results = _evaluate(node, values, table)
            for name, result in zip(node.outputs, results, strict=False):
                values[name] = _set_apart(node, name, result, table) if name in held else result
        except ModelError as error:
            raise ModelError(f"{node}: {error}") from error
        except Exception as error:  # onnx, numpy and scipy raise nearly anything on operands that do not fit each other
            raise ModelError(f"{node}: cannot be evaluated ({one_line(error)}); export it again") from error
        for name in reads(node):
            if last[name] == index and name not in outer and name not in graph.outputs:
                values.pop(name, None)
    for name in graph.outputs:
        if name not in values:
            raise ModelError(f"output {printable(name)}: nothing makes it; export it again")
    return [values[name] for name in graph.outputs]


def _set_apart(node: Node, name: str, value: Value, table: Table) -> Value:
    """Make a membrane an atom of its own, and remember what it is made of."""
    if not isinstance(value, Affine):
        return value
    require_finite(value)
    only = next(iter(value.terms), -1)
    known = len(value.terms) == 1 and diagonal(value.terms[only]) == 1 and not np.any(value.bias)
    if known and table.atoms[only].kind in (INPUT_ATOM, MEMBRANE):
        return value
    return table.value(table.atom(MEMBRANE, name, len(value.bias), definition=value, node=str(node)), value.shape)


def _evaluate(node: Node, values: Mapping[str, Value], table: Table) -> list[Value]:
    operands = [values[name] if name else None for name in node.inputs]
    match node.op:
        case "Constant":
            numbers = [value for value in node.attributes.values() if not isinstance(value, str | Graph)]
            if not numbers:
                raise ModelError("holds no number")
            return [np.asarray(numbers[0])]
        case "Shape" | "Size":
            shape = np.array(as_affine(operands[0]).shape, np.int64)
            cut = shape[node.attributes.get("start", 0) : node.attributes.get("end", len(shape))]
            return [cut if node.op == "Shape" else np.array(np.prod(shape))]
        case "If":
            if not isinstance(operands[0], np.ndarray):
                raise ModelError("depends on what varies; only a fixed choice can be read")
            return run(node.attributes["then_branch" if operands[0].reshape(()) else "else_branch"], values, {}, table)
        case "Scan":
            return _scanned(node, values, operands, table)
    if inner(node):
        raise ModelError("holds a graph; only If and Scan may")
    return apply(node, table, operands)


def _taken(value: Value, step: int, axis: int, table: Table) -> Value:
    """One step of a sequence."""
    table.spend(math.prod(value.shape))
    if isinstance(value, np.ndarray):
        return np.asarray(value.take(step, axis))
    places = np.arange(math.prod(value.shape)).reshape(value.shape).take(step, axis)
    return picked(value, places.ravel(), places.shape)


def _stacked(parts: Sequence[Value], axis: int, table: Table) -> Value:
    """Steps side by side again, along a new axis."""
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.stack(parts, axis)  # type: ignore[arg-type]
    shape = table.room((len(parts), *parts[0].shape))
    places = np.moveaxis(np.arange(1, math.prod(shape) + 1).reshape(shape), 0, axis)
    return picked_of_all([as_affine(part) for part in parts], places)


def _scanned(node: Node, values: Mapping[str, Value], operands: list[Value | None], table: Table) -> list[Value]:
    """A Scan, unrolled: its body takes the states and a slice of each sequence, and leaves states and results."""
    attributes, body = node.attributes, node.attributes["body"]
    if any(any(attributes.get(f"scan_{side}_directions", ())) for side in ("input", "output")):
        raise ModelError("runs backwards in time; only forward can be lowered")
    given = [value for value in operands if value is not None]
    carried = len(given) - int(attributes["num_scan_inputs"])
    state, sequences = given[:carried], given[carried:]
    taken = attributes.get("scan_input_axes", [0] * len(sequences))
    steps = sequences[0].shape[taken[0]]
    if not 1 <= steps <= STEP_LIMIT:
        raise ModelError(f"runs {steps} steps, allowed are 1 to {STEP_LIMIT}; export a shorter recording")
    if len(body.inputs) != len(given) or len(body.outputs) < carried:
        raise ModelError("has a body of other inputs or outputs than it carries; export it again")
    kept: list[list[Value]] = []
    for step in range(steps):
        now = [*state, *(_taken(each, step, axis, table) for each, axis in zip(sequences, taken, strict=True))]
        results = run(body, values, dict(zip((each.name for each in body.inputs), now, strict=True)), table)
        state = results[:carried]
        kept.append(results[carried:])
    put = attributes.get("scan_output_axes", [0] * len(kept[0]))
    return [*state, *(_stacked(parts, axis, table) for parts, axis in zip(zip(*kept, strict=True), put, strict=True))]


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


def needed(graph: Graph) -> list[Node]:
    """Operators that the outputs need; a file has each after those that it needs itself."""
    wanted, found = set(graph.outputs), []
    for node in reversed(graph.nodes):
        if wanted & set(node.outputs):
            wanted |= set(reads(node))
            found.append(node)
    return found[::-1]


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
        if node.op not in MIRRORED:
            continue
        for name in node.inputs:
            place = name
            while place in moving and place in makers and makers[place].op in _SHIFTS:
                before = [other for other in makers[place].inputs if other in moving]
                only_compared = place not in outputs and all(user.op in MIRRORED for user in users[place])
                if len(before) != 1 or not only_compared:
                    break
                if len(users[before[0]]) < 2 and before[0] not in outputs:
                    break
                place = before[0]
            if place in moving:
                found.add(place)
    return found
