"""Layers that compute all time steps at once: a K-hop graph convolution and a leaky integrate-and-fire recurrence.

Time comes first, (steps, samples, …), so that a layer is one matrix product over all steps and samples,
followed by a recurrence that runs along the first axis only.

References
----------
.. [1] J. Du et al., "Topology Adaptive Graph Convolutional Networks", 2017, arXiv:1710.10370.
.. [2] Y. Wu et al., "Spatio-Temporal Backpropagation for Training High-Performance Spiking Neural Networks",
   Frontiers in Neuroscience 12, 2018: the rectangular surrogate.
.. [3] F. Zenke, S. Ganguli, "SuperSpike: Supervised Learning in Multilayer Spiking Neural Networks", Neural
   Computation 30(6), 2018: the surrogate of a fast sigmoid.
.. [4] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020.
"""

from itertools import pairwise
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from spikeloom.compiler.layer_kernel import Raster, add, copy, integrate_float, raster_of, require_below
from spikeloom.compiler.types import EventArray
from spikeloom.models.networks.surrogate import FAST_SIGMOID, RECTANGLE, Surrogate

LARGE = 1 << 16
"""Weights from which on oneDNN is worth its preparations."""


def tag_convolution(x: Tensor, adjacency: Tensor, hops: Tensor, bias: Tensor) -> Tensor:
    """K-hop filter ``y = sum_k A^k x g_k^T + b`` [1]_, summed in the order of the released operator.

    For `x` (steps, samples, taxels, channels), into which no gradient flows, `adjacency` (taxels, taxels),
    whose row i gathers into taxel i, and `hops` (K + 1, features, channels); (steps, samples, taxels *
    features), taxel-major.
    """
    steps, samples, taxels, channels = x.shape
    # Taxels last: a hop is then one product of a tall matrix with (taxels, taxels), and its result lies as
    # needed next.
    reached = x.new_empty(len(hops), channels * steps * samples, taxels)
    reached[0] = x.permute(3, 0, 1, 2).reshape(-1, taxels)
    for k in range(1, len(hops)):
        torch.mm(reached[k - 1], adjacency.t(), out=reached[k])
    out: Tensor = _HopSum.apply(reached.view(len(hops), channels, -1), hops, bias)  # type: ignore[no-untyped-call]
    return out.view(steps, samples, -1)


class _HopSum(torch.autograd.Function):
    """``sum_k columns_k^T hops_k^T + bias``: one product per hop forward, one in all backward."""

    @staticmethod
    def forward(ctx: Any, columns: Tensor, hops: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(columns)
        out = columns[0].t() @ hops[0].t()
        for k in range(1, len(hops)):
            out.addmm_(columns[k].t(), hops[k].t())
        out += bias
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, Tensor]:
        (columns,) = ctx.saved_tensors
        hops = (columns.flatten(0, 1) @ gradients[0]).view(*columns.shape[:2], -1).transpose(1, 2)
        return None, hops, gradients[0].sum(0)


def filter_places(x: Tensor, propagation: Tensor, filters: Tensor, bias: Tensor) -> Tensor:
    """``y = sum_k M_k x g_k^T + b``, in one product: of what every place sees, with all filters side by side.

    As :func:`tag_convolution`; `propagation` (filters, places, taxels) stacks the M_k, the output is
    place-major.
    """
    steps, samples, taxels, channels = x.shape
    n_filters, places, _ = propagation.shape
    # Rows are places here, so that one product with a wide matrix gathers for all steps and samples.
    seen = propagation.transpose(0, 1).reshape(-1, taxels) @ x.permute(2, 0, 1, 3).reshape(taxels, -1)
    rows = seen.view(places, n_filters, -1, channels).permute(2, 0, 1, 3).reshape(-1, n_filters * channels)
    weight = filters.permute(0, 2, 1).reshape(n_filters * channels, -1)
    return torch.addmm(bias, rows, weight).view(steps, samples, -1)


def lif(
    current: Tensor, beta: float, theta: float, surrogate: Surrogate = RECTANGLE
) -> tuple[Tensor, Tensor]:
    """Leaky integrate-and-fire neurons along the first axis, from rest.

    ``u_t = beta * u_{t-1} * (1 - s_{t-1}) + current_t`` and ``s_t = u_t > theta``, a strict comparison. The
    gradient runs through the decay and, where the surrogate says so, through the reset, with the surrogate
    [2]_ [3]_ for the derivative of the spike. Returns zeros and ones, and the membrane that was compared
    with `theta`, both (steps, ...); no gradient flows from the membrane.
    """
    spikes, membrane = _Lif.apply(current, beta, theta, surrogate)  # type: ignore[no-untyped-call]
    return spikes, membrane


class _Lif(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, current: Tensor, beta: float, theta: float, surrogate: Surrogate
    ) -> tuple[Tensor, Tensor]:
        ctx.beta = beta
        ctx.theta = theta
        ctx.surrogate = surrogate
        current = current.contiguous()
        spikes = torch.empty_like(current)
        membrane = torch.empty_like(current)
        kind = kind_of(current)
        _integrate(rows_of(current), kind(beta), kind(theta), rows_of(spikes), rows_of(membrane))
        ctx.save_for_backward(membrane)
        ctx.mark_non_differentiable(membrane)
        ctx.set_materialize_grads(False)
        return spikes, membrane

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        (membrane,) = ctx.saved_tensors
        out = torch.empty_like(membrane)
        rows = rows_of(gradients[0].contiguous()), rows_of(membrane)
        surrogate: Surrogate = ctx.surrogate
        kind = kind_of(membrane)
        constants = kind(ctx.beta), kind(ctx.theta), kind(surrogate.width), kind(surrogate.reset)
        _differentiate(*rows, *constants, surrogate.shape == FAST_SIGMOID, rows_of(out))
        return out, None, None, None


def lasting_current(drive: Tensor, alpha: float) -> Tensor:
    """Synaptic currents along the first axis, from rest: ``i_t = alpha * i_{t-1} + drive_t``.

    >>> lasting_current(torch.tensor([1.0, 0.0, 2.0]), 0.5).tolist()
    [1.0, 0.5, 2.25]
    """
    current: Tensor = _LastingCurrent.apply(drive, alpha)  # type: ignore[no-untyped-call]
    return current


class _LastingCurrent(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, drive: Tensor, alpha: float) -> Tensor:
        ctx.alpha = alpha
        return _accumulated(drive, alpha, backwards=False)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _accumulated(gradients[0], ctx.alpha, backwards=True), None


def _accumulated(steps: Tensor, alpha: float, *, backwards: bool) -> Tensor:
    """Each step plus the share `alpha` of the sum so far, from the last step on if `backwards`."""
    sums = steps.clone(memory_format=torch.contiguous_format)
    rows = rows_of(sums)
    kept = kind_of(sums)(alpha)
    for before, row in pairwise(rows[::-1] if backwards else rows):
        np.add(row, kept * before, out=row)
    return sums


def spike_linear(spikes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Affine layer over zeros and ones, which adds up the weights of the inputs that spiked.

    Costs what the spikes cost (5 to 15 % of a dense product here); only the gradient of `spikes` is dense.
    The weight is (inputs, outputs), transposed against torch's ``Linear``, so that the weights of one input
    lie side by side; the bias starts each sum, the inputs follow in ascending order.
    """
    out: Tensor = _SpikeLinear.apply(spikes, weight, bias)  # type: ignore[no-untyped-call]
    return out


class _SpikeLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, spikes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        source, bounds = events_of(spikes)
        require_below("input", source, len(weight))
        out = bias.expand(len(bounds) - 1, -1).clone(memory_format=torch.contiguous_format)
        gather(source, bounds, weight.detach().contiguous().numpy(), out.numpy())
        ctx.events = source, bounds
        ctx.save_for_backward(weight)
        return out.view(*spikes.shape[:-1], -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (weight,) = ctx.saved_tensors
        above = gradients[0].contiguous()
        rows = above.view(-1, above.shape[-1])
        out = torch.zeros_like(weight)
        source, bounds = ctx.events
        scatter(source, bounds, rows.numpy(), out.numpy())
        return times(rows, weight).view(*above.shape[:-1], -1), out, rows.sum(0)


def times(rows: Tensor, weight: Tensor) -> Tensor:
    """``rows @ weight.t()``, a large one by oneDNN, whose wider registers need half the time for the same sums."""
    product = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    if weight.numel() < LARGE or rows.dtype != torch.float32 or product is None:
        return rows @ weight.t()
    out: Tensor = product(rows, weight.detach(), None, "none", [], "")
    return out


def time_first(events: EventArray) -> Tensor:
    """(samples, taxels, channels, steps) uint8 to (steps, samples, taxels, channels) float32."""
    return torch.from_numpy(events.transpose(3, 0, 1, 2).astype(np.float32, order="C"))


def rates_of(spikes: Tensor, lengths: Tensor | None) -> Tensor:
    """Spikes per step of (steps, samples, neurons), without the steps by which shorter recordings were filled up."""
    if lengths is None:
        return spikes.mean(0)
    inside = torch.arange(len(spikes))[:, None] < lengths
    return torch.sum(spikes * inside[..., None], dim=0) / lengths[:, None]


def events_of(spikes: Tensor) -> Raster:
    """Which inputs spiked in each row of zeros and ones (…, inputs); all axes before the last are rows."""
    return raster_of(spikes.detach().reshape(1, -1, spikes.shape[-1]).numpy() != 0)


def rows_of(tensor: Tensor) -> np.ndarray[Any, Any]:
    """View as (steps, everything else)."""
    view: np.ndarray[Any, Any] = tensor.detach().view(len(tensor), -1).numpy()
    return view


def kind_of(like: Tensor) -> type[np.float32] | type[np.float64]:
    """Precision in which the recurrence is defined: that of `like`."""
    return np.float32 if like.dtype == torch.float32 else np.float64


# Each step is a function of its own on one-dimensional arrays: only so does the compiler vectorise the
# loops.


@numba.njit(cache=True)
def _integrate(current: Any, beta: Any, theta: Any, spikes: Any, membrane: Any) -> None:
    state = np.zeros(current.shape[1], current.dtype)
    no_bias = np.zeros_like(state)
    for t in range(len(current)):
        integrate_float(state, current[t], no_bias, beta, theta, spikes[t])
        copy(state, membrane[t])


@numba.njit(cache=True)
def differentiate_step(
    from_above: Any,
    membrane: Any,
    later: Any,
    beta: Any,
    theta: Any,
    width: Any,
    reset: Any,
    smooth: Any,
    out: Any,
) -> None:
    """Gradient of the current of a step from that of its spikes, and `later`, that of the step after."""
    zero = membrane.dtype.type(0)
    one = membrane.dtype.type(1)
    for i in range(len(membrane)):
        u = membrane[i]
        through_spike = from_above[i] - reset * (later[i] * (u * beta))
        through_decay = zero if u > theta else later[i] * beta
        away = abs(u - theta)
        if smooth:
            far = one + away / width
            out[i] = through_decay + through_spike / (far * far)
        else:
            out[i] = through_decay + (through_spike if away < width else zero)


@numba.njit(cache=True)
def _differentiate(
    spikes_gradient: Any,
    membrane: Any,
    beta: Any,
    theta: Any,
    width: Any,
    reset: Any,
    smooth: bool,
    out: Any,
) -> None:
    """Gradient of the current from that of the spikes, both (steps, neurons), through decay and reset."""
    steps, size = membrane.shape
    later = np.zeros(size, membrane.dtype)
    for t in range(steps - 1, -1, -1):
        differentiate_step(spikes_gradient[t], membrane[t], later, beta, theta, width, reset, smooth, out[t])
        later = out[t]


@numba.njit(cache=True)
def gather(source: Any, bounds: Any, weight: Any, out: Any) -> None:
    """Add to each row the weights (inputs, outputs) of its inputs that spiked."""
    for row in range(len(out)):
        for event in range(bounds[row], bounds[row + 1]):
            add(out[row], weight[source[event]])


@numba.njit(cache=True)
def scatter(source: Any, bounds: Any, rows: Any, out: Any) -> None:
    """Add each row to the weights (inputs, outputs) of its inputs that spiked: the gradient of :func:`gather`."""
    for row in range(len(rows)):
        for event in range(bounds[row], bounds[row + 1]):
            add(out[source[event]], rows[row])
