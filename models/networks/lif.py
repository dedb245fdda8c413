"""Spiking neurons as a torch module, one step a call, and wrappers that run or export a network made of them.

A network is any ``nn.Module`` with :class:`LIF` layers in it; whatever lies between two of them must be affine to be
compiled (:func:`module.compile_module`). How it is trained is its own affair.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spikeloom.models.networks.layers import SURROGATE_HALF_WIDTH


class _Spike(torch.autograd.Function):
    """``u > theta``, with the rectangular surrogate for its derivative."""

    @staticmethod
    def forward(ctx: Any, membrane: Tensor, theta: float) -> Tensor:
        ctx.save_for_backward(membrane)
        ctx.theta = theta
        return (membrane > theta).to(membrane.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (membrane,) = ctx.saved_tensors
        return gradients[0] * ((membrane - ctx.theta).abs() < SURROGATE_HALF_WIDTH), None


class LIF(nn.Module):
    """Leaky integrate-and-fire neurons: ``u <- beta * u * (1 - s) + current``, ``s = u > theta``.

    Keeps membrane and spikes from call to call, one call a step; :meth:`reset` before each recording.

    Parameters
    ----------
    beta, theta : float
        Share of the membrane that a step keeps, and threshold.

    Examples
    --------
    >>> neuron = LIF(beta=0.5, theta=1.0)
    >>> [float(neuron(torch.tensor([0.75]))) for _ in range(3)]
    [0.0, 1.0, 0.0]
    """

    def __init__(self, beta: float = 0.2, theta: float = 0.5) -> None:
        super().__init__()
        self.beta, self.theta = beta, theta
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
        self.membrane, self.spikes = membrane, spikes
        return spikes

    def extra_repr(self) -> str:
        """Constants, for ``print(net)``."""
        return f"beta={self.beta}, theta={self.theta}"


def reset(net: nn.Module) -> None:
    """Bring all neurons of a network to rest."""
    for module in net.modules():
        if isinstance(module, LIF):
            module.reset()


class OneStep(nn.Module):
    """One step of a network as a function: ``(x, state …) -> (output, state …)``, the form to export.

    Parameters
    ----------
    net : Module
        Network with :class:`LIF` layers.
    example : Tensor
        Input of one step, for the shapes of the states.

    Examples
    --------
    >>> step = OneStep(nn.Sequential(nn.Linear(4, 3), LIF()), torch.zeros(1, 4))
    >>> output, *state = step(torch.ones(1, 4), *step.rest)
    >>> len(state)
    2
    """

    def __init__(self, net: nn.Module, example: Tensor) -> None:
        super().__init__()
        self.net = net
        reset(net)
        with torch.no_grad():
            net(example)
        self.rest = tuple(torch.zeros_like(tensor) for tensor in self._state())
        reset(net)

    def forward(self, x: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Output and new state, membranes and spikes of each layer in turn."""
        layers = [module for module in self.net.modules() if isinstance(module, LIF)]
        for index, layer in enumerate(layers):
            layer.membrane, layer.spikes = state[2 * index], state[2 * index + 1]
        output: Tensor = self.net(x)
        after = self._state()
        reset(self.net)
        return output, *after

    def _state(self) -> tuple[Tensor, ...]:
        layers = [module for module in self.net.modules() if isinstance(module, LIF)]
        return tuple(tensor for layer in layers for tensor in (layer.membrane, layer.spikes) if tensor is not None)


class AllSteps(nn.Module):
    """All steps of a recording, from rest: the mean of a network's output, for an input whose last axis is time."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor) -> Tensor:
        """Mean output over the steps."""
        reset(self.net)
        total = self.net(x[..., 0])
        for step in range(1, x.shape[-1]):
            total = total + self.net(x[..., step])
        reset(self.net)
        return total / x.shape[-1]  # type: ignore[no-any-return]
