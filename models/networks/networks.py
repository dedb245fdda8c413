"""Spiking networks for touch, computed layer by layer over all time steps; they differ in their first layer.

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

from spikeloom.compiler.dynamics import PLAIN, RELAY_WEIGHT, Clocks, Dynamics
from spikeloom.compiler.systems import GCN, GRID_CNN, MLP, TACTILESGNET, feature_major, in_order
from spikeloom.models.networks.currents import lasting_current
from spikeloom.models.networks.layers import filter_places, lif, spike_linear, tag_convolution
from spikeloom.models.networks.surrogate import RECTANGLE, Surrogate
from spikeloom.models.systems import HOPS, filters_of

Weights = dict[str, NDArray[np.float32]]
"""Arrays by name: ``conv1.hops`` (filters, features, channels), ``conv1.bias``, then ``fc1.weight`` (outputs, inputs),
``fc1.bias`` and so on; see :mod:`compiler.systems`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Architecture:
    """Sizes and neuron constants of a `SpikingNet`; the defaults are those of [1]_."""

    # taxels, classes: Sensor points and output neurons
    taxels: int
    classes: int
    channels: int = 2  # Inputs per taxel (polarities)
    hops: int = HOPS  # K of the graph convolution of a TactileSGNet, which has K + 1 filters
    features: int = 64  # Outputs of the first layer per place
    hidden: tuple[int, ...] = (128, 256)  # Neurons of each dense layer before the last
    # beta, theta: Membrane decay per step and firing threshold of every neuron
    beta: float = 0.2
    theta: float = 0.5
    system: str = TACTILESGNET  # One of :data:`spikeloom.compiler.systems.SYSTEMS`
    dynamics: Dynamics = PLAIN  # Decays of single layers, and clocks

    def network(self, propagation: NDArray[np.float64], *, seed: int = 0, surrogate: Surrogate) -> SpikingNet:
        """An untrained network."""
        return SpikingNet(self, propagation, seed=seed, surrogate=surrogate)


class TagConvolution(nn.Module):
    """K-hop graph convolution with filters (K + 1, features, channels).

    As all layers here it holds its parameters, and is called with them: the network may scale them first.
    """

    def __init__(self, channels: int, features: int, hops: int, generator: torch.Generator) -> None:
        super().__init__()
        self.hops = nn.Parameter(torch.empty(hops + 1, features, channels))
        self.bias = nn.Parameter(torch.zeros(features))
        _uniform(self.hops, channels, generator)

    def forward(self, x: Tensor, adjacency: Tensor, hops: Tensor, bias: Tensor) -> Tensor:
        """See :func:`layers.tag_convolution`."""
        return tag_convolution(x, adjacency, hops, bias)


class PlaceFilters(nn.Module):
    """Filters (filters, features, channels) over what each place sees: the first layer of a GCN or a grid-based CNN.

    Starts as the layers of those names start in torch_geometric and torch: Glorot's uniform weights and no bias, or
    weights and bias within 1/sqrt(fan-in).
    """

    def __init__(self, filters: int, channels: int, features: int, system: str, generator: torch.Generator) -> None:
        super().__init__()
        self.hops = nn.Parameter(torch.empty(filters, features, channels))
        self.bias = nn.Parameter(torch.zeros(features))
        if system == GCN:
            _uniform(self.hops, (channels + features) / 6, generator)
        else:
            _uniform(self.hops, filters * channels, generator)
            _uniform(self.bias, filters * channels, generator)

    def forward(self, x: Tensor, propagation: Tensor, hops: Tensor, bias: Tensor) -> Tensor:
        """See :func:`layers.filter_places`."""
        return filter_places(x, propagation, hops, bias)


class TaxelWeights(nn.Module):
    """The first layer of an MLP: a weight (taxels * channels, features) for each input, which are few and spikes."""

    def __init__(self, inputs: int, features: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(inputs, features))
        self.bias = nn.Parameter(torch.empty(features))
        _uniform(self.weight, inputs, generator)
        _uniform(self.bias, inputs, generator)

    def forward(self, x: Tensor, _propagation: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """See :func:`layers.spike_linear`."""
        return spike_linear(x.flatten(2), weight, bias)


class SpikeLinear(nn.Module):
    """Affine layer over spikes; the weight is (inputs, outputs), transposed against torch's ``Linear``."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(inputs, outputs))
        self.bias = nn.Parameter(torch.empty(outputs))
        _uniform(self.weight, inputs, generator)
        _uniform(self.bias, inputs, generator)

    def forward(self, spikes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """See :func:`layers.spike_linear`."""
        return spike_linear(spikes, weight, bias)


class TrainedModule(nn.Module):
    """A network that :mod:`training.train` trains: events (steps, samples, taxels, channels) to rates of classes."""

    adjacency: Tensor

    def export_weights(self) -> Weights:
        """Weights as they are stored."""
        raise NotImplementedError


class SpikingNet(TrainedModule):
    """A first layer, dense layers and a spike-count vote; every layer is one of LIF neurons [1]_.

    Parameters
    ----------
    architecture : Architecture
        Sizes.
    propagation : (taxels, taxels) or (filters, places, taxels) float64
        What the first layer sees, see :func:`systems.propagation_of`.
    seed : int
        Of the initial weights: uniform within 1/sqrt(fan-in), as torch and torch_geometric draw them; the bias of
        a graph convolution starts at zero. The global random state is neither used nor moved.
    surrogate : Surrogate
        Derivative of a spike.

    Notes
    -----
    Neurons of the first layer lie place by place here; exported weights are in the order of the system. The relays of
    clocks come last.

    Where a layer's current outlasts its step, its parameters are ``W / (1 - alpha)``: a spike then brings as much in
    all as it would without, at the start and by each step of the optimizer. Exported weights are ``W``.
    """

    def __init__(
        self,
        architecture: Architecture,
        propagation: NDArray[np.float64],
        *,
        seed: int = 0,
        surrogate: Surrogate = RECTANGLE,
    ) -> None:
        super().__init__()
        self.architecture, self.surrogate = architecture, surrogate
        self.gains = tuple(1 - alpha for alpha in architecture.dynamics.alphas)
        self.places = propagation.shape[-2]
        generator = torch.Generator().manual_seed(seed)
        self.conv1 = _first_layer(architecture, generator)
        inputs = self.places * architecture.features + architecture.dynamics.clocks.channels
        sizes = (inputs, *architecture.hidden, architecture.classes)
        self.dense = tuple(f"fc{i}" for i in range(1, len(sizes)))
        for name, inputs, outputs in zip(self.dense, sizes[:-1], sizes[1:], strict=True):
            self.add_module(name, SpikeLinear(inputs, outputs, generator))
        self.adjacency: Tensor
        self.register_buffer("adjacency", torch.tensor(propagation, dtype=torch.float32), persistent=False)

    def layers(self, events: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Spikes and membranes of every layer, each (steps, samples, neurons), for (steps, samples, taxels, channels).

        Neurons of ``conv1`` lie place by place, ``place * features + feature``, then come the relays of clocks.
        """
        clocks = self.architecture.dynamics.clocks
        spikes, membranes = self._integrate(0, self.conv1, events, self.adjacency)
        if clocks.channels:
            ticks = relayed(clocks, spikes)
            spikes = torch.cat([spikes, ticks], dim=2)
            membranes = torch.cat([membranes, ticks * (RELAY_WEIGHT * self.architecture.theta)], dim=2)
        found = {"conv1": (spikes, membranes)}
        for index, name in enumerate(self.dense, 1):
            found[name] = self._integrate(index, self.get_submodule(name), spikes)
            spikes = found[name][0]
        return found

    def _integrate(self, index: int, layer: nn.Module, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Spikes and membranes of one layer; its bias goes past a current that outlasts its step."""
        dynamics = self.architecture.dynamics
        alpha, bias = dynamics.alpha(index), layer.get_parameter("bias")
        (weight,) = (values for name, values in layer.named_parameters() if name != "bias")
        if alpha:
            current = lasting_current(layer(*inputs, self._scaled(index, weight), torch.zeros_like(bias)), alpha)
            current = current + bias.repeat(current.shape[-1] // len(bias))
        else:
            current = layer(*inputs, weight, bias)
        return lif(current, dynamics.beta(index, self.architecture.beta), self.architecture.theta, self.surrogate)

    def _scaled(self, index: int, weight: Tensor) -> Tensor:
        """Weight of a layer from its parameter."""
        return weight * self.gains[index] if self.gains and self.gains[index] != 1 else weight

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each output neuron, (samples, classes), for (steps, samples, taxels, channels).

        Parameters
        ----------
        lengths : (samples,) int64, optional
            Steps of each recording, where some were filled up with silence.
        """
        return self.rates(self.layers(events), lengths)

    def rates(self, layers: Mapping[str, tuple[Tensor, Tensor]], lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each output neuron, from what `layers` returned."""
        return _rates(layers[self.dense[-1]][0], lengths)

    def activity(self, layers: Mapping[str, tuple[Tensor, Tensor]], lengths: Tensor | None = None) -> Tensor:
        """Share of the synapses behind neurons that carry a spike, mean over steps and samples; one number."""
        used, there = torch.zeros(()), 0
        for source, layer in zip(layers, self.dense, strict=False):
            inputs, outputs = self.get_submodule(layer).get_parameter("weight").shape
            spikes = layers[source][0]
            share = spikes.mean() if lengths is None else _rates(spikes, lengths).mean()
            used = used + share.cpu() * (inputs * outputs)
            there += inputs * outputs
        return used / there

    def export_weights(self) -> Weights:
        """Copy of the weights."""
        state = {name: p.detach() for name, p in self.named_parameters()}
        for index, layer in enumerate(("conv1", *self.dense)):
            state |= {
                n: self._scaled(index, p) for n, p in state.items() if n.startswith(f"{layer}.") and "bias" not in n
            }
        arrays = {name: p.cpu().numpy() for name, p in state.items()}
        found = {name: (array.T if _turned(name) else array) for name, array in arrays.items()}
        if self.architecture.system == MLP:
            weight = found.pop("conv1.weight")
            found = {"conv1.hops": weight.reshape(len(weight), self.architecture.taxels, -1).swapaxes(0, 1)} | found
        if feature_major(self.architecture.system):
            found["fc1.weight"] = found["fc1.weight"][:, self._order()]
        return {name: array.copy(order="C") for name, array in found.items()}

    def load_weights(self, weights: Mapping[str, NDArray[np.float32]]) -> None:
        """Take over what `export_weights` returned, as it is: the parameters are the weights from now on."""
        self.gains = ()
        given = dict(weights)
        if self.architecture.system == MLP:
            hops = given.pop("conv1.hops")
            given["conv1.weight"] = hops.swapaxes(0, 1).reshape(hops.shape[1], -1)
        if feature_major(self.architecture.system):
            given["fc1.weight"] = given["fc1.weight"][:, np.argsort(self._order())]
        self.load_state_dict({n: torch.tensor(array.T if _turned(n) else array) for n, array in given.items()})

    def _order(self) -> NDArray[np.int64]:
        """Neuron of ours that is the first, second … one in the order of the system."""
        features, clocks = self.architecture.features, self.architecture.dynamics.clocks.channels
        own = np.arange(self.places * features).reshape(self.places, features)
        return np.append(in_order(self.architecture.system, own), np.arange(own.size, own.size + clocks))


def relayed(clocks: Clocks, like: Tensor) -> Tensor:
    """Spikes of the relays, (steps, samples, clocks), for other spikes of the first layer."""
    steps, samples, _ = like.shape
    ticks = torch.from_numpy(clocks.events(steps).T.copy()).to(like)
    return ticks[:, None].expand(steps, samples, clocks.channels)


def _rates(spikes: Tensor, lengths: Tensor | None) -> Tensor:
    """Spikes per step of (steps, samples, neurons), without the steps that were filled up."""
    if lengths is None:
        return spikes.mean(0)
    inside = torch.arange(len(spikes), device=spikes.device)[:, None] < lengths
    return torch.sum(spikes * inside[..., None], dim=0) / lengths[:, None]


def _first_layer(architecture: Architecture, generator: torch.Generator) -> nn.Module:
    channels, features, system = architecture.channels, architecture.features, architecture.system
    match system:
        case "tactilesgnet":
            return TagConvolution(channels, features, architecture.hops, generator)
        case "mlp":
            return TaxelWeights(architecture.taxels * channels, features, generator)
    assert system in (GCN, GRID_CNN), "systems are checked where they are named"
    return PlaceFilters(
        filters_of(system, architecture.taxels, architecture.hops), channels, features, system, generator
    )


def _turned(name: str) -> bool:
    """Whether a weight lies transposed in this network."""
    return name.endswith(".weight")


def _uniform(weight: Tensor, fan_in: float, generator: torch.Generator) -> None:
    bound = 1 / math.sqrt(fan_in)
    with torch.no_grad():
        weight.uniform_(-bound, bound, generator=generator)
