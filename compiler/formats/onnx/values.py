"""What a value of an ONNX graph is, in terms of what varies: constant, affine, or one of three by a threshold.

What varies are *atoms*: the inputs of the graph, each tensor that is compared with a threshold (a membrane), the
spikes that follow from it, and products of a membrane with its spikes (a reset). An affine value holds its coefficients
on atoms as sparse matrices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.onnx.file import Array, Node
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray, IntArray

VALUE_LIMIT, COEFFICIENT_LIMIT = 2**22, 2**24
"""Elements of a value, and coefficients of an operator: more than the synapses of a chip."""

ATOM_LIMIT = 2**20
"""Elements of an input, over all steps, or of a layer."""

WORK_LIMIT = 2**30
"""Elements and coefficients of all values together; bounds the time that a file can take."""

NODE_WORK = 2**14
"""What running one operator counts for beside its elements."""

INPUT_ATOM, MEMBRANE, SPIKE, PRODUCT = "input", "membrane", "spike", "product"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atom:
    """Something that varies."""

    kind: str  # one of the four
    label: str  # name of the value in the file, for messages
    eye: Sparse  # (size, size), its own coefficients
    binary: bool = False  # zeros and ones
    of: tuple[int, ...] = ()  # the two factors of a product; the point of a spike
    strict: bool = True  # of a spike: fires above the threshold, not at it

    @property
    def size(self) -> int:
        """Elements."""
        return int(self.eye.shape[0])

    def __str__(self) -> str:
        return printable(self.label)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Affine:
    """``sum_a terms[a] @ atom_a + bias``, flat; `shape` is the tensor's."""

    shape: tuple[int, ...]
    terms: dict[int, Sparse]  # (size, size of the atom)
    bias: FloatArray  # (size,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decision:
    """A value that each element takes by a comparison: below, at and above the threshold."""

    point: int
    values: tuple[Array, Array, Array]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the tensor."""
        return tuple(self.values[0].shape)


Value = Array | Affine | Decision


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Point:
    """A comparison of a membrane, an atom, with a threshold (size,), made by a node."""

    node: str
    membrane: int
    theta: FloatArray


@dataclass(slots=True, kw_only=True, eq=False)
class Table:
    """What is met while a graph runs: atoms, comparisons, what membranes are made of, and the work done so far.

    Matrices of linear operators are kept with the constants that they were made from, and operators with their nodes,
    so that nothing else can come to lie at the same address.
    """

    opset: int = 20
    atoms: list[Atom] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)
    definitions: dict[int, Affine] = field(default_factory=dict)
    nodes: dict[int, str] = field(default_factory=dict)
    known: dict[tuple[object, ...], int] = field(default_factory=dict)
    matrices: dict[tuple[object, ...], tuple[Sparse, tuple[int, ...], list[Value]]] = field(default_factory=dict)
    operators: dict[int, tuple[Node, Any]] = field(default_factory=dict)
    done: int = 0

    def room(self, shape: Sequence[int], limit: int = VALUE_LIMIT) -> tuple[int, ...]:
        """The shape itself, if a value of it, or an operator of so many coefficients, may be made."""
        size = math.prod(int(length) for length in shape)
        if size > limit or any(length < 0 for length in shape):
            raise ModelError(f"makes {size} values or coefficients, allowed are {limit}; no chip holds such a network")
        self.spend(size)
        return tuple(int(length) for length in shape)

    def spend(self, work: int) -> None:
        """Count work; refuse more than a network of any use needs."""
        self.done += work
        if self.done > WORK_LIMIT:
            raise ModelError(f"needs more than {WORK_LIMIT} coefficients in all; export one step instead of all")

    def atom(self, kind: str, label: str, size: int, **facts: Any) -> int:
        """Add an atom, if there may be one of that size; `facts` are more fields of it."""
        if size > ATOM_LIMIT:
            raise ModelError(
                f"{printable(label)} has {size} elements, allowed are {ATOM_LIMIT}; no chip holds such a layer"
            )
        self.atoms.append(Atom(kind=kind, label=label, eye=sparse.eye_array(size, format="csr"), **facts))
        return len(self.atoms) - 1

    def value(self, atom: int, shape: tuple[int, ...]) -> Affine:
        """The atom itself as a value."""
        found = self.atoms[atom]
        return Affine(shape=shape, terms={atom: found.eye}, bias=np.zeros(found.size))

    def spike(self, point: int, *, strict: bool) -> int:
        """The atom of a comparison's spikes."""
        key = (SPIKE, point, strict)
        if key not in self.known:
            membrane = self.atoms[self.points[point].membrane]
            self.known[key] = self.atom(SPIKE, membrane.label, membrane.size, binary=True, of=(point,), strict=strict)
        return self.known[key]

    def product(self, first: int, second: int) -> int:
        """The atom of an elementwise product of two atoms."""
        pair = (min(first, second), max(first, second))
        if (PRODUCT, *pair) not in self.known:
            one, other = (self.atoms[index] for index in pair)
            self.known[PRODUCT, *pair] = self.atom(PRODUCT, f"{one.label} * {other.label}", one.size, of=pair)
        return self.known[PRODUCT, *pair]


def size_of(shape: Sequence[int]) -> int:
    """Elements of a tensor of that shape."""
    return math.prod(shape)


def rows_of(terms: Sparse, rows: IntArray) -> Sparse:
    """Rows of a csr_array; the very same object where they are all of its rows in order."""
    if len(rows) == terms.shape[0] and np.array_equal(rows, np.arange(len(rows))):
        return terms
    return terms[rows]


def picked(value: Affine, rows: IntArray, shape: tuple[int, ...]) -> Affine:
    """Elements of a value in another order, some of them perhaps not or several times."""
    return Affine(
        shape=shape,
        terms={atom: own for atom, terms in value.terms.items() if (own := rows_of(terms, rows)).nnz},
        bias=value.bias[rows],
    )


def added(values: Sequence[tuple[float, Affine]], shape: tuple[int, ...]) -> Affine:
    """Weighted sum of values of one size."""
    terms: dict[int, Sparse] = {}
    bias = np.zeros(size_of(shape))
    for factor, value in values:
        bias = bias + factor * value.bias
        for atom, own in value.terms.items():
            scaled = own if factor == 1 else own * factor
            terms[atom] = terms[atom] + scaled if atom in terms else scaled
    return Affine(shape=shape, terms=terms, bias=bias)


def scaled(value: Affine, factor: FloatArray, change: np.ufunc = np.multiply) -> Affine:
    """Each element times a constant of its own, or divided by it."""
    terms = {atom: own.copy() for atom, own in value.terms.items()}
    for own in terms.values():
        own.data = change(own.data, np.repeat(factor, np.diff(own.indptr)))
    return Affine(shape=value.shape, terms=terms, bias=change(value.bias, factor))


def one_each(terms: Sparse) -> tuple[FloatArray, IntArray] | None:
    """Coefficient and column of each row where every row has at most one entry; the column of an empty row is -1."""
    counts = np.diff(terms.indptr)
    if np.any(counts > 1):
        return None
    coefficient, column = np.zeros(terms.shape[0]), np.full(terms.shape[0], -1, np.int64)
    coefficient[counts == 1], column[counts == 1] = terms.data, terms.indices
    return coefficient, column


def diagonal(terms: Sparse) -> float | None:
    """The one number on the diagonal where there is nothing else, else None."""
    single = one_each(terms)
    if single is None or terms.shape[0] != terms.shape[1] or not terms.shape[0]:
        return None
    coefficient, column = single
    if not np.array_equal(column, np.arange(len(column))) or np.ptp(coefficient) != 0:
        return None
    return float(coefficient[0])
