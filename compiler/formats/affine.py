"""Values that are affine in *atoms*, things that vary, such as spikes: what lies between two spiking layers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy import sparse

from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray, IntArray


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
        value, shape=shape, terms={atom: own for atom, own in terms.items() if own.nnz}, bias=value.bias[rows]
    )


def picked_of_all(parts: Sequence[Affine], rows: IntArray) -> Affine:
    """The same of several values one after the other, with a constant zero in front; `rows` has the result's shape."""
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
    terms = {atom: own.copy() for atom, own in value.terms.items()}
    for own in terms.values():
        own.data = change(own.data, np.repeat(factor, np.diff(own.indptr)))
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
