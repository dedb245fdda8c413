"""Integrate-and-fire neurons as the chip has them, and sums over blocks of their spikes, for training.

All numbers that reach a membrane are whole, below 2**24, and so exact in float32 in whatever order they are
added.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from spikeloom.models.networks.layers import spike_linear
from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate


def integrate(current: Tensor, threshold: Tensor, floor: Tensor, surrogate: Surrogate) -> Tensor:
    """Spikes of neurons that keep all they are given, from rest.

    ``m_t = c_{t-1} + current_t`` and ``s_t = m_t >= threshold``; then ``c_t`` is 0 after a spike, and
    ``max(m_t, -floor)`` otherwise. The gradient runs back through the membrane until a spike or the floor
    cuts it, and not through the reset; the surrogate, whose width is in thresholds, is taken at ``m /
    threshold - 1``. Currents and spikes are (steps, samples, neurons), thresholds and floors (neurons,),
    which have no gradient; all float32.
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


# Each step is a function of its own on one-dimensional arrays: only so does the compiler vectorise the
# loops.


@numba.njit(cache=True)
def _run_step(current: Any, state: Any, threshold: Any, floor: Any, spikes: Any, membrane: Any) -> None:
    zero = np.float32(0)
    one = np.float32(1)
    for i in range(len(state)):
        m = state[i] + current[i]
        fires = m >= threshold[i]
        membrane[i] = m
        spikes[i] = one if fires else zero
        state[i] = zero if fires else max(m, -floor[i])


@numba.njit(cache=True)
def _run(current: Any, threshold: Any, floor: Any, spikes: Any, membrane: Any) -> None:
    steps, samples, neurons = current.shape
    membranes = np.zeros((samples, neurons), np.float32)
    for t in range(steps):
        for s in range(samples):
            _run_step(current[t, s], membranes[s], threshold, floor, spikes[t, s], membrane[t, s])


@numba.njit(cache=True)
def _differentiate_step(
    above: Any, membrane: Any, later: Any, threshold: Any, floor: Any, width: Any, smooth: bool, out: Any
) -> None:
    zero = np.float32(0)
    one = np.float32(1)
    for i in range(len(membrane)):
        m = membrane[i]
        far = abs(m / threshold[i] - one) / width
        slope = one / ((one + far) * (one + far)) if smooth else (one if far < one else zero)
        kept = later[i] if -floor[i] <= m < threshold[i] else zero
        out[i] = kept + above[i] * slope / threshold[i]


@numba.njit(cache=True)
def _differentiate(
    above: Any, membrane: Any, threshold: Any, floor: Any, width: Any, smooth: bool, out: Any
) -> None:
    steps, samples, neurons = membrane.shape
    nothing = np.zeros(neurons, np.float32)
    for t in range(steps - 1, -1, -1):
        for s in range(samples):
            later = out[t + 1, s] if t + 1 < steps else nothing
            _differentiate_step(
                above[t, s], membrane[t, s], later, threshold, floor, width, smooth, out[t, s]
            )


def block_sums(spikes: Tensor, weight: Tensor) -> Tensor:
    """Sums of the weights of the inputs that spiked, block by block: a matrix product of matrices on a diagonal.

    `spikes` (steps, samples, blocks * width) are zeros and ones, the inputs of a block side by side; with
    `weight` (blocks, width, size) they give (steps, samples, blocks * size).
    """
    blocks = spikes.chunk(len(weight), dim=2)
    nothing = torch.zeros(weight.shape[2])
    return torch.cat([spike_linear(*block, nothing) for block in zip(blocks, weight, strict=True)], dim=2)
