"""What flows along the edges of a NIR graph, and what each node that is no spiking neuron makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.kernels import Padding, block_diagonal, convolution
from spikeloom.compiler.formats.nir.file import Node
from spikeloom.compiler.formats.nir.steps import Steps, shared, spread
from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.types import FloatArray, IntArray


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


def rows_of(value: Value, rows: IntArray) -> Value:
    """Some elements of a value, flat."""
    terms = {source: own[rows] for source, own in value.terms.items()}
    return replace(value, shape=(len(rows),), terms=terms, bias=value.bias[rows], held=value.held[rows])


def through(value: Value, matrix: Sparse, shape: tuple[int, ...]) -> Value:
    """A linear stage, ``matrix`` (size of `shape`, size of the value)."""
    terms = {source: sparse.csr_array(matrix @ own) for source, own in value.terms.items()}
    return Value(shape=shape, terms=terms, bias=matrix @ value.bias, alpha=value.alpha, held=matrix @ value.held)


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


DENSE_LIMIT = 2**28
"""Weights of a matrix that is written out once for each place of an axis."""

KNOWN = {
    "CubaLI": "its state is filtered twice, a neuron of the chip filters once; use LI",
    "Delay": "delays spikes, which networks here do not; train without",
    "I": "integrates without leak and never spikes; use IF",
}
"""Why nodes that NIR knows have no place here."""


def _linear(node: Node, value: Value, _steps: Steps) -> Value:
    weight = node.numbers("weight")
    if weight.ndim != 2:
        raise node.fail(f"weight has the shape {list(weight.shape)}, allowed are (to, from); export it again")
    rows, columns = weight.shape
    if value.shape[-1:] != (columns,):
        missing = "a Flatten is missing before it" if value.size == columns else "the shapes disagree, export it again"
        raise node.fail(f"weight is for {columns} values, it gets {list(value.shape)}; {missing}")
    copies = math.prod(value.shape[:-1])
    if copies * weight.size > DENSE_LIMIT:
        raise node.fail(f"has {copies * weight.size:,} weights, {DENSE_LIMIT:,} are allowed; this fits no chip")
    result = through(value, block_diagonal(sparse.csr_array(weight), copies), (*value.shape[:-1], rows))
    if node.type == "Linear":
        return result
    return replace(result, bias=result.bias + np.tile(_each(node, "bias", rows), copies))


def _each(node: Node, key: str, size: int) -> FloatArray:
    values = node.numbers(key).ravel()
    if values.size != size:
        raise node.fail(f"{key} has {values.size} values, wanted {size}; export it again")
    return values


def _scale(node: Node, value: Value, _steps: Steps) -> Value:
    return scaled(value, spread(node, "scale", value.size, value.shape))


def _image(node: Node, value: Value, axes: int) -> tuple[int, ...]:
    """Channels and space of what a node gets; axes of length 1 in front are the batch's."""
    sizes = list(value.shape)
    while len(sizes) > axes + 1 and sizes[0] == 1:
        sizes.pop(0)
    if len(sizes) != axes + 1:
        wanted = "[channels, length]" if axes == 1 else "[channels, height, width]"
        raise node.fail(f"gets {list(value.shape)}, wanted {wanted}; the shapes disagree, export it again")
    return tuple(sizes)


def _padding(node: Node, kernel: tuple[int, ...], dilation: tuple[int, ...], stride: tuple[int, ...]) -> Padding:
    said = node.values.get("padding")
    if not isinstance(said, str):
        return [(zeros, zeros) for zeros in node.few("padding", len(kernel))]
    if said == "valid":
        return [(0, 0)] * len(kernel)
    if said == "same":
        if set(stride) != {1}:
            raise node.fail(f"has the padding 'same' at a stride of {max(stride)}, allowed is 1; export it again")
        total = [step * (size - 1) for size, step in zip(kernel, dilation, strict=True)]
        return [(zeros // 2, zeros - zeros // 2) for zeros in total]  # the odd zero comes after, as in torch
    raise node.fail(f"has the padding {said[:20]!r}, allowed are numbers, 'same' and 'valid'; export it again")


def _conv(node: Node, value: Value, _steps: Steps) -> Value:
    axes = 1 if node.type == "Conv1d" else 2
    weight = node.numbers("weight")
    if weight.ndim != axes + 2 or not weight.size:
        raise node.fail(
            f"weight has the shape {list(weight.shape)}, allowed are (filters, channels, *kernel); export it again"
        )
    shape, kernel = _image(node, value, axes), weight.shape[2:]
    if node.has("input_shape"):
        declared = tuple(node.integers("input_shape").ravel().tolist())
        if declared != shape[1:]:
            raise node.fail(f"is for inputs of {list(declared)}, it gets {list(shape[1:])}; export it again")
    stride, dilation = node.few("stride", axes), node.few("dilation", axes)
    padding, groups = _padding(node, kernel, dilation, stride), node.few("groups")[0]
    with node.named():
        matrix, out = convolution(shape, weight, stride=stride, padding=padding, dilation=dilation, groups=groups)
    result = through(value, matrix, out)
    if not node.has("bias"):
        return result
    return replace(result, bias=result.bias + np.repeat(_each(node, "bias", out[0]), math.prod(out[1:])))


def _pool(node: Node, value: Value, _steps: Steps) -> Value:
    shape = _image(node, value, 2)
    kernel, stride = node.few("kernel_size", 2), node.few("stride", 2)
    padding = _padding(node, kernel, (1, 1), stride)
    if min(kernel) < 1 or max(kernel) > max(shape) + 2 * max(max(pair) for pair in padding):
        raise node.fail(f"has a window of {list(kernel)} for {list(shape[1:])} places; export it again")
    share = 1 / math.prod(kernel) if node.type == "AvgPool2d" else 1.0
    weight = np.full((shape[0], 1, *kernel), share)  # zeros of the padding count
    with node.named():
        matrix, out = convolution(shape, weight, stride=stride, padding=padding, dilation=(1, 1), groups=shape[0])
    return through(value, matrix, out)


def _flatten(node: Node, value: Value, _steps: Steps) -> Value:
    first = node.few("start_dim")[0] if node.has("start_dim") else 1
    last = node.few("end_dim")[0] if node.has("end_dim") else -1
    axes = len(value.shape)
    first, last = (end + axes if end < 0 else end for end in (first, last))
    if not 0 <= first < axes or not first <= last < axes:
        # one axis is flat whatever is said about others
        if axes == 1:
            return value
        raise node.fail(f"flattens axes {first} to {last} of {list(value.shape)}; the shapes disagree, export it again")
    shape = value.shape
    return replace(value, shape=(*shape[:first], math.prod(shape[first : last + 1]), *shape[last + 1 :]))


def _integrator(node: Node, value: Value, steps: Steps) -> Value:
    """A leaky integrator that does not spike: the synaptic filter of what comes after it."""
    kept = steps.keeps(node, "tau", value.size, value.shape)
    alpha = shared(node, "tau", kept)
    gain = (1 - kept) * spread(node, "r", value.size, value.shape)
    drive = (1 - kept) * spread(node, "v_leak", value.size, value.shape)
    if not alpha:
        own = scaled(value, gain)
        return replace(own, bias=own.bias + drive)
    with node.named():
        return filtered(value, alpha, gain, drive)


def _same(_node: Node, value: Value, _steps: Steps) -> Value:
    return value


STAGES: dict[str, Callable[[Node, Value, Steps], Value]] = {
    "Affine": _linear,
    "AvgPool2d": _pool,
    "Conv1d": _conv,
    "Conv2d": _conv,
    "Flatten": _flatten,
    "Identity": _same,
    "LI": _integrator,
    "Linear": _linear,
    "Output": _same,
    "Scale": _scale,
    "SumPool2d": _pool,
}
"""By type what a node makes of a value; each raises ModelError, with the node's name."""
