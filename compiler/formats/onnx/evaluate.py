"""Operators on numbers: ONNX's own reference runs them, once the shapes that it infers for their results are allowed.

That is for constants, and for positions of elements: an operator that only moves numbers shows by them where each goes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.onnx.affine import Table
from spikeloom.compiler.formats.onnx.file import BOOL, Array, Node, decimal

Operands = Sequence[Array | None]

FLOATING = (1, 10, 11, 16)
"""Element types that Cast widens to float64."""

MOVES: Mapping[str, tuple[int, ...] | None] = {
    "Concat": None,
    "Expand": (0,),
    "Flatten": (0,),
    "Gather": (0,),
    "GatherElements": (0,),
    "GatherND": (0,),
    "Identity": (0,),
    "Pad": (0, 2),
    "Reshape": (0,),
    "ScatterElements": (0, 2),
    "ScatterND": (0, 2),
    "Slice": (0,),
    "Split": (0,),
    "Squeeze": (0,),
    "Tile": (0,),
    "Transpose": (0,),
    "Unsqueeze": (0,),
    "Where": (1, 2),
}
"""Operators whose results are elements of operands, and which operands these are (None: all of them)."""

_OTHERS = """
Abs Add And BatchNormalization Cast Ceil Clip ConstantOfShape Div Equal Exp Floor Gemm Greater GreaterOrEqual IsNaN Less
LessOrEqual Log MatMul Max Mean Min Mod Mul Neg NonZero Not Or Pow Range Reciprocal ReduceMax ReduceMean ReduceMin
ReduceProd ReduceSum Relu Sigmoid Sign Sqrt Sub Sum Tanh Xor
"""
NUMERIC = frozenset(MOVES) | frozenset(_OTHERS.split())
"""Operators that are run on numbers. Others are refused, or are linear and run as their matrix."""

LOOPS, LOOP_WORK = ("GatherND", "ScatterElements", "ScatterND"), 64
"""Operators that the reference runs element by element, and what one counts for."""

SMALL = 64
"""Elements of an operand that may decide the shape of a result."""


def evaluate(node: Node, table: Table, operands: Operands) -> list[Array]:
    """Results of an operator in ``NUMERIC`` on numbers, in float64, int64 or bool.

    Raises ModelError if a result is too large; the package onnx raises nearly anything on operands or attributes that
    do not fit each other.
    """
    if node.op == "Cast" and operands[0] is not None:
        to = int(node.attributes["to"])
        return [operands[0].astype(np.float64 if to in FLOATING else np.bool_ if to == BOOL else np.int64)]
    if node.op == "BatchNormalization" and node.attributes.get("training_mode", 0):
        raise ModelError("is in training mode; export the module after eval()")
    shapes_of(node, table, operands)
    if node.op in LOOPS:
        table.spend(LOOP_WORK * max(operand.size for operand in operands if operand is not None))
    if node.op == "GatherElements":  # which the reference takes too long for
        data, indices = map(np.asarray, operands)
        axis = range(data.ndim)[int(node.attributes.get("axis", 0))]
        sizes = [data.shape[axis] if place == axis else length for place, length in enumerate(indices.shape)]
        return [np.take_along_axis(data[tuple(map(slice, sizes))], indices, axis)]
    return [np.asarray(result) for result in _operator(node, table).run(*operands)]


def shapes_of(node: Node, table: Table, operands: Operands) -> list[tuple[int, ...]]:
    """Shapes of an operator's results, as ONNX infers them.

    Raises ModelError if one of them is too large, before anything is allocated for it, or unknown; else as
    :func:`evaluate`.
    """
    from onnx import defs, helper, numpy_helper, shape_inference

    proto = _operator(node, table).onnx_node
    given = {name: operand for name, operand in zip(proto.input, operands, strict=True) if operand is not None}
    types = {
        name: helper.make_tensor_type_proto(helper.np_dtype_to_tensor_dtype(array.dtype), array.shape)
        for name, array in given.items()
    }
    small = {name: numpy_helper.from_array(array) for name, array in given.items() if array.size <= SMALL}
    schema = defs.get_schema(node.op, table.opset, "")
    version = helper.make_opsetid("", table.opset)
    inferred = shape_inference.infer_node_outputs(schema, proto, types, small, opset_imports=[version])
    found = []
    for name in proto.output:
        kind = inferred[name].tensor_type if name in inferred else None
        if kind is not None and kind.HasField("shape") and all(d.HasField("dim_value") for d in kind.shape.dim):
            found.append(table.room([d.dim_value for d in kind.shape.dim]))
        elif node.op == "NonZero" and operands[0] is not None:
            found.append(table.room([operands[0].ndim, operands[0].size]))  # at most
        else:
            raise ModelError("makes a value of a size that its operands do not tell; export it again")
    return found


def _operator(node: Node, table: Table) -> Any:
    """ONNX's reference of an operator, with numbers of the program's text as the decimals that were meant."""
    from onnx import helper, numpy_helper
    from onnx.reference.ops import load_op

    if id(node) in table.operators:
        return table.operators[id(node)][1]
    attributes = {
        name: numpy_helper.from_array(value) if isinstance(value, np.ndarray) else value
        for name, value in node.attributes.items()
    }
    inputs = [f"i{place}" if given else "" for place, given in enumerate(node.inputs)]
    outputs = [f"o{place}" for place in range(len(node.outputs))]
    proto = helper.make_node(node.op, inputs, outputs, **attributes)
    settings = {"log": lambda *_: None, "opsets": {"": table.opset}, "new_ops": None}
    operator = load_op("", node.op, table.opset)(proto, settings)
    for name in operator.attributes_names_:
        if isinstance(value := getattr(operator, name), float):
            setattr(operator, name, decimal(value))
    table.operators[id(node)] = node, operator
    return operator
