"""Run a graph on values that vary: operators in order, membranes set apart as they are met.

Nothing here looks for patterns. A sum, a gather, a convolution with constant weights give new coefficients;
a comparison of a membrane with a threshold gives a spike; a product of a membrane with its own spikes is
kept as what it is, since it is how a membrane is reset. Everything else is refused by name.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.affine import (
    Affine,
    added,
    diagonal,
    picked_of_all,
    scaled,
    shifted,
    spread,
    through,
)
from spikeloom.compiler.formats.names import named, printable
from spikeloom.compiler.formats.onnx import atoms
from spikeloom.compiler.formats.onnx.evaluate import FLOATING, LINEAR, MOVES, NUMERIC, evaluate, shapes_of
from spikeloom.compiler.formats.onnx.file import BOOL, Graph, Node

_SHIFTS = frozenset(("Add", "Cast", "Div", "Identity", "Mul", "Sub"))
"""Operators that may stand between a membrane and its comparison, as in ``u - theta > 0``."""

MIRRORED = {
    "Greater": "Less",
    "GreaterOrEqual": "LessOrEqual",
    "Less": "Greater",
    "LessOrEqual": "GreaterOrEqual",
}
"""Comparisons with a threshold, and each with its sides exchanged."""

CONSTANT = (
    "is computed from constants by an operator that is not known here; fold constants before the export"
)


def run(graph: Graph, given: Mapping[str, atoms.Value], table: atoms.Table) -> list[atoms.Value]:
    """Values of a graph's outputs from those `given` for its inputs.

    Raises ModelError naming the operator that cannot be evaluated, or is not affine, and why.
    """
    values: dict[str, atoms.Value] = {**given, **graph.constants}
    order = needed(graph)
    compared = membranes(order, graph.outputs, set(given))
    last = {name: index for index, node in enumerate(order) for name in reads(node)}
    for index, node in enumerate(order):
        with named(node):
            results = apply(node, table, [values[name] if name else None for name in node.inputs])
            for name, result in zip(node.outputs, results, strict=False):
                values[name] = _set_apart(node, name, result, table) if name in compared else result
        for name in reads(node):
            if last[name] == index and name not in graph.outputs:
                values.pop(name, None)
    for name in graph.outputs:
        if name not in values:
            raise ModelError(f"output {printable(name)}: nothing makes it; export it again")
    return [values[name] for name in graph.outputs]


def _set_apart(node: Node, name: str, value: atoms.Value, table: atoms.Table) -> atoms.Value:
    """Make a membrane an atom of its own, and remember what it is made of."""
    if not isinstance(value, Affine):
        return value
    atoms.require_finite(value)
    only = next(iter(value.terms), -1)
    known = len(value.terms) == 1 and diagonal(value.terms[only]) == 1 and not np.any(value.bias)
    if known and table.atoms[only].kind in (atoms.INPUT_ATOM, atoms.MEMBRANE):
        return value
    return table.value(
        table.atom(atoms.MEMBRANE, name, len(value.bias), definition=value, node=str(node)), value.shape
    )


def reads(node: Node) -> list[str]:
    """Values that an operator needs, without the operands that it omits."""
    return [name for name in node.inputs if name]


def needed(graph: Graph) -> list[Node]:
    """Operators that the outputs need; a file has each after those that it needs itself."""
    wanted = set(graph.outputs)
    nodes = []
    for node in reversed(graph.nodes):
        if wanted & set(node.outputs):
            wanted |= set(reads(node))
            nodes.append(node)
    return nodes[::-1]


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
    compared = set()
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
                compared.add(place)
    return compared


def apply(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> list[atoms.Value]:
    """Results of an operator, whatever its operands are.

    Raises ModelError if it is not known, or not affine in what varies; without its name.
    """
    op = node.op
    varying = [place for place, operand in enumerate(operands) if isinstance(operand, Affine)]
    if op == "Constant":
        numbers = [value for value in node.attributes.values() if not isinstance(value, str)]
        if not numbers:
            raise ModelError("holds no number")
        return [np.asarray(numbers[0])]
    if op == "Dropout" and operands[0] is not None:
        return [_kept(operands[0], operands[2:3])]
    if op in ("Shape", "Size"):
        shape = np.array(atoms.as_affine(operands[0]).shape, np.int64)
        cut = shape[node.attributes.get("start", 0) : node.attributes.get("end", len(shape))]
        return [cut if op == "Shape" else np.array(np.prod(shape))]
    if not varying:
        return _constant(node, table, operands)
    if op in MOVES and not (op == "Where" and 0 in varying) and node.attributes.get("reduction") != "add":
        return _moved(node, table, operands)
    if op in MIRRORED:
        result = _compared(node, table, operands)
    elif op == "Where":
        result = _chosen(table, operands)
    elif op in ("ScatterElements", "ScatterND"):
        result = _scattered(node, table, operands)
    elif op in LINEAR:
        result = _linear(node, table, operands, varying)
    elif op == "BatchNormalization" and varying == [0]:
        result = _normalised(node, table, operands)
    else:
        result = _elementwise(node, table, operands, varying)
    return [result]


def _kept(value: atoms.Value, training: Sequence[atoms.Value | None]) -> atoms.Value:
    """What Dropout passes on outside training: what it gets."""
    if any(map(np.any, training)):  # type: ignore[arg-type]
        raise ModelError("is in training mode; export the module after eval()")
    return value


def _constant(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> list[atoms.Value]:
    """An operator on numbers; those that are no more than linear run as their matrix."""
    if node.op in NUMERIC:
        return list(evaluate(node, table, operands))  # type: ignore[arg-type]
    if node.op not in LINEAR:
        raise ModelError(CONSTANT)
    result = _linear(node, table, [atoms.as_affine(operands[0]), *operands[1:]], [0])
    return [result.bias.reshape(result.shape)]


def _compared(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> Affine:
    """A comparison of a membrane with a threshold: its spikes, or one less them."""
    if all(isinstance(operand, Affine) for operand in operands):
        raise ModelError("compares two values that both vary; only a fixed threshold can be lowered")
    mirrored = not isinstance(operands[0], Affine)
    membrane, limit = (atoms.as_affine(operand) for operand in (operands[::-1] if mirrored else operands))
    single = next(iter(membrane.terms), -1)
    factor = diagonal(membrane.terms[single]) if len(membrane.terms) == 1 else None
    if not factor or table.atoms[single].kind not in (atoms.MEMBRANE, atoms.INPUT_ATOM):
        raise ModelError("compares what is not the membrane of a layer; only a membrane has a threshold")
    theta = (spread(limit, membrane.shape).bias - membrane.bias) / factor
    op = MIRRORED[node.op] if mirrored != (factor < 0) else node.op
    spike = table.spike(single, theta, strict=op in ("Greater", "LessOrEqual"))
    spikes = table.value(spike, membrane.shape)
    return spikes if op.startswith("Greater") else _opposite(spikes)


def _opposite(spikes: Affine) -> Affine:
    size = len(spikes.bias)
    return shifted(scaled(spikes, np.full(size, -1.0)), np.ones(size))


def _chosen(table: atoms.Table, operands: Sequence[atoms.Value | None]) -> Affine:
    """``Where(s, a, b) = b + s * (a - b)`` for a spike s."""
    values = [atoms.as_affine(operand) for operand in operands]
    if not atoms.is_binary(table, values[0]):
        raise ModelError("chooses by what is neither a spike nor a constant; only spikes can choose")
    shape = table.room(np.broadcast_shapes(*(value.shape for value in values)))
    s, a, b = (spread(value, shape) for value in values)
    product = atoms.multiplied(table, s, added([(1.0, a), (-1.0, b)], shape))
    return added([(1.0, b), (1.0, product)], shape)


def _scattered(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> Affine:
    """A scattering sum: data plus what the updates bring; a gathering of positions tells where each goes."""
    start = atoms.as_affine(operands[0])
    more = atoms.as_affine(operands[2])
    if not isinstance(operands[1], np.ndarray):
        raise ModelError("takes its indices from what varies; only a fixed graph can be lowered")
    op = node.op.replace("Scatter", "Gather")
    axis = {"axis": node.attributes.get("axis", 0)} if op == "GatherElements" else {}
    gather = replace(node, op=op, inputs=node.inputs[:2], attributes=axis)
    places = np.arange(len(start.bias)).reshape(start.shape)
    target = evaluate(gather, table, [places, operands[1]])[0]
    if target.shape != more.shape:
        raise ValueError("updates of another shape than the indices")
    size = len(more.bias)
    matrix = sparse.coo_array(
        (np.ones(size), (target.ravel(), np.arange(size))), shape=(len(start.bias), size)
    ).tocsr()
    return added([(1.0, start), (1.0, through(matrix, more, start.shape))], start.shape)


def _moved(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> list[atoms.Value]:
    """A move, by moving positions; position 0 is a constant zero, then come all elements of all operands in turn."""
    places = MOVES[node.op] or range(len(operands))
    if any(isinstance(value, Affine) and place not in places for place, value in enumerate(operands)):
        raise ModelError("takes indices or sizes from what varies; only a fixed graph can be lowered")
    if (
        node.attributes.get("mode", "constant") != "constant"
        or node.attributes.get("reduction", "none") != "none"
    ):
        raise ValueError("only constant padding, and scattering that replaces or adds, are known")
    if node.op == "Pad" and table.opset < 11:
        raise ModelError("is the Pad of operators before version 11; export it with opset_version=20")
    positions: list[atoms.Value | None] = list(operands)
    parts: list[Affine] = []
    start = 1
    for place, value in enumerate(operands):
        if place in places and value is not None:
            parts.append(atoms.as_affine(value))
            size = len(parts[-1].bias)
            positions[place] = np.arange(start, start + size).reshape(parts[-1].shape)
            start += size
    moved = evaluate(node, table, positions)  # type: ignore[arg-type]
    return [picked_of_all(parts, rows) for rows in moved]


def _linear(
    node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None], varying: list[int]
) -> Affine:
    """A linear operator through its matrix, and the bias that Conv and Gemm add."""
    has_bias = node.op in ("Conv", "Gemm")
    inner = [place for place in varying if not (has_bias and place == 2)]
    matrix_of, allowed = LINEAR[node.op]
    if has_bias and not inner:  # only the bias varies
        operands = [atoms.as_affine(operands[0]), *operands[1:]]
        inner = [0]
    if len(inner) != 1 or inner[0] not in allowed:
        raise ModelError(atoms.NOT_AFFINE)
    place = inner[0]
    value = atoms.as_affine(operands[place])
    arrays = [np.zeros(each.shape) if isinstance(each, Affine) else each for each in operands]
    if not node.op.startswith("Reduce"):  # whose second operand is a list of axes
        arrays = [None if each is None else each.astype(np.float64) for each in arrays]
    constants = [operand for index, operand in enumerate(operands) if index != place and operand is not None]
    key = (
        node.op,
        place,
        value.shape,
        str(sorted(node.attributes.items())),
        *(id(array) for array in constants),
    )
    if key not in table.matrices:
        shape = shapes_of(node, table, arrays)[0]
        matrix = matrix_of(node, table, arrays[:2], place)
        if matrix.shape[0] != math.prod(shape):
            raise ValueError("sizes that do not fit each other")
        table.matrices[key] = matrix, shape, constants
    matrix, shape, _ = table.matrices[key]
    result = through(matrix, value, shape)
    if not has_bias or len(operands) < 3 or operands[2] is None:
        return result
    extra = atoms.as_affine(operands[2])
    if node.op == "Conv":
        extra = replace(extra, shape=(len(extra.bias), *[1] * (len(shape) - 2)))
    factor = node.attributes.get("beta", 1.0) if node.op == "Gemm" else 1.0
    return added([(1.0, result), (factor, spread(extra, shape))], shape)


def _normalised(node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None]) -> Affine:
    """An affine function of each element alone: read from what it does to 0 and 2**20."""
    value = atoms.as_affine(operands[0])
    high = 2.0**20
    at_zero, at_high = (
        evaluate(node, table, [np.full(value.shape, x), *operands[1:]])[0].ravel()  # type: ignore[list-item]
        for x in (0.0, high)
    )
    return shifted(scaled(value, (at_high - at_zero) / high), at_zero)


def _elementwise(
    node: Node, table: atoms.Table, operands: Sequence[atoms.Value | None], varying: list[int]
) -> Affine:
    op = node.op
    values = [atoms.as_affine(operand) for operand in operands]
    weights = {"Add": 1.0, "Mean": 1 / len(values), "Neg": -1.0, "Sub": 1.0, "Sum": 1.0}
    if op not in (*weights, "Cast", "Div", "Mul", "Not"):
        raise ModelError(atoms.NOT_AFFINE)
    shape = table.room(np.broadcast_shapes(*(value.shape for value in values)))
    parts = [spread(value, shape) for value in values]
    value = parts[0]
    other = parts[-1]
    if op == "Cast":
        to = int(node.attributes["to"])
        if to not in FLOATING and not (
            atoms.is_binary(table, value) if to == BOOL else atoms.is_whole(table, value)
        ):
            raise ModelError(f"rounds its input to whole numbers, so it {atoms.NOT_AFFINE}")
        return value
    if op == "Mul":
        both = len(varying) == 2
        return (
            atoms.multiplied(table, value, other)
            if both
            else scaled(parts[varying[0]], parts[1 - varying[0]].bias)
        )
    if op == "Div" and varying == [0]:
        # not a product with the reciprocal: 1 / 3 is not a number
        return scaled(value, other.bias, np.divide)
    if op == "Not" and atoms.is_binary(table, value):
        return _opposite(value)
    if op in ("Div", "Not"):
        raise ModelError(atoms.NOT_AFFINE)
    return added(
        [(-1.0 if op == "Sub" and place else weights[op], part) for place, part in enumerate(parts)], shape
    )
