"""Operators that are linear in one operand while the others are constant, as the matrix from operand to result.

Tensors are flat, in C order. Biases (of Conv, Gemm) are added by who asks for the matrix.
"""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.formats.kernels import block_diagonal, convolution
from spikeloom.compiler.formats.onnx.affine import COEFFICIENT_LIMIT, Table
from spikeloom.compiler.formats.onnx.file import Array, Node
from spikeloom.compiler.ir import Sparse

Operands = Sequence[Any]

Matrix = Callable[[Node, Table, Operands, int], Sparse]


def _matrix(out: Array, place: Array, weight: Array, shape: tuple[int, int]) -> Sparse:
    """csr_array of the weights that are not zero, between broadcast positions; a position of -1 is no element."""
    rows, columns, values = (flat.ravel() for flat in np.broadcast_arrays(out, place, weight))
    kept = (values != 0) & (columns >= 0)
    matrix = sparse.coo_array((values[kept].astype(np.float64), (rows[kept], columns[kept])), shape=shape).tocsr()
    matrix.sum_duplicates()
    matrix.sort_indices()
    return matrix


def _contract(table: Table, spelled: str, place: Array, weight: Array, columns: int) -> Sparse:
    """Matrix of ``einsum("place,weight->out")``; `place` holds positions of the operand, -1 for none."""
    (left, right), out = spelled.split("->", maxsplit=1)[0].split(","), spelled.split("->")[1]
    if any(len(set(labels)) != len(labels) for labels in (left, right, out)) or not set(out) <= set(left + right):
        raise ValueError("a sum that is not known")
    every = out + "".join(sorted(set(left + right) - set(out)))
    sizes: dict[str, int] = {}
    for labels, shape in ((left, place.shape), (right, weight.shape)):
        for label, size in zip(labels, shape, strict=True):
            if sizes.setdefault(label, size) != size:
                raise ValueError("sizes that do not fit each other")
    table.room([sizes[label] for label in every], COEFFICIENT_LIMIT)

    def spread(array: Array, labels: str) -> Array:
        order = sorted(range(len(labels)), key=lambda axis: every.index(labels[axis]))
        return array.transpose(order).reshape([sizes[label] if label in labels else 1 for label in every])

    target = np.arange(math.prod([sizes[label] for label in out])).reshape([sizes[label] for label in out])
    return _matrix(spread(target, out), spread(place, left), spread(weight, right), (target.size, columns))


def _positions(array: Array) -> Array:
    return np.arange(array.size).reshape(array.shape)


def _matmul_matrix(_node: Node, table: Table, operands: Operands, which: int) -> Sparse:
    sides = [_positions(each) if place == which else each for place, each in enumerate(operands)]
    sides[0] = sides[0][None] if sides[0].ndim == 1 else sides[0]
    sides[1] = sides[1][:, None] if sides[1].ndim == 1 else sides[1]
    batch = table.room(np.broadcast_shapes(sides[0].shape[:-2], sides[1].shape[:-2]))
    sides = [np.broadcast_to(each, table.room((*batch, *each.shape[-2:]))) for each in sides]
    letters = string.ascii_lowercase[: len(batch)]
    labels = [f"{letters}yz", f"{letters}zx"]
    spelled = f"{labels[which]},{labels[1 - which]}->{letters}yx"
    return _contract(table, spelled, sides[which], sides[1 - which], operands[which].size)


def _gemm_matrix(node: Node, table: Table, operands: Operands, which: int) -> Sparse:
    labels = ["zy" if node.attributes.get("transA", 0) else "yz", "xz" if node.attributes.get("transB", 0) else "zx"]
    weight = node.attributes.get("alpha", 1.0) * operands[1 - which]
    spelled = f"{labels[which]},{labels[1 - which]}->yx"
    return _contract(table, spelled, _positions(operands[which]), weight, operands[which].size)


def _einsum_matrix(node: Node, table: Table, operands: Operands, which: int) -> Sparse:
    spelled = str(node.attributes["equation"]).replace(" ", "").lower()
    if "->" not in spelled or "." in spelled or len(operands) > 2:
        raise ValueError("an equation that is not known")
    inputs, out = spelled.split("->")
    labels = [*inputs.split(","), ""]
    weight = operands[1 - which] if len(operands) == 2 else np.array(1.0)
    spelled = f"{labels[which]},{labels[1 - which]}->{out}"
    return _contract(table, spelled, _positions(operands[which]), weight, operands[which].size)


def _reduce_axes(node: Node, operands: Operands) -> tuple[int, ...]:
    axes = node.attributes.get("axes")  # of old operators; an operand of new ones
    if axes is None and len(operands) > 1 and operands[1] is not None:
        axes = operands[1].ravel().tolist()
    every = range(operands[0].ndim)
    if axes is None or not axes:
        return () if axes is not None and node.attributes.get("noop_with_empty_axes", 0) else tuple(every)
    return tuple(every[axis] for axis in axes)


def _reduce_matrix(node: Node, table: Table, operands: Operands, _which: int) -> Sparse:
    shape, axes = operands[0].shape, _reduce_axes(node, operands)
    letters = string.ascii_lowercase[: len(shape)]
    out = "".join(label for axis, label in enumerate(letters) if axis not in axes)
    share = 1.0 if node.op == "ReduceSum" else 1 / math.prod([shape[axis] for axis in axes])
    return _contract(table, f"{letters},->{out}", _positions(operands[0]), np.array(share), operands[0].size)


def _conv_matrix(node: Node, table: Table, operands: Operands, _which: int) -> Sparse:
    """Matrix of a convolution of each recording of a batch; its size is checked before."""
    data, weight = operands
    if node.attributes.get("auto_pad", "NOTSET") not in ("NOTSET", "VALID") or node.attributes.get("ceil_mode", 0):
        raise ValueError("auto_pad and ceil_mode are not known")
    axes = data.ndim - 2
    pads = node.attributes.get("pads", [0] * 2 * axes)
    matrix, out = convolution(
        data.shape[1:],
        weight,
        stride=node.attributes.get("strides", [1] * axes),
        padding=list(zip(pads[:axes], pads[axes:], strict=True)),
        dilation=node.attributes.get("dilations", [1] * axes),
        groups=int(node.attributes.get("group", 1)),
    )
    table.room([len(data), math.prod(out) * math.prod(weight.shape[1:])], COEFFICIENT_LIMIT)
    return block_diagonal(matrix, len(data))


def _pool_matrix(node: Node, table: Table, operands: Operands, _which: int) -> Sparse:
    data = operands[0]
    everywhere = node.op == "GlobalAveragePool"
    kernel = data.shape[2:] if everywhere else [int(n) for n in node.attributes["kernel_shape"]]
    ones = np.ones(table.room([data.shape[1], 1, *kernel]))
    depthwise = replace(node, attributes={**node.attributes, "group": data.shape[1]})
    matrix = _conv_matrix(depthwise, table, [data, ones], 0)
    inside = np.diff(matrix.indptr)
    held = np.full(len(inside), math.prod(kernel)) if node.attributes.get("count_include_pad", 0) else inside
    matrix.data = matrix.data / np.repeat(held, inside)
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
