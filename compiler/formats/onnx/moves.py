"""Operators that only move numbers: each element of the result is an element of an operand, or a constant.

They run on numbers and, unchanged, on positions: so the coefficients of a result are rows of an operand's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from spikeloom.compiler.formats.onnx.file import Array, Node
from spikeloom.compiler.formats.onnx.values import Table, size_of

Operands = Sequence[Any]
"""Arrays, None for an operand that is left away."""

Move = Callable[[Node, Table, Operands], list[Array]]


def axes_of(node: Node, operands: Operands, place: int) -> list[int] | None:
    """Axes from the attribute of old operators or the operand of new ones."""
    if "axes" in node.attributes:
        return [int(axis) for axis in node.attributes["axes"]]
    if len(operands) > place and operands[place] is not None:
        return [int(axis) for axis in np.asarray(operands[place]).ravel()]
    return None


def _identity(_node: Node, _table: Table, operands: Operands) -> list[Array]:
    return [operands[0]]


def _reshape(node: Node, table: Table, operands: Operands) -> list[Array]:
    data, wanted = operands[0], [int(size) for size in operands[1]]
    if not node.attributes.get("allowzero", 0):
        wanted = [data.shape[i] if size == 0 else size for i, size in enumerate(wanted)]
    table.room([size for size in wanted if size >= 0])
    return [data.reshape(wanted)]


def _flatten(node: Node, _table: Table, operands: Operands) -> list[Array]:
    data = operands[0]
    axis = int(node.attributes.get("axis", 1))
    axis = axis + data.ndim if axis < 0 else axis
    return [data.reshape(size_of(data.shape[:axis]), size_of(data.shape[axis:]))]


def _squeeze(node: Node, _table: Table, operands: Operands) -> list[Array]:
    axes = axes_of(node, operands, 1)
    return [np.squeeze(operands[0], None if axes is None else tuple(axes))]


def _unsqueeze(node: Node, _table: Table, operands: Operands) -> list[Array]:
    return [np.expand_dims(operands[0], tuple(axes_of(node, operands, 1) or ()))]


def _transpose(node: Node, _table: Table, operands: Operands) -> list[Array]:
    return [np.transpose(operands[0], node.attributes.get("perm"))]


def _gather(node: Node, table: Table, operands: Operands) -> list[Array]:
    data, indices = operands[0], np.asarray(operands[1])
    axis = range(data.ndim)[int(node.attributes.get("axis", 0))]
    table.room((*data.shape[:axis], *indices.shape, *data.shape[axis + 1 :]))
    return [np.take(data, indices, axis=axis)]


def _gather_elements(node: Node, _table: Table, operands: Operands) -> list[Array]:
    axis = range(operands[0].ndim)[int(node.attributes.get("axis", 0))]
    return [operands[0][_element_index(operands[1], operands[0].shape, axis)]]


def _element_index(indices: Array, shape: tuple[int, ...], axis: int) -> tuple[Array, ...]:
    """Where each element of `indices` points to, as an index of a tensor of that shape."""
    if indices.ndim != len(shape) or np.any(indices < -shape[axis]) or np.any(indices >= shape[axis]):
        raise IndexError("indices outside the tensor")
    grid: list[Array] = list(np.indices(indices.shape, sparse=True))
    grid[axis] = np.where(indices < 0, indices + shape[axis], indices)
    return tuple(np.broadcast_arrays(*grid))


def _gather_nd(node: Node, table: Table, operands: Operands) -> list[Array]:
    data, indices = operands[0], operands[1]
    if node.attributes.get("batch_dims", 0):
        raise ValueError("batch_dims is not known")
    table.room((*indices.shape[:-1], *data.shape[indices.shape[-1] :]))
    return [np.asarray(data[tuple(np.moveaxis(indices, -1, 0))])]


def _slice(node: Node, _table: Table, operands: Operands) -> list[Array]:
    data = operands[0]
    if "starts" in node.attributes:
        starts, ends = node.attributes["starts"], node.attributes["ends"]
        axes, steps = node.attributes.get("axes"), None
    else:
        starts, ends = operands[1], operands[2]
        axes = operands[3] if len(operands) > 3 else None
        steps = operands[4] if len(operands) > 4 else None
    axes = range(len(starts)) if axes is None else axes
    steps = [1] * len(starts) if steps is None else steps
    cut = [slice(None)] * data.ndim
    for bounds in zip(starts, ends, axes, steps, strict=True):
        start, end, axis, step = (int(bound) for bound in bounds)
        # Counting down to before the first element is written as a far negative end.
        below = step < 0 and end < -data.shape[axis]
        cut[axis] = slice(start, None if below else end, step)
    return [np.asarray(data[tuple(cut)])]


def _split(node: Node, _table: Table, operands: Operands) -> list[Array]:
    data = operands[0]
    axis = range(data.ndim)[int(node.attributes.get("axis", 0))]
    sizes = node.attributes.get("split")
    if len(operands) > 1 and operands[1] is not None:
        sizes = [int(size) for size in operands[1]]
    if sizes is None:
        share = -(-data.shape[axis] // len(node.outputs))
        sizes = [min(share, data.shape[axis] - share * i) for i in range(len(node.outputs))]
    if sum(sizes) != data.shape[axis] or min(sizes) < 0:
        raise ValueError("parts that do not make up the whole")
    ends = np.cumsum([0, *sizes])
    return [np.take(data, np.arange(first, last), axis=axis) for first, last in pairwise(ends)]


def _concat(node: Node, table: Table, operands: Operands) -> list[Array]:
    table.room([sum(operand.size for operand in operands)])
    return [np.concatenate(operands, axis=int(node.attributes["axis"]))]


def _expand(_node: Node, table: Table, operands: Operands) -> list[Array]:
    wanted = [int(size) for size in operands[1]]
    shape = table.room(np.broadcast_shapes(operands[0].shape, table.room(wanted)))
    return [np.broadcast_to(operands[0], shape)]


def _tile(_node: Node, table: Table, operands: Operands) -> list[Array]:
    repeats = [int(count) for count in operands[1]]
    table.room([size * count for size, count in zip(operands[0].shape, repeats, strict=True)])
    return [np.tile(operands[0], repeats)]


def _pad(node: Node, table: Table, operands: Operands) -> list[Array]:
    data = operands[0]
    pads = [int(pad) for pad in (node.attributes.get("pads") or operands[1])]
    if node.attributes.get("mode", "constant") != "constant" or (len(operands) > 3 and operands[3] is not None):
        raise ValueError("only constant padding of all axes is known")
    filling = operands[2] if len(operands) > 2 and operands[2] is not None else np.array(0, data.dtype)
    if len(pads) != 2 * data.ndim:
        raise ValueError("pads for another number of axes")
    sides = list(zip(pads[: data.ndim], pads[data.ndim :], strict=True))
    if any(pad < 0 for side in sides for pad in side):
        raise ValueError("negative pads are not known")
    table.room([size + sum(side) for size, side in zip(data.shape, sides, strict=True)])
    return [np.pad(data, sides, constant_values=np.asarray(filling).reshape(()))]


def _where(_node: Node, table: Table, operands: Operands) -> list[Array]:
    table.room(np.broadcast_shapes(*(operand.shape for operand in operands)))
    return [np.asarray(np.where(*operands))]


def scatter_place(node: Node, operands: Operands) -> tuple[Array, ...]:
    """Index of the data for each element of the updates, as ScatterElements or ScatterND means it."""
    shape, indices = operands[0].shape, operands[1]
    if node.op == "ScatterElements":
        if operands[2].shape != indices.shape:
            raise ValueError("updates of another shape than the indices")
        return _element_index(indices, shape, range(len(shape))[int(node.attributes.get("axis", 0))])
    depth, outer = indices.shape[-1], indices.ndim - 1
    if operands[2].shape != (*indices.shape[:-1], *shape[depth:]):
        raise ValueError("updates of another shape than the indices")
    if np.any(indices < -np.array(shape[:depth])) or np.any(indices >= np.array(shape[:depth])):
        raise IndexError("indices outside the tensor")
    inner = np.indices(operands[2].shape, sparse=True)[outer:]
    spread = [indices[..., axis].reshape(*indices.shape[:-1], *[1] * (len(shape) - depth)) for axis in range(depth)]
    whole = [np.where(index < 0, index + shape[axis], index) for axis, index in enumerate(spread)]
    return tuple(np.broadcast_arrays(*whole, *inner))


def _scatter(node: Node, _table: Table, operands: Operands) -> list[Array]:
    data = np.array(operands[0])
    place = scatter_place(node, operands)
    match node.attributes.get("reduction", "none"):
        case "none":
            data[place] = operands[2]
        case "add":
            np.add.at(data, place, operands[2])
        case other:
            raise ValueError(f"reduction {str(other)[:20]!r} is not known")
    return [data]


MOVES: Mapping[str, tuple[Move, tuple[int, ...] | None]] = {
    "Concat": (_concat, None),
    "Dropout": (_identity, (0,)),
    "Expand": (_expand, (0,)),
    "Flatten": (_flatten, (0,)),
    "Gather": (_gather, (0,)),
    "GatherElements": (_gather_elements, (0,)),
    "GatherND": (_gather_nd, (0,)),
    "Identity": (_identity, (0,)),
    "Pad": (_pad, (0, 2)),
    "Reshape": (_reshape, (0,)),
    "ScatterElements": (_scatter, (0, 2)),
    "ScatterND": (_scatter, (0, 2)),
    "Slice": (_slice, (0,)),
    "Split": (_split, (0,)),
    "Squeeze": (_squeeze, (0,)),
    "Tile": (_tile, (0,)),
    "Transpose": (_transpose, (0,)),
    "Unsqueeze": (_unsqueeze, (0,)),
    "Where": (_where, (1, 2)),
}
"""By operator: what it does, and which operands may vary (None: all of them)."""
