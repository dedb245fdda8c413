"""Operators on values that vary: which stay affine, and what their coefficients are.

Nothing here looks for patterns. A sum, a gather, a convolution with constant weights give new coefficients; a
comparison of a membrane with a threshold gives a spike; a product of a membrane with its own spikes is kept as what it
is, since it is how a membrane is reset. Everything else is refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.fixedpoint import FloatArray
from spikeloom.compiler.formats.onnx.elementwise import COMPARISONS, FLOATING, NUMBERS, POINTWISE
from spikeloom.compiler.formats.onnx.file import BOOL, Array, Node
from spikeloom.compiler.formats.onnx.gates import (
    NOT_AFFINE,
    as_affine,
    chosen,
    compared,
    is_binary,
    is_whole,
    multiplied,
    scaled_by,
    spread,
)
from spikeloom.compiler.formats.onnx.linear import LINEAR, scatter_matrix
from spikeloom.compiler.formats.onnx.moves import MOVES, Operands
from spikeloom.compiler.formats.onnx.values import (
    SAMPLES,
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
UNKNOWN = "is an operator that is not known here; write the layer with other operators"

STATEFUL = ("GRU", "LSTM", "RNN")
_SMOOTH = frozenset(
    [
        "ArgMax",
        "Celu",
        "Cos",
        "Elu",
        "Erf",
        "Gelu",
        "HardSigmoid",
        "HardSwish",
        "InstanceNormalization",
        "LayerNormalization",
        "LeakyRelu",
        "LogSoftmax",
        "MaxPool",
        "Mish",
        "PRelu",
        "Selu",
        "Sin",
        "Softmax",
        "Softplus",
        "Softsign",
        "Tan",
        "TopK",
    ]
)
"""Operators that are not affine, known by name only, for a clear refusal."""

CONSTANT = "is computed from constants by an operator that is not known here; fold constants before the export"


def numbers_of(node: Node) -> Callable[[Node, Table, Operands], list[Array]]:
    """What an operator does to constants.

    Raises
    ------
    ModelError
        If it is not known.
    """
    if node.op in MOVES:
        return MOVES[node.op][0]
    if node.op in LINEAR:
        return LINEAR[node.op][0]
    if node.op in NUMBERS:
        return NUMBERS[node.op]
    raise ModelError(NO_LIF if node.op in STATEFUL else CONSTANT)


def apply(node: Node, table: Table, operands: Sequence[Value | None]) -> list[Value]:
    """Results of an operator, whatever its operands are.

    Raises
    ------
    ModelError
        If it is not known, or not affine in what varies; without its name.
    """
    if not any(isinstance(operand, Affine | Decision) for operand in operands):
        return list(numbers_of(node)(node, table, operands))
    decisions = {operand.point for operand in operands if isinstance(operand, Decision)}
    if node.op in POINTWISE and len(decisions) == 1 and not any(isinstance(o, Affine) for o in operands):
        decided = _decided(node, table, operands)
        if decided is not None:
            return [decided]
    values = [as_affine(table, operand) if isinstance(operand, Decision) else operand for operand in operands]
    varying = [place for place, operand in enumerate(values) if isinstance(operand, Affine)]
    if node.op in MOVES and not (node.op == "Where" and 0 in varying) and node.attributes.get("reduction") != "add":
        return _moved(node, table, values)
    return [_single(node, table, values, varying)]


def _single(node: Node, table: Table, values: Sequence[Value | None], varying: list[int]) -> Value:
    """The result of an operator that does not only move numbers."""
    if node.op in COMPARISONS or node.op == "Sign":
        return compared(node, table, values)
    if node.op == "Where":
        return chosen(table, values)
    if node.op in ("ScatterElements", "ScatterND"):
        return _scattered(node, table, values)
    if node.op in LINEAR:
        return _linear(node, table, values, varying)
    return _elementwise(node, table, values, varying)


def sampled(node: Node, table: Table, operands: Sequence[Value | None]) -> list[FloatArray]:
    """Results for the random numbers, (SAMPLES, size) each, by the operator itself."""
    runs = []
    function = numbers_of(node)
    for k in range(SAMPLES):
        arrays = [o.sample[k].reshape(o.shape) if isinstance(o, Affine) else o for o in operands]
        runs.append([np.asarray(result, np.float64).ravel() for result in function(node, table, arrays)])
    return [np.stack(results) for results in zip(*runs, strict=True)]


def _decided(node: Node, table: Table, operands: Sequence[Value | None]) -> Value | None:
    """An operator on each of the three values; None where it spreads them over more elements than the layer has."""
    decision = next(operand for operand in operands if isinstance(operand, Decision))
    results = []
    for which in range(3):
        arrays = [o.values[which] if isinstance(o, Decision) else o for o in operands]
        results.append(numbers_of(node)(node, table, arrays)[0])
    if results[0].shape != decision.shape:
        return None
    return Decision(point=decision.point, values=(results[0], results[1], results[2]))


def _scattered(node: Node, table: Table, values: Sequence[Value | None]) -> Value:
    """A scattering sum: data plus what the updates bring."""
    data, updates = values[0], values[2]
    if not isinstance(values[1], np.ndarray):
        raise ModelError("takes its indices from what varies; only a fixed graph can be lowered")
    start, more = (as_affine(table, value) for value in (data, updates) if value is not None)
    shapes = [np.zeros(start.shape), values[1], np.zeros(more.shape)]
    matrix = scatter_matrix(node, shapes)
    sample = sampled(node, table, values)[0]
    return added([(1.0, start), (1.0, through(matrix, more, start.shape, sample))], start.shape, sample)


def through(matrix: Sparse, value: Affine, shape: tuple[int, ...], sample: FloatArray) -> Affine:
    """A value after a linear operator; coefficients that an identity meets are the operator's own."""
    terms = {}
    for atom, own in value.terms.items():
        terms[atom] = matrix if diagonal(own) == 1 else (matrix @ own).tocsr()
        terms[atom].sort_indices()
    return Affine(shape=shape, terms=terms, bias=matrix @ value.bias, sample=sample)


def _moved(node: Node, table: Table, values: Sequence[Value | None]) -> list[Value]:
    """A move, by moving positions; position 0 is a constant zero, then come all elements of all operands in turn."""
    move, places = MOVES[node.op]
    data = [place for place in (range(len(values)) if places is None else places) if place < len(values)]
    if any(isinstance(value, Affine) and place not in data for place, value in enumerate(values)):
        raise ModelError("takes indices or sizes from what varies; only a fixed graph can be lowered")
    parts = {place: as_affine(table, value) for place in data if (value := values[place]) is not None}
    positions: list[Value | None] = list(values)
    start = 1
    for place, part in parts.items():
        positions[place] = (start + np.arange(size_of(part.shape))).reshape(part.shape)
        start += size_of(part.shape)
    samples = sampled(node, table, values)
    results: list[Value] = []
    for rows, sample in zip(move(node, table, positions), samples, strict=True):
        results.append(_rows_of_all(list(parts.values()), np.asarray(rows), start, sample))
    return results


def _rows_of_all(parts: list[Affine], rows: Array, total: int, sample: FloatArray) -> Affine:
    flat = rows.ravel()
    if len(parts) == 1 and flat.size and flat.min() >= 1:
        return picked(parts[0], flat - 1, rows.shape, sample)
    bias, terms = np.zeros(total), {}
    starts = np.cumsum([1, *(len(part.bias) for part in parts)])
    for start, part in zip(starts, parts, strict=False):
        bias[start : start + len(part.bias)] = part.bias
    for atom in dict.fromkeys(atom for part in parts for atom in part.terms):
        width = next(part.terms[atom].shape[1] for part in parts if atom in part.terms)
        blocks = [part.terms.get(atom, sparse.csr_array((len(part.bias), width))) for part in parts]
        stacked = sparse.vstack([sparse.csr_array((1, width)), *blocks], format="csr")
        terms[atom] = rows_of(stacked, flat)
    kept = {atom: own for atom, own in terms.items() if own.nnz}
    return Affine(shape=rows.shape, terms=kept, bias=bias[flat], sample=sample)


def _linear(node: Node, table: Table, values: Sequence[Value | None], varying: list[int]) -> Value:
    matrix_of = LINEAR[node.op][1]
    if node.op == "Gemm" and 2 in varying:
        bare = Node(
            name=node.name, op=node.op, inputs=node.inputs[:2], outputs=node.outputs, attributes=node.attributes
        )
        product = as_affine(table, apply(bare, table, values[:2])[0])
        sample = sampled(node, table, values)[0]
        extra = spread(as_affine(table, values[2]), product.shape)  # type: ignore[arg-type]
        return added([(1.0, product), (node.attributes.get("beta", 1.0), extra)], product.shape, sample)
    if matrix_of is None or len(varying) != 1 or varying[0] not in LINEAR[node.op][2]:
        raise ModelError(NOT_AFFINE)
    place = varying[0]
    value = values[place]
    assert isinstance(value, Affine)
    silent = [np.zeros(value.shape) if index == place else operand for index, operand in enumerate(values)]
    constants = [operand for index, operand in enumerate(values) if index != place and operand is not None]
    key = (node.op, place, value.shape, str(sorted(node.attributes.items())), *(id(array) for array in constants))
    if key not in table.matrices:
        found = np.asarray(LINEAR[node.op][0](node, table, silent)[0], np.float64)
        table.matrices[key] = matrix_of(node, table, silent, place), found, constants
    matrix, offset, _ = table.matrices[key]
    moved = through(matrix, value, offset.shape, sampled(node, table, values)[0])
    return Affine(shape=moved.shape, terms=moved.terms, bias=moved.bias + offset.ravel(), sample=moved.sample)


def _elementwise(node: Node, table: Table, values: Sequence[Value | None], varying: list[int]) -> Value:
    op = node.op
    if op == "Cast" and varying == [0]:
        return _cast(node, table, values[0])
    if op == "BatchNormalization" and varying == [0]:
        return _affine_map(node, table, values)
    if op in ("Add", "Div", "Mean", "Mul", "Neg", "Not", "Sub", "Sum") and all(value is not None for value in values):
        shape = table.room(np.broadcast_shapes(*(v.shape for v in values)))  # type: ignore[union-attr]
        parts = [spread(as_affine(table, value), shape) for value in values]  # type: ignore[arg-type]
        return _added(op, parts) if op in ("Add", "Mean", "Neg", "Sub", "Sum") else _scaled(op, table, parts, varying)
    if op in STATEFUL:
        raise ModelError(NO_LIF)
    raise ModelError(NOT_AFFINE if op in NUMBERS or op in _SMOOTH else UNKNOWN)


def _cast(node: Node, table: Table, value: Value | None) -> Value:
    assert isinstance(value, Affine)
    to = int(node.attributes["to"])
    if to in FLOATING or (is_binary(table, value) if to == BOOL else is_whole(table, value)):
        return value
    raise ModelError(f"rounds its input to whole numbers, so it {NOT_AFFINE}")


def _added(op: str, parts: list[Affine]) -> Value:
    weights = {"Sub": [1.0, -1.0], "Neg": [-1.0], "Mean": [1 / len(parts)] * len(parts)}.get(op, [1.0] * len(parts))
    pairs = list(zip(weights, parts, strict=True))
    return added(pairs, parts[0].shape, np.asarray(sum(weight * part.sample for weight, part in pairs)))


def _scaled(op: str, table: Table, parts: list[Affine], varying: list[int]) -> Value:
    value, other = parts[0], parts[-1]
    match op:
        case "Mul" if len(varying) == 2:
            return multiplied(table, value, other, value.sample * other.sample)
        case "Mul":
            return scaled(parts[varying[0]], parts[1 - varying[0]].bias, value.sample * other.sample)
        case "Div" if varying == [0]:
            # Division, not a product with the reciprocal: 1 / 3 is not a number.
            terms = {atom: own.copy() for atom, own in value.terms.items()}
            for own in terms.values():
                own.data = own.data / np.repeat(other.bias, np.diff(own.indptr))
            quotient = value.sample / other.sample
            return Affine(shape=value.shape, terms=terms, bias=value.bias / other.bias, sample=quotient)
        case "Not" if is_binary(table, value):
            return scaled_by(value, np.full(len(value.bias), -1.0), np.array(1.0), 1 - value.sample)
    raise ModelError(NOT_AFFINE)


def _affine_map(node: Node, table: Table, values: Sequence[Value | None]) -> Value:
    """An operator that maps each element by an affine function of its own: read from what it does to 0 and 1."""
    value = values[0]
    assert isinstance(value, Affine)
    function = numbers_of(node)
    shift = function(node, table, [np.zeros(value.shape), *values[1:]])[0].ravel()
    gain = (function(node, table, [np.full(value.shape, 2.0**20), *values[1:]])[0].ravel() - shift) / 2.0**20
    return scaled_by(value, gain, shift, sampled(node, table, values)[0])


def check(table: Table, value: Affine) -> None:
    """Hold coefficients against what the operators made of random numbers.

    Raises
    ------
    ModelError
        If they disagree.
    """
    affine = np.tile(value.bias, (SAMPLES, 1))
    for atom, own in value.terms.items():
        affine += (own @ table.atoms[atom].sample.T).T
    largest = np.maximum(np.abs(affine).max(axis=1, initial=0), 1e-300)
    worst = np.abs(value.sample - affine).max(axis=1, initial=0) / largest
    if not np.all(np.isfinite(affine)):
        raise ModelError("has coefficients that are not finite; train it again")
    if not np.all(worst <= TOLERANCE):
        raise ModelError(f"is off by {worst.max():.2g} from an affine stage on random inputs ({TOLERANCE:g} allowed)")


TOLERANCE = 1e-9
"""Largest deviation from affinity, relative to the largest response, that rounding in float64 explains."""
