"""What flows along the edges of a NIR graph, and what each node that is no spiking neuron makes of it.

NIR neurons are differential equations and a file has no time step. In steps of `dt` a membrane with time
constant tau keeps ``beta``, and the rest, ``1 - beta``, comes from ``v_leak + r * I``:

``euler``
    ``beta = 1 - dt / tau``, the forward Euler method, which snnTorch, Norse and SpikingJelly mean;
``exponential``
    ``beta = exp(-dt / tau)``, exact for an input that is constant over the step, which sinabs means.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from spikeloom.compiler.dynamics import MOST_STEPS
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.formats import affine
from spikeloom.compiler.formats.affine import (
    Affine,
    Padding,
    block_diagonal,
    convolution,
    scaled,
    shifted,
    through,
)
from spikeloom.compiler.formats.names import named
from spikeloom.compiler.formats.nir.file import SPIKING, Graph, Node
from spikeloom.compiler.types import FloatArray

ALWAYS = -2
"""Atom of what flows into a filter in every step, beside the sources of spikes; (1,)."""

TOLERANCE = 1e-6
"""What float32 leaves of equal numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """How time constants become decays."""

    dt: float  # Seconds of a step
    convention: str  # see the module

    def keeps(self, node: Node, key: str, size: int, shape: tuple[int, ...]) -> FloatArray:
        """Share that a step keeps, of a time constant, (size,); ModelError if there is none in this convention."""
        tau = spread(node, key, size, shape)
        if np.any(tau <= 0):
            raise node.fail(f"{key} is {tau.min():g}, allowed are numbers above 0; train it again")
        if self.convention == "exponential":
            return np.exp(-self.dt / tau)
        kept = 1 - self.dt / tau
        if np.any(kept < -TOLERANCE):
            step = _written_for(node)
            hint = "" if step is None else f" (its r is tau / {step:g}, so it was written in steps of that)"
            raise node.fail(
                f"{key} is {tau.min():g} s, shorter than the step of {self.dt:g} s, which the Euler convention cannot "
                f"have{hint}; give another --dt, or --convention exponential"
            )
        return np.maximum(kept, 0)


def require_step(dt: float) -> None:
    """Refuse a time step that is none."""
    if not 0 < dt < math.inf:
        raise OptionError(f"--dt {dt:g}: is no time step; give seconds above 0")


def _stated(graph: Graph, name: str) -> float | None:
    """A single number in the metadata of a file."""
    said = graph.metadata.get(name)
    return said.item() if isinstance(said, np.ndarray) and said.size == 1 else None


def stated_step(graph: Graph) -> float | None:
    """Seconds of a step, where the metadata of a file say so; ModelError if that is none."""
    dt = _stated(graph, "dt")
    if dt is not None and not (type(dt) in (int, float) and 0 < dt < math.inf):
        raise ModelError(f"states steps of {dt} s, which are none; export it again")
    return None if dt is None else float(dt)


def stated_steps(graph: Graph, name: str) -> int | None:
    """A number of steps or bins, where the metadata that we write say so."""
    steps = _stated(graph, name)
    return steps if isinstance(steps, int) and 1 <= steps <= MOST_STEPS else None


def written_step(graph: Graph) -> float | None:
    """Step that a file was written in, as far as all of its neurons say the same."""
    written = [
        _written_for(node)
        for node in graph.nodes.values()
        if node.type in SPIKING and node.type != "Threshold"
    ]
    steps = [step for step in written if step is not None]
    same = len(steps) == len(written) and all(math.isclose(step, steps[0], rel_tol=1e-4) for step in steps)
    return steps[0] if steps and same else None


def _written_for(node: Node) -> float | None:
    """Step that a neuron was written for, where its `r` tells: tau over the step, and not 1."""
    if not node.has("r"):
        return None
    key = {"LIF": "tau", "LI": "tau", "CubaLIF": "tau_mem"}.get(node.type)
    r = node.numbers("r").ravel()
    tau = node.numbers(key).ravel() if key and node.has(key) else np.ones(1)
    if 0 in (tau.size, r.size) or (tau.size != r.size and 1 not in (tau.size, r.size)) or np.all(r == 1):
        return None
    with np.errstate(all="ignore"):
        step = tau / r
    same = step[0] > 0 and np.ptp(step) <= TOLERANCE * step[0]
    return float(f"{step[0]:.6g}") if same else None


def spread(node: Node, key: str, size: int, shape: tuple[int, ...]) -> FloatArray:
    """A parameter for each neuron, (size,): one for all, one each, or one that broadcasts against `shape`."""
    values = node.numbers(key)
    if values.size == size:
        return values.ravel()
    try:
        return np.array(np.broadcast_to(values.ravel() if values.size == 1 else values, shape)).ravel()
    except ValueError:
        raise node.fail(
            f"{key} has the shape {list(values.shape)}, it gets {list(shape)}; the shapes must be equal, export it "
            "again"
        ) from None


def shared(node: Node, key: str, decay: FloatArray) -> float:
    """The decay that all neurons of a node share; ModelError if they have several."""
    if np.ptp(decay) > TOLERANCE:
        raise node.fail(
            f"{key} is different from neuron to neuron, allowed is one for a layer; use one node for each"
        )
    return float(decay[0]) if decay.size else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Value(Affine):
    """``f + bias`` with ``f <- alpha * f + (sum of terms)`` in every step, of spikes and of ``ALWAYS``."""

    alpha: float = 0.0  # Share of the current that a step keeps; 0 without a filter

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self.bias)


def spikes_of(source: int, shape: tuple[int, ...]) -> Value:
    """The spikes of a source, or the events of the input."""
    size = math.prod(shape)
    return Value(shape=shape, terms={source: sparse.eye_array(size, format="csr")}, bias=np.zeros(size))


def added(values: Sequence[Value]) -> Value:
    """The sum of several, as a node with several edges gets; ModelError if their shapes or their filters differ."""
    first = values[0]
    if any(value.shape != first.shape for value in values):
        shown = " and ".join(str(list(value.shape)) for value in values)
        raise ModelError(f"gets values of different shapes, {shown}; export it again")
    alphas = {value.alpha for value in values if value.terms} or {0.0}
    if len(alphas) > 1:
        raise ModelError("gets currents with different time constants; a neuron of the chip has one")
    return replace(affine.added([(1.0, value) for value in values], first.shape), alpha=alphas.pop())


def filtered(value: Value, alpha: float, gain: FloatArray, drive: FloatArray) -> Value:
    """The state of a leaky integrator: ``f <- alpha * f + gain * value + drive``; `gain` and `drive` are (size,).

    ModelError if the value went through one before.
    """
    driven = shifted(scaled(value, gain), drive)
    if not alpha:
        return driven
    if value.alpha:
        raise ModelError("filters a current that is filtered before; a neuron of the chip has one current")
    constant = {ALWAYS: sparse.csr_array(driven.bias[:, None])} if np.any(driven.bias) else {}
    return replace(driven, alpha=alpha, terms={**driven.terms, **constant}, bias=np.zeros(value.size))


def _linear(node: Node, value: Value, _steps: Steps) -> Value:
    weight = node.numbers("weight")
    if weight.ndim != 2:
        raise node.fail(
            f"weight has the shape {list(weight.shape)}, allowed are (to, from); export it again"
        )
    rows, columns = weight.shape
    if value.shape[-1:] != (columns,):
        missing = (
            "a Flatten is missing before it"
            if value.size == columns
            else "the shapes disagree, export it again"
        )
        raise node.fail(f"weight is for {columns} values, it gets {list(value.shape)}; {missing}")
    copies = math.prod(value.shape[:-1])
    with named(node):
        matrix = block_diagonal(sparse.csr_array(weight), copies)
    result = through(matrix, value, (*value.shape[:-1], rows))
    if node.type == "Linear":
        return result
    return shifted(result, np.tile(_each(node, "bias", rows), copies))


def _each(node: Node, key: str, size: int) -> FloatArray:
    values = node.numbers(key).ravel()
    if values.size != size:
        raise node.fail(f"{key} has {values.size} values, wanted {size}; export it again")
    return values


def _image(node: Node, value: Value, axes: int) -> tuple[int, ...]:
    """Channels and space of what a node gets; axes of length 1 in front are the batch's."""
    sizes = list(value.shape)
    while len(sizes) > axes + 1 and sizes[0] == 1:
        sizes.pop(0)
    if len(sizes) != axes + 1:
        wanted = "[channels, length]" if axes == 1 else "[channels, height, width]"
        raise node.fail(f"gets {list(value.shape)}, wanted {wanted}; the shapes disagree, export it again")
    return tuple(sizes)


def _padding(
    node: Node, kernel: tuple[int, ...], dilation: tuple[int, ...], stride: tuple[int, ...]
) -> Padding:
    said = node.values.get("padding")
    if not isinstance(said, str):
        return [(zeros, zeros) for zeros in node.few("padding", len(kernel))]
    if said == "valid":
        return [(0, 0)] * len(kernel)
    if said == "same":
        if set(stride) != {1}:
            raise node.fail(
                f"has the padding 'same' at a stride of {max(stride)}, allowed is 1; export it again"
            )
        total = [step * (size - 1) for size, step in zip(kernel, dilation, strict=True)]
        return [(zeros // 2, zeros - zeros // 2) for zeros in total]  # the odd zero comes after, as in torch
    raise node.fail(
        f"has the padding {said[:20]!r}, allowed are numbers, 'same' and 'valid'; export it again"
    )


def _conv(node: Node, value: Value, _steps: Steps) -> Value:
    axes = 1 if node.type == "Conv1d" else 2
    weight = node.numbers("weight")
    if weight.ndim != axes + 2 or not weight.size:
        raise node.fail(
            f"weight has the shape {list(weight.shape)}, allowed are (filters, channels, *kernel); export it again"
        )
    shape = _image(node, value, axes)
    kernel = weight.shape[2:]
    if node.has("input_shape"):
        declared = tuple(node.integers("input_shape").ravel().tolist())
        if declared != shape[1:]:
            raise node.fail(f"is for inputs of {list(declared)}, it gets {list(shape[1:])}; export it again")
    stride = node.few("stride", axes)
    dilation = node.few("dilation", axes)
    padding = _padding(node, kernel, dilation, stride)
    groups = node.few("groups")[0]
    with named(node):
        matrix, out = convolution(
            shape, weight, stride=stride, padding=padding, dilation=dilation, groups=groups
        )
    result = through(matrix, value, out)
    if not node.has("bias"):
        return result
    return shifted(result, np.repeat(_each(node, "bias", out[0]), math.prod(out[1:])))


def _pool(node: Node, value: Value, _steps: Steps) -> Value:
    shape = _image(node, value, 2)
    kernel = node.few("kernel_size", 2)
    stride = node.few("stride", 2)
    padding = _padding(node, kernel, (1, 1), stride)
    if min(kernel) < 1 or max(kernel) > max(shape) + 2 * max(max(pair) for pair in padding):
        raise node.fail(f"has a window of {list(kernel)} for {list(shape[1:])} places; export it again")
    share = 1 / math.prod(kernel) if node.type == "AvgPool2d" else 1.0
    # Zeros of the padding count. One number, spread: how large a window is, the file says, and `convolution` limits.
    weight = np.broadcast_to(share, (shape[0], 1, *kernel))
    with named(node):
        matrix, out = convolution(
            shape, weight, stride=stride, padding=padding, dilation=(1, 1), groups=shape[0]
        )
    return through(matrix, value, out)


def _flatten(node: Node, value: Value, _steps: Steps) -> Value:
    first = node.few("start_dim")[0] if node.has("start_dim") else 1
    last = node.few("end_dim")[0] if node.has("end_dim") else -1
    axes = len(value.shape)
    first, last = (end + axes if end < 0 else end for end in (first, last))
    if not 0 <= first < axes or not first <= last < axes:
        # one axis is flat whatever is said about others
        if axes == 1:
            return value
        raise node.fail(
            f"flattens axes {first} to {last} of {list(value.shape)}; the shapes disagree, export it again"
        )
    shape = value.shape
    return replace(value, shape=(*shape[:first], math.prod(shape[first : last + 1]), *shape[last + 1 :]))


def _integrator(node: Node, value: Value, steps: Steps) -> Value:
    """A leaky integrator that does not spike: the synaptic filter of what comes after it."""
    kept = steps.keeps(node, "tau", value.size, value.shape)
    alpha = shared(node, "tau", kept)
    gain = (1 - kept) * spread(node, "r", value.size, value.shape)
    drive = (1 - kept) * spread(node, "v_leak", value.size, value.shape)
    with named(node):
        return filtered(value, alpha, gain, drive)


STAGES: dict[str, Callable[[Node, Value, Steps], Value]] = {
    "Affine": _linear,
    "AvgPool2d": _pool,
    "Conv1d": _conv,
    "Conv2d": _conv,
    "Flatten": _flatten,
    "Identity": lambda _node, value, _steps: value,
    "LI": _integrator,
    "Linear": _linear,
    "Output": lambda _node, value, _steps: value,
    "Scale": lambda node, value, _steps: scaled(value, spread(node, "scale", value.size, value.shape)),
    "SumPool2d": _pool,
}
"""By type what a node makes of a value; each raises ModelError, with the node's name."""
