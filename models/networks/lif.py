"""Spiking neurons as a torch module, one step a call, and the form in which a network of them is exported.

A network is any ``nn.Module`` with :class:`LIF` layers in it; whatever lies between two of them must be affine to be
compiled (:func:`module.compile_module`). How it is trained is its own affair.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spikeloom.models.networks.layers import Spike
from spikeloom.models.networks.surrogate import RECTANGLE


class LIF(nn.Module):
    """Leaky integrate-and-fire neurons: ``u <- beta * u * (1 - s) + current``, ``s = u > theta``.

    Keeps membrane and spikes from call to call, one call a step; :meth:`reset` before each recording. `beta` is the
    share of the membrane that a step keeps, `theta` the threshold.

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
        spikes: Tensor = Spike.apply(membrane, self.theta, RECTANGLE)  # type: ignore[no-untyped-call]
        self.membrane, self.spikes = membrane, spikes
        return spikes

    def extra_repr(self) -> str:
        """Constants, for ``print(net)``."""
        return f"beta={self.beta}, theta={self.theta}"


def reset(net: nn.Module) -> None:
    """Bring all neurons of a network to rest."""
    for layer in _lif_layers(net):
        layer.reset()


def _lif_layers(net: nn.Module) -> list[LIF]:
    return [module for module in net.modules() if isinstance(module, LIF)]


class OneStep(nn.Module):
    """One step of a network as a function: ``(x, state …) -> (output, state …)``, the form to export.

    The `example`, an input of one step, is for the shapes of the states.

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
        for index, layer in enumerate(_lif_layers(self.net)):
            layer.membrane, layer.spikes = state[2 * index], state[2 * index + 1]
        output: Tensor = self.net(x)
        after = self._state()
        reset(self.net)
        return output, *after

    def _state(self) -> tuple[Tensor, ...]:
        both = ((layer.membrane, layer.spikes) for layer in _lif_layers(self.net))
        return tuple(tensor for pair in both for tensor in pair if tensor is not None)
