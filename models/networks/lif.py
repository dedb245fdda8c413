"""Spiking neurons as a torch module, one step a call.

A network is any ``nn.Module`` with :class:`LIF` layers in it; whatever lies between two of them must be
affine to be compiled (:func:`module.module_network`). How it is trained is its own affair.
"""

from typing import Any

import torch
from torch import Tensor, nn

from spikeloom.models.networks.surrogate import RECTANGLE


class _Spike(torch.autograd.Function):
    """``u > theta``, with the released code's surrogate for its derivative."""

    @staticmethod
    def forward(ctx: Any, membrane: Tensor, theta: float) -> Tensor:
        ctx.save_for_backward((membrane - theta).abs() < RECTANGLE.width)
        return (membrane > theta).to(membrane.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (near,) = ctx.saved_tensors
        return gradients[0] * near, None


class LIF(nn.Module):
    """Leaky integrate-and-fire neurons: ``u <- beta * u * (1 - s) + current``, ``s = u > theta``.

    Keeps membrane and spikes from call to call, one call a step; :meth:`reset` before each recording. `beta`
    is the share of the membrane that a step keeps, `theta` the threshold.

    >>> import torch
    >>> neuron = LIF(beta=0.5, theta=1.0)
    >>> [float(neuron(torch.tensor([0.75]))) for _ in range(3)]
    [0.0, 1.0, 0.0]
    """

    def __init__(self, beta: float = 0.2, theta: float = 0.5) -> None:
        super().__init__()
        self.beta = beta
        self.theta = theta
        self.membrane: Tensor | None = None
        self.spikes: Tensor | None = None

    def reset(self) -> None:
        """Back to rest."""
        self.membrane = self.spikes = None

    def forward(self, current: Tensor) -> Tensor:
        """Spikes of one step, zeros and ones of the shape of the current."""
        if self.membrane is None or self.spikes is None:
            membrane = current
        else:
            membrane = self.membrane * self.beta * (1.0 - self.spikes) + current
        spikes: Tensor = _Spike.apply(membrane, self.theta)  # type: ignore[no-untyped-call]
        self.membrane = membrane
        self.spikes = spikes
        return spikes

    def extra_repr(self) -> str:
        """Constants, for ``print(net)``."""
        return f"beta={self.beta}, theta={self.theta}"


def reset(net: nn.Module) -> None:
    """Bring all neurons of a network to rest."""
    for module in net.modules():
        if isinstance(module, LIF):
            module.reset()
