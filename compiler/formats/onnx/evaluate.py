"""Operators on numbers, and linear ones as the matrix from one operand to the result while the others are constant.

On numbers ONNX's own reference runs them, once the shapes that it infers for their results are allowed. That
is for constants, and for positions of elements: an operator that only moves numbers shows by them where each
goes.
"""

import math
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.affine import block_diagonal, convolution
from spikeloom.compiler.formats.onnx.atoms import COEFFICIENT_LIMIT, Table
from spikeloom.compiler.formats.onnx.file import BOOL, Node, decimal
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import AnyArray

Operands = Sequence[AnyArray | None]

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

SMALL = 64
"""Elements of an operand that may decide the shape of a result."""


def evaluate(node: Node, table: Table, operands: Operands) -> list[AnyArray]:
    """Results of an operator in ``NUMERIC`` on numbers, in float64, int64 or bool.

    Raises ModelError if a result is too large; the package onnx raises nearly anything on operands or
    attributes that do not fit each other.
    """
    if node.op == "Cast" and operands[0] is not None:
        to = int(node.attributes["to"])
        return [operands[0].astype(np.float64 if to in FLOATING else np.bool_ if to == BOOL else np.int64)]
    if node.op == "BatchNormalization" and node.attributes.get("training_mode", 0):
        raise ModelError("is in training mode; export the module after eval()")
    shapes_of(node, table, operands)
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

    proto = _proto(node)
    given = {
        name: operand for name, operand in zip(proto.input, operands, strict=True) if operand is not None
    }
    types = {
        name: helper.make_tensor_type_proto(helper.np_dtype_to_tensor_dtype(array.dtype), array.shape)
        for name, array in given.items()
    }
    small = {name: numpy_helper.from_array(array) for name, array in given.items() if array.size <= SMALL}
    schema = defs.get_schema(node.op, table.opset, "")
    version = helper.make_opsetid("", table.opset)
    inferred = shape_inference.infer_node_outputs(schema, proto, types, small, opset_imports=[version])
    shapes = []
    for name in proto.output:
        kind = inferred[name].tensor_type if name in inferred else None
        if (
            kind is not None
            and kind.HasField("shape")
            and all(d.HasField("dim_value") for d in kind.shape.dim)
        ):
            shapes.append(table.room([d.dim_value for d in kind.shape.dim]))
        elif node.op == "NonZero" and operands[0] is not None:
            shapes.append(table.room([operands[0].ndim, operands[0].size]))  # at most
        else:
            raise ModelError("makes a value of a size that its operands do not tell; export it again")
    return shapes


def _proto(node: Node) -> Any:
    from onnx import helper, numpy_helper

    attributes = {
        name: numpy_helper.from_array(value) if isinstance(value, np.ndarray) else value
        for name, value in node.attributes.items()
    }
    inputs = [f"i{place}" if given else "" for place, given in enumerate(node.inputs)]
    outputs = [f"o{place}" for place in range(len(node.outputs))]
    return helper.make_node(node.op, inputs, outputs, **attributes)


def _operator(node: Node, table: Table) -> Any:
    """ONNX's reference of an operator, with numbers of the program's text as the decimals that were meant."""
    from onnx.reference.ops import load_op

    settings = {"log": lambda *_: None, "opsets": {"": table.opset}, "new_ops": None}
    operator = load_op("", node.op, table.opset)(_proto(node), settings)
    for name in operator.attributes_names_:
        if isinstance(value := getattr(operator, name), float):
            setattr(operator, name, decimal(value))
    return operator


Matrix = Callable[[Node, Table, Sequence[Any], int], Sparse]
"""Matrix of an operator, from the operand of that place, flat in C order; without the bias of Conv and Gemm."""


def _contract(
    table: Table, labels: Sequence[str], out: str, sides: Sequence[AnyArray], which: int
) -> Sparse:
    """Matrix of the einsum of two sides by their labels; the side `which` holds positions of an operand."""
    every = out + "".join(sorted({*labels[0], *labels[1]} - {*out}))
    if any(len(set(each)) != len(each) for each in (*labels, out)) or not set(out) <= {
        *labels[0],
        *labels[1],
    }:
        raise ValueError("a sum that is not known")
    sizes: dict[str, int] = {}
    for each, side in zip(labels, sides, strict=True):
        for label, size in zip(each, side.shape, strict=True):
            if sizes.setdefault(label, size) != size:
                raise ValueError("sizes that do not fit each other")
    table.room([sizes[label] for label in every], COEFFICIENT_LIMIT)

    def spread(array: AnyArray, labels: str) -> AnyArray:
        order = sorted(range(len(labels)), key=lambda axis: every.index(labels[axis]))
        return array.transpose(order).reshape([sizes[label] if label in labels else 1 for label in every])

    target = np.arange(math.prod([sizes[label] for label in out])).reshape([sizes[label] for label in out])
    parts = spread(target, out), *(spread(sides[place], labels[place]) for place in (which, 1 - which))
    rows, columns, values = (flat.ravel() for flat in np.broadcast_arrays(*parts))
    kept = values != 0
    entries = values[kept].astype(np.float64), (rows[kept], columns[kept])
    return sparse.coo_array(entries, shape=(target.size, int(sides[which].max(initial=-1)) + 1)).tocsr()


def _sides(operands: Sequence[Any], which: int) -> list[AnyArray]:
    """Operands, with positions in place of one."""
    place = operands[which]
    return [np.arange(place.size).reshape(place.shape) if each is place else each for each in operands]


def _matmul_matrix(_node: Node, table: Table, operands: Sequence[Any], which: int) -> Sparse:
    sides = _sides(operands, which)
    sides[0] = sides[0][None] if sides[0].ndim == 1 else sides[0]
    sides[1] = sides[1][:, None] if sides[1].ndim == 1 else sides[1]
    batch = table.room(np.broadcast_shapes(sides[0].shape[:-2], sides[1].shape[:-2]))
    sides = [np.broadcast_to(each, table.room((*batch, *each.shape[-2:]))) for each in sides]
    letters = string.ascii_lowercase[: len(batch)]
    return _contract(table, [f"{letters}yz", f"{letters}zx"], f"{letters}yx", sides, which)


def _gemm_matrix(node: Node, table: Table, operands: Sequence[Any], which: int) -> Sparse:
    labels = [
        "zy" if node.attributes.get("transA", 0) else "yz",
        "xz" if node.attributes.get("transB", 0) else "zx",
    ]
    sides = _sides(operands, which)
    sides[1 - which] = node.attributes.get("alpha", 1.0) * sides[1 - which]
    return _contract(table, labels, "yx", sides, which)


def _einsum_matrix(node: Node, table: Table, operands: Sequence[Any], which: int) -> Sparse:
    spelled = str(node.attributes["equation"]).replace(" ", "")
    if "->" not in spelled or "." in spelled or spelled.count(",") > 1:
        raise ValueError("an equation that is not known")
    inputs, out = spelled.split("->")
    labels = inputs.split(",")
    sides = _sides(operands, which)
    return _contract(table, [*labels, ""][:2], out, [*sides, np.array(1.0)][:2], which)


def _reduce_axes(node: Node, operands: Sequence[Any]) -> tuple[int, ...]:
    axes = node.attributes.get("axes")  # of old operators; an operand of new ones
    if axes is None and len(operands) > 1 and operands[1] is not None:
        axes = operands[1].ravel().tolist()
    every = range(operands[0].ndim)
    if axes is None or not axes:
        return () if node.attributes.get("noop_with_empty_axes", 0) else tuple(every)
    return tuple(every[axis] for axis in axes)


def _reduce_matrix(node: Node, table: Table, operands: Sequence[Any], _which: int) -> Sparse:
    shape = operands[0].shape
    axes = _reduce_axes(node, operands)
    letters = string.ascii_lowercase[: len(shape)]
    out = "".join(label for axis, label in enumerate(letters) if axis not in axes)
    share = 1.0 if node.op == "ReduceSum" else 1 / math.prod([shape[axis] for axis in axes])
    return _contract(table, [letters, ""], out, [_sides(operands[:1], 0)[0], np.array(share)], 0)


def _conv_matrix(node: Node, _table: Table, operands: Sequence[Any], _which: int) -> Sparse:
    """Matrix of a convolution of each recording of a batch."""
    data, weight = operands
    if node.attributes.get("auto_pad", "NOTSET") not in ("NOTSET", "VALID") or node.attributes.get(
        "ceil_mode", 0
    ):
        raise ValueError("auto_pad and ceil_mode are not known")
    axes = data.ndim - 2
    pads = node.attributes.get("pads", [0] * 2 * axes)
    matrix, _ = convolution(
        data.shape[1:],
        weight,
        stride=node.attributes.get("strides", [1] * axes),
        padding=list(zip(pads[:axes], pads[axes:], strict=True)),
        dilation=node.attributes.get("dilations", [1] * axes),
        groups=int(node.attributes.get("group", 1)),
    )
    return block_diagonal(matrix, len(data))


def _pool_matrix(node: Node, table: Table, operands: Sequence[Any], _which: int) -> Sparse:
    data = operands[0]
    kernel = [
        int(n) for n in node.attributes.get("kernel_shape", data.shape[2:])
    ]  # all, of GlobalAveragePool
    ones = np.ones(table.room([data.shape[1], 1, *kernel]))
    depthwise = replace(node, attributes={**node.attributes, "group": data.shape[1]})
    matrix = _conv_matrix(depthwise, table, [data, ones], 0)
    inside = np.diff(matrix.indptr)
    counted = (
        np.full(len(inside), math.prod(kernel)) if node.attributes.get("count_include_pad", 0) else inside
    )
    matrix.data = matrix.data / np.repeat(counted, inside)
    return matrix


LINEAR: Mapping[str, tuple[Matrix, tuple[int, ...]]] = {
    "AveragePool": (_pool_matrix, (0,)),
    "Conv": (_conv_matrix, (0,)),
    "Einsum": (_einsum_matrix, (0, 1)),
    "Gemm": (_gemm_matrix, (0, 1)),
    "GlobalAveragePool": (_pool_matrix, (0,)),
    "MatMul": (_matmul_matrix, (0, 1)),
    "ReduceMean": (_reduce_matrix, (0,)),
    "ReduceSum": (_reduce_matrix, (0,)),
}
"""By operator: its matrix, and which operands may vary."""
