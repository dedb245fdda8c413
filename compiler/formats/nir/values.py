"""What flows along the edges of a NIR graph: affine stages from spikes, maybe through one synaptic filter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Value:
    """``f + bias`` with ``f <- alpha * f + (sum of terms) + held`` in every step."""

    shape: tuple[int, ...]  # Of one step; its elements lie flat in C order
    terms: Mapping[int, Sparse]  # (size, neurons of the source); weights of the spikes of each source
    bias: FloatArray  # (size,); what is added past the filter
    alpha: float  # Share of the current that a step keeps; 0 without a filter
    held: FloatArray  # (size,); what flows into the filter in every step; zero without one

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


def spikes_of(source: int, shape: tuple[int, ...]) -> Value:
    """The spikes of a source, or the events of the input."""
    size = math.prod(shape)
    nothing = np.zeros(size)
    own = sparse.csr_array(sparse.identity(size, format="csr"))
    return Value(shape=shape, terms={source: own}, bias=nothing, alpha=0.0, held=nothing)


def scaled(value: Value, gain: FloatArray) -> Value:
    """Each element times its own factor; `gain` is (size,)."""
    rows = sparse.diags_array(gain, format="csr")
    terms = {source: sparse.csr_array(rows @ own) for source, own in value.terms.items()}
    return replace(value, terms=terms, bias=value.bias * gain, held=value.held * gain)


def through(value: Value, matrix: Sparse, shape: tuple[int, ...]) -> Value:
    """A linear stage, ``matrix`` (size of `shape`, size of the value)."""
    terms = {source: sparse.csr_array(matrix @ own) for source, own in value.terms.items()}
    return Value(shape=shape, terms=terms, bias=matrix @ value.bias, alpha=value.alpha, held=matrix @ value.held)


def shifted(value: Value, bias: FloatArray) -> Value:
    """A constant added; `bias` is (size,)."""
    return replace(value, bias=value.bias + bias)


def added(values: Sequence[Value]) -> Value:
    """The sum of several, as a node with several edges gets; ModelError if their shapes or their filters differ."""
    first = values[0]
    if len(values) == 1:
        return first
    if any(value.shape != first.shape for value in values):
        shown = " and ".join(str(list(value.shape)) for value in values)
        raise ModelError(f"gets values of different shapes, {shown}; export it again")
    filtered = [value for value in values if value.terms or np.any(value.held)]
    if len({value.alpha for value in filtered}) > 1:
        raise ModelError("gets currents with different time constants; a neuron of the chip has one")
    terms: dict[int, Sparse] = {}
    for value in values:
        for source, own in value.terms.items():
            terms[source] = sparse.csr_array(terms[source] + own) if source in terms else own
    return Value(
        shape=first.shape,
        terms=terms,
        bias=np.sum([value.bias for value in values], axis=0),
        alpha=filtered[0].alpha if filtered else 0.0,
        held=np.sum([value.held for value in values], axis=0),
    )


def filtered(value: Value, alpha: float, gain: FloatArray, drive: FloatArray) -> Value:
    """The state of a leaky integrator: ``f <- alpha * f + gain * value + drive``; `gain` and `drive` are (size,).

    ModelError if the value went through one before.
    """
    if value.alpha:
        raise ModelError("filters a current that is filtered before; a neuron of the chip has one current")
    own = scaled(value, gain)
    return replace(own, alpha=alpha, held=own.bias + drive, bias=np.zeros(value.size))
