"""Synaptic currents that outlast their step, all time steps at once; see :mod:`compiler.dynamics`."""

from __future__ import annotations

from typing import Any

import numba
import torch
from torch import Tensor

from spikeloom.models.networks.layers import kind_of, rows_of


def lasting_current(drive: Tensor, alpha: float) -> Tensor:
    """Synaptic currents along the first axis, from rest: ``i_t = alpha * i_{t-1} + drive_t``.

    Examples
    --------
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
    found = steps.clone(memory_format=torch.contiguous_format)
    if found.device.type == "cpu":
        accumulate(rows_of(found), kind_of(found)(alpha), backwards)
    else:
        accumulate_steps(found, alpha, backwards=backwards)
    return found


def accumulate_steps(current: Tensor, alpha: float, *, backwards: bool) -> None:
    """What :func:`accumulate` does, in torch operations: for devices without the kernels."""
    steps = range(len(current) - 2, -1, -1) if backwards else range(1, len(current))
    before = 1 if backwards else -1
    for t in steps:
        current[t] += alpha * current[t + before]


@numba.njit(cache=True)
def _accumulate_step(current: Any, before: Any, alpha: Any) -> None:
    for i in range(len(current)):
        current[i] += alpha * before[i]


@numba.njit(cache=True)
def accumulate(current: Any, alpha: Any, backwards: bool) -> None:
    """Add to each row (steps, neurons) the share `alpha` of the one before, in place; from the end if backwards."""
    steps = len(current)
    for t in range(1, steps):
        if backwards:
            _accumulate_step(current[steps - 1 - t], current[steps - t], alpha)
        else:
            _accumulate_step(current[t], current[t - 1], alpha)
