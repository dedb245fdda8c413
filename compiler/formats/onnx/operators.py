"""Operators on values that vary: which stay affine, and what their coefficients are.

Nothing here looks for patterns. A sum, a gather, a convolution with constant weights give new coefficients; a
comparison of a membrane with a threshold gives a spike; a product of a membrane with its own spikes is kept as what it
is, since it is how a membrane is reset. Everything else is refused by name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.evaluate import (
    COMPARISONS,
    FLOATING,
    MOVES,
    NUMERIC,
    POINTWISE,
    evaluate,
    shapes_of,
)
from spikeloom.compiler.formats.onnx.file import BOOL, Array, Node
from spikeloom.compiler.formats.onnx.gates import (
    NOT_AFFINE,
    as_affine,
    chosen,
    compared,
    is_binary,
    is_whole,
    multiplied,
    present,
    scaled_by,
    spread,
)
from spikeloom.compiler.formats.onnx.matrices import LINEAR
from spikeloom.compiler.formats.onnx.values import (
    Affine,
    Decision,
    Table,
    Value,
    added,
    diagonal,
    picked,
    rows_of,
    scaled,
    size_of,
)
from spikeloom.compiler.ir import Sparse

NO_LIF = "keeps a state that is no leaky integrate-and-fire neuron; only such neurons can be lowered"
STATEFUL = ("GRU", "LSTM", "RNN")

CONSTANT = "is computed from constants by an operator that is not known here; fold constants before the export"


def apply(node: Node, table: Table, operands: Sequence[Value | None]) -> list[Value]:  # noqa: PLR0911 a kind each
    """Results of an operator, whatever its operands are.

    Raises ModelError if it is not known, or not affine in what varies; without its name.
    """
    if not any(isinstance(operand, Affine | Decision) for operand in operands):
        return _constant(node, table, operands)
    decisions = {operand.point for operand in operands if isinstance(operand, Decision)}
    alone = node.op in POINTWISE and len(decisions) == 1 and not any(isinstance(o, Affine) for o in operands)
    if alone and (decided := _decided(node, table, operands)) is not None:
        return [decided]
    values = [as_affine(table, operand) if isinstance(operand, Decision) else operand for operand in operands]
    varying = [place for place, operand in enumerate(values) if isinstance(operand, Affine)]
    if node.op in MOVES and not (node.op == "Where" and 0 in varying) and node.attributes.get("reduction") != "add":
        return _moved(node, table, values)
    if node.op in COMPARISONS or node.op == "Sign":
        return [compared(node, table, values)]
    if node.op == "Where":
        return [chosen(table, values)]
    if node.op in ("ScatterElements", "ScatterND"):
        return [_scattered(node, table, values)]
    if node.op in LINEAR:
        return [_linear(node, table, values, varying)]
    return [_elementwise(node, table, values, varying)]


def _constant(node: Node, table: Table, operands: Sequence[Value | None]) -> list[Value]:
    """An operator on numbers; those that are no more than linear run as their matrix."""
    if node.op in NUMERIC:
        return list(evaluate(node, table, operands))  # type: ignore[arg-type]
    if node.op not in LINEAR:
        raise ModelError(NO_LIF if node.op in STATEFUL else CONSTANT)
    first = as_affine(table, operands[0])
    result = _linear(node, table, [first, *operands[1:]], [0])
    return [result.bias.reshape(result.shape)]


def _decided(node: Node, table: Table, operands: Sequence[Value | None]) -> Value | None:
    """An operator on each of the three values; None where it spreads them over more elements than the layer has."""
    decision = next(operand for operand in operands if isinstance(operand, Decision))
    results = []
    for which in range(3):
        arrays = [o.values[which] if isinstance(o, Decision) else o for o in operands]
        results.append(evaluate(node, table, arrays)[0])  # type: ignore[arg-type]
    if results[0].shape != decision.shape:
        return None
    return Decision(point=decision.point, values=(results[0], results[1], results[2]))


def _scattered(node: Node, table: Table, values: Sequence[Value | None]) -> Value:
    """A scattering sum: data plus what the updates bring; a gathering of positions tells where each goes."""
    start, more = (as_affine(table, values[place]) for place in (0, 2))
    if not isinstance(values[1], np.ndarray):
        raise ModelError("takes its indices from what varies; only a fixed graph can be lowered")
    op = node.op.replace("Scatter", "Gather")
    axis = {"axis": node.attributes.get("axis", 0)} if op == "GatherElements" else {}
    gather = Node(name=node.name, op=op, inputs=node.inputs[:2], outputs=node.outputs, attributes=axis)
    places = np.arange(size_of(start.shape)).reshape(start.shape)
    target = evaluate(gather, table, [places, values[1]])[0]
    if target.shape != more.shape:
        raise ValueError("updates of another shape than the indices")
    size = len(more.bias)
    matrix = sparse.coo_array((np.ones(size), (target.ravel(), np.arange(size))), shape=(len(start.bias), size)).tocsr()
    return added([(1.0, start), (1.0, through(matrix, more, start.shape))], start.shape)


def through(matrix: Sparse, value: Affine, shape: tuple[int, ...]) -> Affine:
    """A value after a linear operator; coefficients that an identity meets are the operator's own."""
    terms = {}
    for atom, own in value.terms.items():
        terms[atom] = matrix if diagonal(own) == 1 else (matrix @ own).tocsr()
        terms[atom].sort_indices()
    return Affine(shape=shape, terms=terms, bias=matrix @ value.bias)


def _moved(node: Node, table: Table, values: Sequence[Value | None]) -> list[Value]:
    """A move, by moving positions; position 0 is a constant zero, then come all elements of all operands in turn."""
    places = MOVES[node.op]
    data = [place for place in (range(len(values)) if places is None else places) if place < len(values)]
    if any(isinstance(value, Affine) and place not in data for place, value in enumerate(values)):
        raise ModelError("takes indices or sizes from what varies; only a fixed graph can be lowered")
    if node.attributes.get("mode", "constant") != "constant" or node.attributes.get("reduction", "none") != "none":
        raise ValueError("only constant padding, and scattering that replaces or adds, are known")
    parts = {place: as_affine(table, value) for place in data if (value := values[place]) is not None}
    positions: list[Value | None] = list(values)
    start = 1
    for place, part in parts.items():
        positions[place] = (start + np.arange(size_of(part.shape))).reshape(part.shape)
        start += size_of(part.shape)
    moved = evaluate(node, table, positions)  # type: ignore[arg-type]
    return [rows_of_all(list(parts.values()), rows, start) for rows in moved]


def rows_of_all(parts: list[Affine], rows: Array, total: int) -> Affine:
    """Elements of several values one after the other, of `total` with the constant zero in front."""
    flat = rows.ravel()
    if len(parts) == 1 and flat.size and flat.min() >= 1:
        return picked(parts[0], flat - 1, rows.shape)
    bias, terms = np.zeros(total), {}
    starts = np.cumsum([1, *(len(part.bias) for part in parts)])
    for start, part in zip(starts, parts, strict=False):
        bias[start : start + len(part.bias)] = part.bias
    for atom in dict.fromkeys(atom for part in parts for atom in part.terms):
        width = next(part.terms[atom].shape[1] for part in parts if atom in part.terms)
        blocks = [part.terms.get(atom, sparse.csr_array((len(part.bias), width))) for part in parts]
        stacked = sparse.vstack([sparse.csr_array((1, width)), *blocks], format="csr")
        terms[atom] = rows_of(stacked, flat)
    return Affine(shape=rows.shape, terms={atom: own for atom, own in terms.items() if own.nnz}, bias=bias[flat])


def _linear(node: Node, table: Table, values: Sequence[Value | None], varying: list[int]) -> Affine:
    """A linear operator through its matrix, and the bias that Conv and Gemm add."""
    has_bias = node.op in ("Conv", "Gemm")
    inner = [place for place in varying if not (has_bias and place == 2)]
    matrix_of, allowed = LINEAR[node.op]
    if has_bias and not inner:  # only the bias varies
        values, inner = [as_affine(table, values[0]), *values[1:]], [0]
    if len(inner) != 1 or inner[0] not in allowed:
        raise ModelError(NOT_AFFINE)
    place = inner[0]
    value = values[place]
    assert isinstance(value, Affine)
    operands = [np.zeros(each.shape) if isinstance(each, Affine | Decision) else each for each in values]
    if not node.op.startswith("Reduce"):  # whose second operand is a list of axes
        operands = [None if each is None else each.astype(np.float64) for each in operands]
    constants = [operand for index, operand in enumerate(values) if index != place and operand is not None]
    key = (node.op, place, value.shape, str(sorted(node.attributes.items())), *(id(array) for array in constants))
    if key not in table.matrices:
        shape = shapes_of(node, table, operands)[0]
        matrix = matrix_of(node, table, operands[:2], place)
        if matrix.shape[0] != size_of(shape):
            raise ValueError("sizes that do not fit each other")
        table.matrices[key] = matrix, shape, constants
    matrix, shape, _ = table.matrices[key]
    result = through(matrix, value, shape)
    if not has_bias or len(values) < 3 or values[2] is None:
        return result
    extra = as_affine(table, values[2])
    if node.op == "Conv":
        extra = replace(extra, shape=(len(extra.bias), *[1] * (len(shape) - 2)))
    factor = node.attributes.get("beta", 1.0) if node.op == "Gemm" else 1.0
    return added([(1.0, result), (factor, spread(extra, shape))], shape)


def _elementwise(node: Node, table: Table, values: Sequence[Value | None], varying: list[int]) -> Value:
    op = node.op
    if op == "BatchNormalization" and varying == [0]:
        return _affine_map(node, table, values)
    if op not in ("Add", "Cast", "Div", "Mean", "Mul", "Neg", "Not", "Sub", "Sum"):
        raise ModelError(NO_LIF if op in STATEFUL else NOT_AFFINE)
    shape = table.room(np.broadcast_shapes(*(present(value).shape for value in values)))
    parts = [spread(as_affine(table, value), shape) for value in values]
    value, other = parts[0], parts[-1]
    if op == "Cast":
        to = int(node.attributes["to"])
        if to not in FLOATING and not (is_binary(table, value) if to == BOOL else is_whole(table, value)):
            raise ModelError(f"rounds its input to whole numbers, so it {NOT_AFFINE}")
        found = value
    elif op == "Mul":
        both = len(varying) == 2
        found = multiplied(table, value, other) if both else scaled(parts[varying[0]], parts[1 - varying[0]].bias)
    elif op == "Div" and varying == [0]:
        # not a product with the reciprocal: 1 / 3 is not a number
        found = scaled(value, other.bias, np.divide)
    elif op == "Not" and is_binary(table, value):
        found = scaled_by(value, np.full(len(value.bias), -1.0), np.array(1.0))
    elif op in ("Div", "Not"):
        raise ModelError(NOT_AFFINE)
    else:
        weights = {"Sub": [1.0, -1.0], "Neg": [-1.0], "Mean": [1 / len(parts)] * len(parts)}
        found = added(list(zip(weights.get(op, [1.0] * len(parts)), parts, strict=True)), shape)
    return found


def _affine_map(node: Node, table: Table, values: Sequence[Value | None]) -> Value:
    """An operator that maps each element by an affine function of its own: read from what it does to 0 and 2**20."""
    value, rest = values[0], values[1:]
    assert isinstance(value, Affine)
    shift, high = (
        evaluate(node, table, [np.full(value.shape, x), *rest])[0].ravel()  # type: ignore[list-item]
        for x in (0.0, 2.0**20)
    )
    return scaled_by(value, (high - shift) / 2.0**20, shift)


def require_finite(value: Affine, where: str = "") -> None:
    """Refuse coefficients that are not finite numbers: ModelError."""
    if not all(np.all(np.isfinite(part)) for part in (value.bias, *(own.data for own in value.terms.values()))):
        raise ModelError(f"{where}has coefficients that are not finite; train it again")
