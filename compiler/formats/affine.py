"""What lies between two spiking layers: values that are affine in *atoms*, things that vary, such as spikes.

Convolutions and poolings are the sparse matrices that they are, for any number of space axes. A convolution
here is a cross-correlation, as in torch: kernels are not turned round. Images are (channels, space), flat in
that order.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray, IntArray

COEFFICIENT_LIMIT = 2**25
"""Products of a kernel's weights with places: more than twice the synapses of a whole chip."""

Padding = Sequence[tuple[int, int]]
"""Zeros before and after each space axis."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Affine:
    """``sum_a terms[a] @ atom_a + bias``, flat in C order; `shape` is the tensor's."""

    shape: tuple[int, ...]
    terms: Mapping[int, Sparse]  # (size, size of the atom)
    bias: FloatArray  # (size,)


A = TypeVar("A", bound=Affine)


def picked(value: A, rows: IntArray, shape: tuple[int, ...]) -> A:
    """Elements of a value in another order, some of them perhaps not or several times.

    Where that is all of them as they are, the matrices are the very same objects.
    """
    same = np.array_equal(rows, np.arange(len(value.bias)))
    terms = {atom: own if same else own[rows] for atom, own in value.terms.items()}
    return replace(
        value, shape=shape, terms={a: own for a, own in terms.items() if own.nnz}, bias=value.bias[rows]
    )


def picked_of_all(parts: Sequence[Affine], rows: IntArray) -> Affine:
    """Elements of several values one after the other, after a constant zero; `rows` has the shape of the result."""
    flat = rows.ravel()
    if len(parts) == 1 and flat.size and flat.min() >= 1:
        return picked(parts[0], flat - 1, rows.shape)
    terms = {}
    for atom in dict.fromkeys(atom for part in parts for atom in part.terms):
        width = next(part.terms[atom].shape[1] for part in parts if atom in part.terms)
        blocks = [part.terms.get(atom, sparse.csr_array((len(part.bias), width))) for part in parts]
        terms[atom] = sparse.vstack([sparse.csr_array((1, width)), *blocks], format="csr")
    bias = np.concatenate([np.zeros(1), *(part.bias for part in parts)])
    return picked(Affine(shape=bias.shape, terms=terms, bias=bias), flat, rows.shape)


def spread(value: A, shape: tuple[int, ...]) -> A:
    """A value broadcast to a shape."""
    if value.shape == shape:
        return value
    rows = np.broadcast_to(np.arange(math.prod(value.shape)).reshape(value.shape), shape).ravel()
    return picked(value, rows, shape)


def added(values: Sequence[tuple[float, A]], shape: tuple[int, ...]) -> A:
    """Weighted sum of values of one size."""
    terms: dict[int, Sparse] = {}
    bias = np.zeros(math.prod(shape))
    for factor, value in values:
        bias = bias + factor * value.bias
        for atom, own in value.terms.items():
            term = own if factor == 1 else own * factor
            terms[atom] = terms[atom] + term if atom in terms else term
    return replace(values[0][1], shape=shape, terms=terms, bias=bias)


def scaled(value: A, factor: FloatArray, change: np.ufunc = np.multiply) -> A:
    """Each element times a constant of its own, or divided by it."""
    terms = {atom: rows.copy() for atom, rows in value.terms.items()}
    for rows in terms.values():
        rows.data = change(rows.data, np.repeat(factor, np.diff(rows.indptr)))
    return replace(value, terms=terms, bias=change(value.bias, factor))


def shifted(value: A, shift: FloatArray) -> A:
    """Each element plus a constant of its own."""
    return replace(value, bias=value.bias + shift)


def through(matrix: Sparse, value: A, shape: tuple[int, ...]) -> A:
    """A value after a linear operator; coefficients that an identity meets are the operator's own."""
    terms = {}
    for atom, own in value.terms.items():
        terms[atom] = matrix if diagonal(own) == 1 else (matrix @ own).tocsr()
        terms[atom].sort_indices()
    return replace(value, shape=shape, terms=terms, bias=matrix @ value.bias)


def diagonal(terms: Sparse, tolerance: float = 0.0) -> float | None:
    """The one number on the diagonal where there is nothing else, else None."""
    each = np.arange(terms.shape[0])
    square = terms.shape[0] == terms.shape[1] == terms.nnz > 0
    if not square or not np.array_equal(terms.indices, each) or not np.array_equal(terms.indptr[:-1], each):
        return None
    return float(terms.data[0]) if np.ptp(terms.data) <= tolerance * abs(terms.data[0]) else None


def convolution(
    shape: Sequence[int],
    weight: npt.NDArray[np.floating],
    *,
    stride: Sequence[int],
    padding: Padding,
    dilation: Sequence[int],
    groups: int = 1,
) -> tuple[Sparse, tuple[int, ...]]:
    """Matrix of a convolution, csr_array (size of the result, size of the input), and the shape of what it gives.

    shape: (channels, *space) of the input.
    weight: (filters, channels / groups, *kernel) float64; weights of zero are not in the matrix.
    stride, dilation: one for each space axis.
    padding: zeros before and after, for each space axis.
    groups: parts of the channels that do not mix.

    Raises ModelError if sizes do not fit each other, or the matrix would be too large.

    >>> matrix, shape = convolution((1, 3), np.array([[[1.0, 2.0]]]), stride=[1], padding=[(0, 0)], dilation=[1])
    >>> shape, matrix.toarray().tolist()
    ((1, 2), [[1.0, 2.0, 0.0], [0.0, 1.0, 2.0]])
    """
    channels, *space = shape
    filters, each, *kernel = weight.shape
    if groups < 1 or channels != each * groups or filters % groups:
        raise ModelError(
            f"has kernels for {each} channels in {groups} groups and {filters} filters, its input has {channels} "
            f"channels; export it again"
        )
    if min((*kernel, *stride, *dilation), default=1) < 1 or any(min(pair) < 0 for pair in padding):
        raise ModelError(
            "has a kernel size, stride or dilation below 1 or a padding below 0; export it again"
        )
    spans = [apart * (taps - 1) + 1 for taps, apart in zip(kernel, dilation, strict=True)]
    padded_space = [size + sum(zeros) for size, zeros in zip(space, padding, strict=True)]
    for size, taps, span, covered in zip(space, kernel, spans, padded_space, strict=True):
        if span > covered:
            raise ModelError(f"has a kernel of {taps} for {size} places; export it again")
    out = [(room - span) // step + 1 for room, span, step in zip(padded_space, spans, stride, strict=True)]
    points = math.prod(out)
    taps = math.prod(kernel)
    _require_few(max(weight.size * points, points, channels * math.prod(padded_space)))
    # where in the input each tap looks from each place; -1 is the padding
    positions = np.pad(np.arange(math.prod(shape)).reshape(shape), [(0, 0), *padding], constant_values=-1)
    windows = np.lib.stride_tricks.sliding_window_view(positions, (1, *spans))
    looks = windows[:, *(slice(None, None, step) for step in (*stride, 1, *dilation))]
    inner = filters // groups
    rows = np.arange(filters * points).reshape(groups, inner, 1, points, 1)
    columns = looks.reshape(groups, 1, each, points, taps)
    values = weight.reshape(groups, inner, each, 1, taps)
    kept = (columns >= 0) & (values != 0)
    rows, columns, values = (np.broadcast_to(part, kept.shape)[kept] for part in (rows, columns, values))
    matrix = sparse.coo_array(
        (values.astype(np.float64), (rows, columns)), shape=(filters * points, math.prod(shape))
    ).tocsr()
    return matrix, (filters, *out)


def block_diagonal(matrix: Sparse, copies: int) -> Sparse:
    """Block-diagonal matrix of so many copies of one; ModelError if it would be too large."""
    _require_few(copies * max(matrix.nnz, *matrix.shape))
    return (
        matrix
        if copies == 1
        else sparse.csr_array(sparse.kron(sparse.identity(copies), matrix, format="csr"))
    )


def _require_few(weights: int) -> None:
    if weights > COEFFICIENT_LIMIT:
        words = f"has {weights:,} weights once written out, {COEFFICIENT_LIMIT:,} are allowed"
        raise ModelError(f"{words}; this is no network of one chip")
