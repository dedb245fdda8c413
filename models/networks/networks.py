"""Spiking networks for touch, computed layer by layer over all time steps; they differ in their first layer.

References
----------
.. [1] F. Gu et al., "TactileSGNet: A Spiking Graph Neural Network for Event-based Tactile Object Recognition",
   IROS 2020.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from spikeloom.compiler.dynamics import PLAIN, RELAY_WEIGHT, Clocks, Dynamics
from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET, feature_major, in_order
from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.models.networks.layers import (
    filter_places,
    lasting_current,
    lif,
    rates_of,
    spike_linear,
    tag_convolution,
)
from spikeloom.models.networks.surrogate import RECTANGLE, Surrogate
from spikeloom.models.systems import HOPS, filters_of

Weights = dict[str, NDArray[np.float32]]
"""Arrays by name: ``conv1.hops`` (filters, features, channels), ``conv1.bias``, then ``fc1.weight``
(outputs, inputs), ``fc1.bias`` and so on; see :mod:`compiler.systems`."""


class Affine(nn.Module):
    """Parameters of a layer, and the function that is called with them: the network may scale the weight first.

    They start uniform within 1/sqrt(fan-in), the bias at zero unless it is `biased`.
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        name: str,
        shape: tuple[int, ...],
        fan_in: float,
        generator: torch.Generator,
        *,
        biased: bool = True,
    ) -> None:
        super().__init__()
        self.function = function
        self.register_parameter(name, nn.Parameter(torch.empty(shape)))
        self.bias = nn.Parameter(torch.zeros(shape[1]))
        bound = 1 / math.sqrt(fan_in)
        with torch.no_grad():
            for parameter in (self.get_parameter(name), *([self.bias] if biased else [])):
                parameter.uniform_(-bound, bound, generator=generator)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Currents of the layer, from its inputs, weight and bias."""
        return self.function(*inputs)


class TrainedModule(nn.Module):
    """A network that :mod:`training.train` trains: events (steps, samples, taxels, channels) to rates of classes."""

    adjacency: Tensor

    def export_weights(self) -> Weights:
        """Weights as they are stored."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Sizes of a network that can be trained."""

    taxels: int  # Sensor points
    classes: int  # Outputs of the vote
    channels: int = 2  # Inputs per taxel (polarities)
    hops: int = HOPS  # K of the graph convolution of a TactileSGNet, which has K + 1 filters

    def network(self, propagation: FloatArray, *, seed: int, surrogate: Surrogate) -> TrainedModule:
        """An untrained network."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Architecture(Sizes):
    """Sizes and neuron constants of a `SpikingNet`; the defaults are those of [1]_."""

    features: int = 64  # Outputs of the first layer per place
    hidden: tuple[int, ...] = (128, 256)  # Neurons of each dense layer before the last
    beta: float = 0.2  # Membrane decay per step
    theta: float = 0.5  # Threshold of every neuron
    system: str = TACTILESGNET  # One of :data:`spikeloom.compiler.systems.SYSTEMS`
    dynamics: Dynamics = PLAIN  # Decays of single layers, and clocks

    def network(self, propagation: FloatArray, *, seed: int = 0, surrogate: Surrogate) -> SpikingNet:
        """An untrained network."""
        return SpikingNet(self, propagation, seed=seed, surrogate=surrogate)


class SpikingNet(TrainedModule):
    """A first layer, dense layers and a spike-count vote; every layer is one of LIF neurons [1]_.

    `propagation` is what the first layer sees, see :func:`systems.propagation_of`. The `seed` is that of the
    initial weights: uniform within 1/sqrt(fan-in), as torch and torch_geometric draw them; the bias of a
    graph convolution starts at zero. The global random state is neither used nor moved. The `surrogate` is
    the derivative of a spike.

    Neurons of the first layer lie place by place here; exported weights are in the order of the system. The
    relays of clocks come last.

    Where a layer's current outlasts its step, its parameters are ``W / (1 - alpha)``: a spike then brings as
    much in all as it would without, at the start and by each step of the optimizer. Exported weights are
    ``W``.
    """

    def __init__(
        self,
        architecture: Architecture,
        propagation: FloatArray,
        *,
        seed: int = 0,
        surrogate: Surrogate = RECTANGLE,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.surrogate = surrogate
        self.gains = tuple(1 - alpha for alpha in architecture.dynamics.alphas)
        self.places = propagation.shape[-2]
        generator = torch.Generator().manual_seed(seed)
        self.conv1 = _first_layer(architecture, generator)
        inputs = self.places * architecture.features + architecture.dynamics.clocks.channels
        sizes = (inputs, *architecture.hidden, architecture.classes)
        self.dense = tuple(f"fc{i}" for i in range(1, len(sizes)))
        for name, inputs, outputs in zip(self.dense, sizes[:-1], sizes[1:], strict=True):
            self.add_module(name, Affine(spike_linear, "weight", (inputs, outputs), inputs, generator))
        self.adjacency: Tensor
        self.register_buffer("adjacency", torch.tensor(propagation, dtype=torch.float32), persistent=False)

    def layers(self, events: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Spikes and membranes of every layer, each (steps, samples, neurons), for (steps, samples, taxels, channels).

        Neurons of ``conv1`` lie place by place, ``place * features + feature``, then come the relays of
        clocks.
        """
        clocks = self.architecture.dynamics.clocks
        spikes, membranes = self._integrate(0, self.conv1, events, self.adjacency)
        if clocks.channels:
            ticks = relay_spikes(clocks, spikes)
            spikes = torch.cat([spikes, ticks], dim=2)
            membranes = torch.cat([membranes, ticks * (RELAY_WEIGHT * self.architecture.theta)], dim=2)
        computed = {"conv1": (spikes, membranes)}
        for index, name in enumerate(self.dense, 1):
            computed[name] = self._integrate(index, self.get_submodule(name), spikes)
            spikes = computed[name][0]
        return computed

    def _integrate(self, index: int, layer: nn.Module, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Spikes and membranes of one layer; its bias goes past a current that outlasts its step."""
        dynamics = self.architecture.dynamics
        alpha = dynamics.alpha(index)
        bias = layer.get_parameter("bias")
        (weight,) = (values for name, values in layer.named_parameters() if name != "bias")
        if alpha:
            current = lasting_current(
                layer(*inputs, self._scaled(index, weight), torch.zeros_like(bias)), alpha
            )
            current = current + bias.repeat(current.shape[-1] // len(bias))
        else:
            current = layer(*inputs, weight, bias)
        return lif(
            current, dynamics.beta(index, self.architecture.beta), self.architecture.theta, self.surrogate
        )

    def _scaled(self, index: int, weight: Tensor) -> Tensor:
        """Weight of a layer from its parameter."""
        return weight * self.gains[index] if self.gains and self.gains[index] != 1 else weight

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each output neuron, (samples, classes), for (steps, samples, taxels, channels).

        `lengths` (samples,) has the steps of each recording, where some were filled up with silence.
        """
        return self.rates(self.layers(events), lengths)

    def rates(self, layers: Mapping[str, tuple[Tensor, Tensor]], lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each output neuron, from what `layers` returned."""
        return rates_of(layers[self.dense[-1]][0], lengths)

    def activity(self, layers: Mapping[str, tuple[Tensor, Tensor]], lengths: Tensor | None = None) -> Tensor:
        """Share of the synapses behind neurons that carry a spike, mean over steps and samples; one number."""
        used = torch.zeros(())
        there = 0
        for source, layer in zip(layers, self.dense, strict=False):
            inputs, outputs = self.get_submodule(layer).get_parameter("weight").shape
            spikes = layers[source][0]
            share = spikes.mean() if lengths is None else rates_of(spikes, lengths).mean()
            used = used + share * (inputs * outputs)
            there += inputs * outputs
        return used / there

    def export_weights(self) -> Weights:
        """Copy of the weights."""
        state = {name: p.detach() for name, p in self.named_parameters()}
        for index, layer in enumerate(("conv1", *self.dense)):
            state |= {
                n: self._scaled(index, p)
                for n, p in state.items()
                if n.startswith(f"{layer}.") and "bias" not in n
            }
        arrays = {name: p.numpy() for name, p in state.items()}
        weights = {name: (array.T if name.endswith(".weight") else array) for name, array in arrays.items()}
        if self.architecture.system == MLP:
            weight = weights.pop("conv1.weight")
            hops = weight.reshape(len(weight), self.architecture.taxels, -1).swapaxes(0, 1)
            weights = {"conv1.hops": hops} | weights
        if feature_major(self.architecture.system):
            weights["fc1.weight"] = weights["fc1.weight"][:, self._order()]
        return {name: array.copy(order="C") for name, array in weights.items()}

    def _order(self) -> IntArray:
        """Neuron of ours that is the first, second … one in the order of the system."""
        features = self.architecture.features
        clocks = self.architecture.dynamics.clocks.channels
        order = np.arange(self.places * features).reshape(self.places, features)
        return np.append(
            in_order(self.architecture.system, order), np.arange(order.size, order.size + clocks)
        )


def relay_spikes(clocks: Clocks, like: Tensor) -> Tensor:
    """Spikes of the relays, (steps, samples, clocks), for other spikes of the first layer."""
    steps, samples, _ = like.shape
    ticks = torch.from_numpy(clocks.events(steps).T.copy()).to(like)
    return ticks[:, None].expand(steps, samples, clocks.channels)


def _first_layer(architecture: Architecture, generator: torch.Generator) -> Affine:
    """As the layers of those names start in torch and torch_geometric; a GCN with Glorot's weights and no bias."""
    channels = architecture.channels
    features = architecture.features
    system = architecture.system
    if system == MLP:  # a weight for each input, which are few and spikes
        inputs = architecture.taxels * channels
        return Affine(_over_all_taxels, "weight", (inputs, features), inputs, generator)
    filters = filters_of(system, architecture.taxels, architecture.hops)
    shape = (filters, features, channels)
    if system == TACTILESGNET:
        return Affine(tag_convolution, "hops", shape, channels, generator, biased=False)
    if system == GCN:
        return Affine(filter_places, "hops", shape, (channels + features) / 6, generator, biased=False)
    assert system == GRID_CNN, "systems are checked where they are named"
    return Affine(filter_places, "hops", shape, filters * channels, generator)


def _over_all_taxels(x: Tensor, _propagation: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return spike_linear(x.flatten(2), weight, bias)
