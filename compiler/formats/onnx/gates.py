"""Values that a threshold decides: comparisons, what is chosen by them, and the reset of a membrane by its spikes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.evaluate import COMPARISONS
from spikeloom.compiler.formats.onnx.file import Node
from spikeloom.compiler.formats.onnx.values import (
    INPUT_ATOM,
    MEMBRANE,
    SPIKE,
    Affine,
    Decision,
    Point,
    Table,
    Value,
    added,
    diagonal,
    one_each,
    picked,
    scaled,
    size_of,
)
from spikeloom.compiler.types import FloatArray

NOT_AFFINE = "is not affine in its input; only affine operators between two spiking layers can become synapses"


def present(value: Value | None) -> Value:
    """An operand that must be there, else ModelError."""
    if value is None:
        raise ModelError("lacks an operand; export it again")
    return value


def as_affine(table: Table, operand: Value | None) -> Affine:
    """A value that varies as an affine one: a choice by a threshold becomes a multiple of the spikes.

    Raises ModelError if it has a third value at the threshold itself, or is missing.
    """
    value = present(operand)
    if isinstance(value, Affine):
        return value
    if isinstance(value, Decision):
        low, equal, high = (array.ravel().astype(np.float64) for array in value.values)
        strict = np.array_equal(equal, low)
        if not strict and not np.array_equal(equal, high):
            raise ModelError(
                "takes a third value where the membrane equals the threshold; write a spike as u > theta or u >= theta"
            )
        spike = table.spike(value.point, strict=strict)
        return scaled_by(table.value(spike, value.shape), high - low, low)
    array = np.asarray(value, np.float64)
    return Affine(shape=array.shape, terms={}, bias=array.ravel())


def scaled_by(value: Affine, factor: FloatArray, shift: FloatArray) -> Affine:
    """Each element times one constant plus another."""
    times = value if np.all(factor == 1) else scaled(value, factor)
    return Affine(shape=value.shape, terms=times.terms, bias=times.bias + shift)


def compared(node: Node, table: Table, values: Sequence[Value | None]) -> Value:
    """A comparison of a membrane with a threshold, or its sign."""
    first = values[0]
    second = np.zeros(()) if node.op == "Sign" else values[1]
    if isinstance(first, Affine) and isinstance(second, Affine):
        raise ModelError("compares two values that both vary; only a fixed threshold can be lowered")
    mirrored = not isinstance(first, Affine)
    membrane, limit = (second, first) if mirrored else (first, second)
    if not isinstance(membrane, Affine) or not isinstance(limit, np.ndarray):
        raise ModelError("lacks an operand; export it again")
    single = next(iter(membrane.terms), -1)
    factor = diagonal(membrane.terms[single]) if len(membrane.terms) == 1 else None
    if not factor or table.atoms[single].kind not in (MEMBRANE, INPUT_ATOM):
        raise ModelError(
            "compares what is not the membrane of a layer; only a membrane can be held against a threshold"
        )
    theta = (np.broadcast_to(limit, membrane.shape).ravel().astype(np.float64) - membrane.bias) / factor
    key = ("point", single, theta.tobytes())
    if key not in table.known:
        table.points.append(Point(node=str(node), membrane=single, theta=theta))
        table.known[key] = len(table.points) - 1
    sides = [np.sign(factor) * side for side in (-1, 0, 1)]
    if node.op == "Sign":
        outcomes = [np.full(membrane.shape, side) for side in sides]
    else:
        compare = COMPARISONS[node.op]
        outcomes = [np.full(membrane.shape, compare(0, s) if mirrored else compare(s, 0)) for s in sides]
    return Decision(point=table.known[key], values=(outcomes[0], outcomes[1], outcomes[2]))


def chosen(table: Table, values: Sequence[Value | None]) -> Value:
    """``Where(s, a, b) = b + s * (a - b)`` for a spike s."""
    condition = values[0]
    assert isinstance(condition, Affine)
    if not is_binary(table, condition):
        raise ModelError("chooses by what is neither a spike nor a constant; only spikes can choose")
    shape = table.room(np.broadcast_shapes(*(np.shape(v) if isinstance(v, np.ndarray) else v.shape for v in values)))  # type: ignore[union-attr]
    s, a, b = (spread(as_affine(table, value), shape) for value in values)
    product = multiplied(table, s, added([(1.0, a), (-1.0, b)], shape))
    return added([(1.0, b), (1.0, product)], shape)


def is_binary(table: Table, value: Affine) -> bool:
    """Whether a value is zeros and ones: spikes, or an input of truth values, one for each element."""
    counts = sum((np.diff(terms.indptr) for terms in value.terms.values()), start=np.zeros(len(value.bias), np.int64))
    ones = all(np.all(terms.data == 1) for terms in value.terms.values())
    return is_whole(table, value) and not np.any(value.bias) and bool(np.all(counts <= 1)) and ones


def is_whole(table: Table, value: Affine) -> bool:
    """Whether a value is a whole number: a count of spikes."""
    parts = [value.bias, *(terms.data for terms in value.terms.values())]
    return all(table.atoms[atom].binary for atom in value.terms) and all(np.all(part % 1 == 0) for part in parts)


def spread(value: Affine, shape: tuple[int, ...]) -> Affine:
    """A value broadcast to a shape."""
    if value.shape == shape:
        return value
    rows = np.broadcast_to(np.arange(size_of(value.shape)).reshape(value.shape), shape).ravel()
    return picked(value, rows, shape)


def multiplied(table: Table, a: Affine, b: Affine) -> Affine:
    """A product of two values that vary: of a membrane with its spikes, or of two inputs that may be these."""
    size = len(a.bias)
    parts = []
    for value, factor in ((a, b.bias), (b, a.bias)):
        if np.any(factor):
            parts.append(Affine(shape=a.shape, terms=scaled(value, factor).terms, bias=np.zeros(size)))
    for first, own in a.terms.items():
        for second, other in b.terms.items():
            one, two = one_each(own), one_each(other)
            if one is None or two is None:
                raise ModelError(NOT_AFFINE)
            coefficient = one[0] * two[0]
            if not np.any(coefficient):
                continue
            used = coefficient != 0
            if np.any(one[1][used] != two[1][used]):
                raise ModelError(NOT_AFFINE)
            atom = _pair(table, first, second)
            rows = np.flatnonzero(used)
            terms = sparse.csr_array((coefficient[rows], (rows, one[1][rows])), shape=(size, table.atoms[atom].size))
            parts.append(Affine(shape=a.shape, terms={atom: terms}, bias=np.zeros(size)))
    constant = Affine(shape=a.shape, terms={}, bias=a.bias * b.bias)
    return added([(1.0, part) for part in [constant, *parts]], a.shape)


def _pair(table: Table, first: int, second: int) -> int:
    """Atom of a product of two atoms, where it may be a reset."""
    kinds = {table.atoms[first].kind, table.atoms[second].kind}
    if first == second and table.atoms[first].binary:
        return first
    if kinds == {INPUT_ATOM} and first != second:
        return table.product(first, second)
    spike = first if table.atoms[first].kind == SPIKE else second
    other = second if spike == first else first
    if table.atoms[spike].kind == SPIKE and table.points[table.atoms[spike].of[0]].membrane == other:
        return table.product(first, second)
    raise ModelError(f"multiplies {table.atoms[first]} by {table.atoms[second]}, so it {NOT_AFFINE}")
