"""What a value of an ONNX graph is, in terms of what varies: an array of constants, or affine in *atoms*.

Atoms are the inputs of the graph, each tensor that is compared with a threshold (a membrane), the spikes
that follow from it, and products of a membrane with its spikes (a reset).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.affine import Affine, added, scaled
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import AnyArray, FloatArray, IntArray

VALUE_LIMIT = 2**22
COEFFICIENT_LIMIT = 2**24
"""Elements of a value, and coefficients of an operator: more than the synapses of a chip."""

DIMENSIONS = 32

ATOM_LIMIT = 2**20
"""Elements of an input, over all steps, or of a layer."""

INPUT_ATOM = "input"
MEMBRANE = "membrane"
SPIKE = "spike"
PRODUCT = "product"

NOT_AFFINE = (
    "is not affine in its input; only affine operators between two spiking layers can become synapses"
)

Value = AnyArray | Affine


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atom:
    """Something that varies."""

    kind: str  # one of the four
    label: str  # name of the value in the file, for messages
    eye: Sparse  # (size, size), its own coefficients
    binary: bool = False  # zeros and ones
    of: tuple[int, ...] = ()  # the two factors of a product; the membrane of a spike
    theta: FloatArray = field(default_factory=lambda: np.zeros(0))  # (size,), threshold of a spike
    strict: bool = True  # of a spike: fires above the threshold, not at it
    definition: Affine | None = None  # what a membrane is made of
    node: str = ""  # operator that makes a membrane

    @property
    def size(self) -> int:
        """Elements."""
        return int(self.eye.shape[0])

    def __str__(self) -> str:
        return printable(self.label)


@dataclass(slots=True, kw_only=True, eq=False)
class Table:
    """What is met while a graph runs.

    Matrices of linear operators are kept with the constants that they were made from, so that nothing else
    can come to lie at the same address.
    """

    opset: int = 20
    atoms: list[Atom] = field(default_factory=list)
    known: dict[tuple[object, ...], int] = field(default_factory=dict)
    matrices: dict[tuple[object, ...], tuple[Sparse, tuple[int, ...], list[Value]]] = field(
        default_factory=dict
    )

    def room(self, shape: Sequence[int], limit: int = VALUE_LIMIT) -> tuple[int, ...]:
        """The shape itself, if a value of it, or an operator of so many coefficients, may be made."""
        size = math.prod(int(length) for length in shape)
        if size > limit or min(shape, default=0) < 0 or len(shape) > DIMENSIONS:
            raise ModelError(
                f"makes {size} values or coefficients, allowed are {limit}; no chip holds such a network"
            )
        return tuple(int(length) for length in shape)

    def atom(self, kind: str, label: str, size: int, **facts: Any) -> int:
        """Add an atom, if there may be one of that size; `facts` are more fields of it."""
        if size > ATOM_LIMIT:
            raise ModelError(
                f"{printable(label)} has {size} elements, allowed are {ATOM_LIMIT}; no chip holds that"
            )
        self.atoms.append(Atom(kind=kind, label=label, eye=sparse.eye_array(size, format="csr"), **facts))
        return len(self.atoms) - 1

    def value(self, atom: int, shape: tuple[int, ...]) -> Affine:
        """The atom itself as a value."""
        atom_type = self.atoms[atom]
        return Affine(shape=shape, terms={atom: atom_type.eye}, bias=np.zeros(atom_type.size))

    def spike(self, membrane: int, theta: FloatArray, *, strict: bool) -> int:
        """The atom of the spikes of a membrane by a threshold."""
        key = (SPIKE, membrane, theta.tobytes(), strict)
        if key not in self.known:
            label = self.atoms[membrane].label
            self.known[key] = self.atom(
                SPIKE, label, len(theta), binary=True, of=(membrane,), theta=theta, strict=strict
            )
        return self.known[key]

    def product(self, first: int, second: int) -> int:
        """The atom of an elementwise product of two atoms."""
        key = (PRODUCT, min(first, second), max(first, second))
        if key not in self.known:
            one, other = (self.atoms[index] for index in key[1:])
            self.known[key] = self.atom(PRODUCT, f"{one.label} * {other.label}", one.size, of=key[1:])
        return self.known[key]


def as_affine(value: Value | None) -> Affine:
    """A value that varies, or constants as one; ModelError where there is none."""
    if value is None:
        raise ModelError("lacks an operand; export it again")
    if isinstance(value, Affine):
        return value
    array = np.asarray(value, np.float64)
    return Affine(shape=array.shape, terms={}, bias=array.ravel())


def require_finite(value: Affine, where: str = "") -> None:
    """Refuse coefficients that are not finite numbers: ModelError."""
    if not all(
        np.all(np.isfinite(part)) for part in (value.bias, *(own.data for own in value.terms.values()))
    ):
        raise ModelError(f"{where}has coefficients that are not finite; train it again")


def multiplied(table: Table, a: Affine, b: Affine) -> Affine:
    """A product of two values that vary: of a membrane with its spikes, or of two inputs that may be these."""
    size = len(a.bias)
    parts = [Affine(shape=a.shape, terms={}, bias=a.bias * b.bias)]
    for value, factor in ((a, b.bias), (b, a.bias)):
        if np.any(factor):
            parts.append(Affine(shape=a.shape, terms=scaled(value, factor).terms, bias=np.zeros(size)))
    for first, own in a.terms.items():
        for second, other in b.terms.items():
            (one, column), (two, other_column) = _one_each(own), _one_each(other)
            rows = np.flatnonzero(one * two)
            if not len(rows):
                continue
            if np.any(column[rows] != other_column[rows]):
                raise ModelError(NOT_AFFINE)
            atom = _pair(table, first, second)
            entries = (one * two)[rows], (rows, column[rows])
            terms = sparse.csr_array(entries, shape=(size, table.atoms[atom].size))
            parts.append(Affine(shape=a.shape, terms={atom: terms}, bias=np.zeros(size)))
    return added([(1.0, part) for part in parts], a.shape)


def _pair(table: Table, first: int, second: int) -> int:
    """Atom of a product of two atoms, where it may be a reset."""
    one = table.atoms[first]
    other = table.atoms[second]
    if first == second and one.binary:
        return first
    inputs = one.kind == other.kind == INPUT_ATOM and first != second
    if (
        inputs
        or (one.kind == SPIKE and one.of == (second,))
        or (other.kind == SPIKE and other.of == (first,))
    ):
        return table.product(first, second)
    raise ModelError(f"multiplies {one} by {other}, so it {NOT_AFFINE}")


def _one_each(terms: Sparse) -> tuple[FloatArray, IntArray]:
    """Coefficient and column of each row, 0 and -1 of an empty one; ModelError if a row has several."""
    counts = np.diff(terms.indptr)
    if np.any(counts > 1):
        raise ModelError(NOT_AFFINE)
    coefficient = np.zeros(terms.shape[0])
    column = np.full(terms.shape[0], -1, np.int64)
    coefficient[counts == 1], column[counts == 1] = terms.data, terms.indices
    return coefficient, column


def is_binary(table: Table, value: Affine) -> bool:
    """Whether a value is zeros and ones: a spike, or an input of truth values, for each element, or the opposite."""
    counts = sum(
        (np.diff(own.indptr) for own in value.terms.values()), start=np.zeros(len(value.bias), np.int64)
    )
    ends = value.bias + sum(own.sum(axis=1) for own in value.terms.values())
    return (
        is_whole(table, value)
        and bool(np.all(counts <= 1))
        and bool(np.isin([value.bias, ends], (0, 1)).all())
    )


def is_whole(table: Table, value: Affine) -> bool:
    """Whether a value is a whole number: a count of spikes."""
    parts = [value.bias, *(own.data for own in value.terms.values())]
    return all(table.atoms[atom].binary for atom in value.terms) and all(
        np.all(part % 1 == 0) for part in parts
    )
