"""Operators on numbers, element by element: on what a file computes from constants, and on the values of a spike."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from spikeloom.compiler.formats.onnx.file import BOOL, Array, Node
from spikeloom.compiler.formats.onnx.moves import Operands
from spikeloom.compiler.formats.onnx.values import Table

Numbers = Callable[[Node, Table, Operands], list[Array]]

FLOATING = (1, 10, 11, 16)
"""Element types that Cast widens to float64."""


def _divide(a: Array, b: Array) -> Array:
    if a.dtype.kind == "i" and b.dtype.kind == "i":
        if np.any(b == 0):
            raise ZeroDivisionError("an integer is divided by zero")
        return np.asarray(np.sign(a) * np.sign(b) * (np.abs(a) // np.abs(b)))
    return np.asarray(a / b)


def _power(a: Array, b: Array) -> Array:
    return np.asarray(np.power(a.astype(np.float64), b)).astype(a.dtype)


COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "Equal": np.equal,
    "Greater": np.greater,
    "GreaterOrEqual": np.greater_equal,
    "Less": np.less,
    "LessOrEqual": np.less_equal,
}

_BINARY: Mapping[str, Callable[[Any, Any], Any]] = {
    "Add": np.add,
    "And": np.logical_and,
    "Div": _divide,
    "Mod": np.fmod,
    "Mul": np.multiply,
    "Or": np.logical_or,
    "Pow": _power,
    "Sub": np.subtract,
    "Xor": np.logical_xor,
    **COMPARISONS,
}

_UNARY: Mapping[str, Callable[[Any], Any]] = {
    "Abs": np.abs,
    "Ceil": np.ceil,
    "Exp": np.exp,
    "Floor": np.floor,
    "IsNaN": np.isnan,
    "Log": np.log,
    "Neg": np.negative,
    "Not": np.logical_not,
    "Reciprocal": np.reciprocal,
    "Relu": lambda x: np.maximum(x, 0),
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "Sign": np.sign,
    "Sqrt": np.sqrt,
    "Tanh": np.tanh,
}


def _binary(node: Node, table: Table, operands: Operands) -> list[Array]:
    first, second = operands
    table.room(np.broadcast_shapes(first.shape, second.shape))
    return [np.asarray(_BINARY[node.op](first, second))]


def _unary(node: Node, _table: Table, operands: Operands) -> list[Array]:
    return [np.asarray(_UNARY[node.op](operands[0]))]


def _several(node: Node, table: Table, operands: Operands) -> list[Array]:
    table.room(np.broadcast_shapes(*(operand.shape for operand in operands)))
    total = operands[0]
    for operand in operands[1:]:
        match node.op:
            case "Max":
                total = np.maximum(total, operand)
            case "Min":
                total = np.minimum(total, operand)
            case _:
                total = total + operand
    return [np.asarray(total / len(operands) if node.op == "Mean" else total)]


def _cast(node: Node, _table: Table, operands: Operands) -> list[Array]:
    to = int(node.attributes["to"])
    if to in FLOATING:
        return [operands[0].astype(np.float64)]
    return [operands[0].astype(np.bool_ if to == BOOL else np.int64)]


def _clip(node: Node, _table: Table, operands: Operands) -> list[Array]:
    bounds = [*operands[1:], None, None][:2]
    low = node.attributes.get("min", bounds[0])
    high = node.attributes.get("max", bounds[1])
    return [operands[0] if low is None and high is None else np.clip(operands[0], low, high)]


def _constant_of_shape(node: Node, table: Table, operands: Operands) -> list[Array]:
    filling = np.asarray(node.attributes.get("value", np.zeros(1)))
    return [np.full(table.room([int(size) for size in operands[0]]), filling.ravel()[0])]


def _range(_node: Node, table: Table, operands: Operands) -> list[Array]:
    start, limit, delta = (operand.reshape(()).item() for operand in operands)
    table.room([max(0, int((limit - start) / delta) + 1)])
    return [np.arange(start, limit, delta)]


def _nonzero(_node: Node, _table: Table, operands: Operands) -> list[Array]:
    return [np.array(np.nonzero(operands[0]), np.int64)]


def _batch_norm(node: Node, _table: Table, operands: Operands) -> list[Array]:
    if node.attributes.get("training_mode", 0):
        raise ValueError("it is in training mode; export the module after eval()")
    data = operands[0]
    gain, shift, mean, variance = (part.reshape(-1, *[1] * (data.ndim - 2)) for part in operands[1:5])
    root = np.sqrt(variance + node.attributes.get("epsilon", 1e-5))
    return [(data - mean) / root * gain + shift]


NUMBERS: Mapping[str, Numbers] = {
    **dict.fromkeys(_BINARY, _binary),
    **dict.fromkeys(_UNARY, _unary),
    **dict.fromkeys(("Max", "Mean", "Min", "Sum"), _several),
    "BatchNormalization": _batch_norm,
    "Cast": _cast,
    "Clip": _clip,
    "ConstantOfShape": _constant_of_shape,
    "NonZero": _nonzero,
    "Range": _range,
}
"""By operator: what it does to constants."""

POINTWISE = frozenset((*_BINARY, *_UNARY, "Max", "Min", "Sum", "Mean", "Cast", "Clip", "Where"))
"""Operators that act on each element alone, and so on each of the three values that a threshold chooses from."""
