"""Integrate-and-fire neurons as the chip has them, and sums over blocks of their spikes, for training.

All numbers that reach a membrane are whole, below 2**24, and so exact in float32 in whatever order they are added.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from spikeloom.models.networks.layers import events_of, rows_of
from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate


def integrate(current: Tensor, threshold: Tensor, floor: Tensor, surrogate: Surrogate) -> Tensor:
    """Spikes of neurons that keep all they are given, from rest.

    ``m_t = c_{t-1} + current_t`` and ``s_t = m_t >= threshold``; then ``c_t`` is 0 after a spike, and
    ``max(m_t, -floor)`` otherwise. The gradient runs back through the membrane until a spike or the floor cuts it, and
    not through the reset; the surrogate is taken at ``m / threshold - 1``.

    Parameters
    ----------
    current : (steps, samples, neurons) float32
        Whole numbers.
    threshold, floor : (neurons,) float32
        Whole numbers above and from zero; no gradient.
    surrogate : Surrogate
        Derivative of a spike, in units of the threshold.

    Returns
    -------
    (steps, samples, neurons) float32
        Zeros and ones.
    """
    spikes: Tensor = _Integrate.apply(current, threshold, floor, surrogate)  # type: ignore[no-untyped-call]
    return spikes


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, current: Tensor, threshold: Tensor, floor: Tensor, surrogate: Surrogate) -> Tensor:
        membrane = torch.empty_like(current, memory_format=torch.contiguous_format)
        spikes = torch.empty_like(membrane)
        limits = threshold.numpy(), floor.numpy()
        _run(current.detach().contiguous().numpy(), *limits, spikes.numpy(), membrane.numpy())
        ctx.save_for_backward(membrane, threshold, floor)
        ctx.surrogate = surrogate
        return spikes

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        membrane, threshold, floor = ctx.saved_tensors
        surrogate: Surrogate = ctx.surrogate
        out = torch.empty_like(membrane)
        arrays = gradients[0].contiguous().numpy(), membrane.numpy(), threshold.numpy(), floor.numpy()
        _differentiate(*arrays, np.float32(surrogate.width), surrogate.shape == FAST_SIGMOID, out.numpy())
        return out, None, None, None


# Each step is a function of its own on one-dimensional arrays: only so does the compiler vectorise the loops.


@numba.njit(cache=True)
def _run_step(current: Any, held: Any, threshold: Any, floor: Any, spikes: Any, membrane: Any) -> None:
    zero, one = np.float32(0), np.float32(1)
    for i in range(len(held)):
        m = held[i] + current[i]
        fires = m >= threshold[i]
        membrane[i] = m
        spikes[i] = one if fires else zero
        held[i] = zero if fires else max(m, -floor[i])


@numba.njit(cache=True)
def _run(current: Any, threshold: Any, floor: Any, spikes: Any, membrane: Any) -> None:
    steps, samples, neurons = current.shape
    held = np.zeros((samples, neurons), np.float32)
    for t in range(steps):
        for s in range(samples):
            _run_step(current[t, s], held[s], threshold, floor, spikes[t, s], membrane[t, s])


@numba.njit(cache=True)
def _differentiate_step(
    above: Any, membrane: Any, later: Any, threshold: Any, floor: Any, width: Any, smooth: bool, out: Any
) -> None:
    zero, one = np.float32(0), np.float32(1)
    for i in range(len(membrane)):
        m = membrane[i]
        far = abs(m / threshold[i] - one) / width
        slope = one / ((one + far) * (one + far)) if smooth else (one if far < one else zero)
        kept = later[i] if -floor[i] <= m < threshold[i] else zero
        out[i] = kept + above[i] * slope / threshold[i]


@numba.njit(cache=True)
def _differentiate(above: Any, membrane: Any, threshold: Any, floor: Any, width: Any, smooth: bool, out: Any) -> None:
    steps, samples, neurons = membrane.shape
    nothing = np.zeros(neurons, np.float32)
    for t in range(steps - 1, -1, -1):
        for s in range(samples):
            later = out[t + 1, s] if t + 1 < steps else nothing
            _differentiate_step(above[t, s], membrane[t, s], later, threshold, floor, width, smooth, out[t, s])


def block_sums(spikes: Tensor, weight: Tensor) -> Tensor:
    """Sums of the weights of the inputs that spiked, block by block: a matrix product of matrices on a diagonal.

    `spikes` (steps, samples, blocks * width) are zeros and ones, the inputs of a block side by side; with `weight`
    (blocks, width, size) they give (steps, samples, blocks * size).
    """
    found: Tensor = _BlockSums.apply(spikes, weight)  # type: ignore[no-untyped-call]
    return found


class _BlockSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, spikes: Tensor, weight: Tensor) -> Tensor:
        blocks, width, size = weight.shape
        steps, samples, _ = spikes.shape
        rows = spikes.detach().reshape(steps * samples, blocks * width).contiguous()
        source, bounds = events_of(rows.numpy())
        out = torch.zeros((steps * samples, blocks * size))
        _gather(source, bounds, width, weight.detach().contiguous().view(-1, size).numpy(), out.numpy())
        ctx.events = source, bounds
        ctx.save_for_backward(weight)
        return out.view(steps, samples, blocks * size)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor]:
        (weight,) = ctx.saved_tensors
        blocks, width, size = weight.shape
        above = gradients[0].contiguous()
        rows = above.view(-1, blocks * size)
        out = torch.zeros_like(weight)
        source, bounds = ctx.events
        _scatter(source, bounds, width, rows.numpy(), rows_of(out.view(-1, size)))
        if not ctx.needs_input_grad[0]:
            return None, out
        below = torch.bmm(rows.view(-1, blocks, size).transpose(0, 1), weight.transpose(1, 2))
        return below.transpose(0, 1).reshape(*above.shape[:-1], blocks * width), out


@numba.njit(cache=True)
def _add(total: Any, term: Any) -> None:
    for i in range(len(total)):
        total[i] += term[i]


@numba.njit(cache=True)
def _gather(source: Any, bounds: Any, width: int, weight: Any, out: Any) -> None:
    size = weight.shape[1]
    for row in range(len(out)):
        for event in range(bounds[row], bounds[row + 1]):
            at = source[event] // width * size
            _add(out[row, at : at + size], weight[source[event]])


@numba.njit(cache=True)
def _scatter(source: Any, bounds: Any, width: int, rows: Any, out: Any) -> None:
    size = out.shape[1]
    for row in range(len(rows)):
        for event in range(bounds[row], bounds[row + 1]):
            at = source[event] // width * size
            _add(out[source[event]], rows[row, at : at + size])
