"""Spiking graph networks for touch, computed layer by layer over all time steps.

References
----------
.. [1] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models.layers import lif, spike_linear, tag_convolution

Weights = dict[str, NDArray[np.float32]]
"""Arrays by name: ``conv1.hops`` (K + 1, features, channels), ``conv1.bias``, then ``fc1.weight`` (outputs, inputs),
``fc1.bias`` and so on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Architecture:
    """Sizes and neuron constants of a `TactileSGNet`; the defaults are those of [1]_.

    Parameters
    ----------
    taxels, classes : int
        Sensor points and output neurons.
    channels : int
        Inputs per taxel (polarities).
    hops : int
        K of the graph convolution, which has K + 1 filters.
    features : int
        Outputs of the graph convolution per taxel.
    hidden : tuple of int
        Neurons of each dense layer before the last.
    beta, theta : float
        Membrane decay per step and firing threshold of every neuron.
    """

    taxels: int
    classes: int
    channels: int = 2
    hops: int = 3
    features: int = 64
    hidden: tuple[int, ...] = (128, 256)
    beta: float = 0.2
    theta: float = 0.5


class TagConvolution(nn.Module):
    """K-hop graph convolution with filters (K + 1, features, channels)."""

    def __init__(self, channels: int, features: int, hops: int, generator: torch.Generator) -> None:
        super().__init__()
        self.hops = nn.Parameter(torch.empty(hops + 1, features, channels))
        self.bias = nn.Parameter(torch.zeros(features))
        _uniform(self.hops, channels, generator)

    def forward(self, x: Tensor, adjacency: Tensor) -> Tensor:
        """See :func:`models.layers.tag_convolution`."""
        return tag_convolution(x, adjacency, self.hops, self.bias)


class SpikeLinear(nn.Module):
    """Affine layer over spikes; the weight is (inputs, outputs), transposed against torch's ``Linear``."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(inputs, outputs))
        self.bias = nn.Parameter(torch.empty(outputs))
        _uniform(self.weight, inputs, generator)
        _uniform(self.bias, inputs, generator)

    def forward(self, spikes: Tensor) -> Tensor:
        """See :func:`models.layers.spike_linear`."""
        return spike_linear(spikes, self.weight, self.bias)


class TactileSGNet(nn.Module):
    """Graph convolution, dense layers and a spike-count vote; every layer is one of LIF neurons [1]_.

    Parameters
    ----------
    architecture : Architecture
        Sizes.
    adjacency : (taxels, taxels) float64
        Normalised propagation matrix of the taxel graph.
    seed : int
        Of the initial weights: uniform within 1/sqrt(fan-in), as torch and torch_geometric draw them; the bias of
        the convolution starts at zero. The global random state is neither used nor moved.
    """

    def __init__(self, architecture: Architecture, adjacency: NDArray[np.float64], *, seed: int = 0) -> None:
        super().__init__()
        self.architecture = architecture
        generator = torch.Generator().manual_seed(seed)
        self.conv1 = TagConvolution(architecture.channels, architecture.features, architecture.hops, generator)
        sizes = (architecture.taxels * architecture.features, *architecture.hidden, architecture.classes)
        self.dense = tuple(f"fc{i}" for i in range(1, len(sizes)))
        for name, inputs, outputs in zip(self.dense, sizes[:-1], sizes[1:], strict=True):
            self.add_module(name, SpikeLinear(inputs, outputs, generator))
        self.adjacency: Tensor
        self.register_buffer("adjacency", torch.tensor(adjacency, dtype=torch.float32), persistent=False)

    def layers(self, events: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Spikes and membranes of every layer, each (steps, samples, neurons), for (steps, samples, taxels, channels).

        Neurons of ``conv1`` are taxel-major: ``taxel * features + feature``.
        """
        beta, theta = self.architecture.beta, self.architecture.theta
        found = {"conv1": lif(self.conv1(events, self.adjacency), beta, theta)}
        spikes = found["conv1"][0]
        for name in self.dense:
            found[name] = lif(self.get_submodule(name)(spikes), beta, theta)
            spikes = found[name][0]
        return found

    def forward(self, events: Tensor) -> Tensor:
        """Spikes per step of each output neuron, (samples, classes), for (steps, samples, taxels, channels)."""
        return self.layers(events)[self.dense[-1]][0].mean(0)

    def export_weights(self) -> Weights:
        """Copy of the weights."""
        state = {name: parameter.detach().cpu().numpy() for name, parameter in self.named_parameters()}
        return {name: (array.T if _turned(name) else array).copy(order="C") for name, array in state.items()}

    def load_weights(self, weights: Mapping[str, NDArray[np.float32]]) -> None:
        """Take over what `export_weights` returned."""
        self.load_state_dict({n: torch.tensor(array.T if _turned(n) else array) for n, array in weights.items()})


def _turned(name: str) -> bool:
    """Whether a weight lies transposed in this network."""
    return name.endswith(".weight")


def _uniform(weight: Tensor, fan_in: int, generator: torch.Generator) -> None:
    bound = 1 / math.sqrt(fan_in)
    with torch.no_grad():
        weight.uniform_(-bound, bound, generator=generator)
