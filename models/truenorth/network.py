"""A TactileSGNet that TrueNorth holds: whole weights of few levels, blocks of few inputs, neurons that only add.

The graph convolution sees the sensor as ever: its filters are shared by all taxels, and expanded to a weight
for each channel and neuron. Its features are dealt to groups, so that every group of the first dense layer
sees the whole skin in a few of them; each group of the second receives a share of every group of the first;
the output neurons vote, several for each class in every group. The dense layers receive the clocks, which
the chip gives them from outside.

What the chip rounds is rounded in every pass, and the gradient goes past the rounding as if it were not
there: what is trained is what the chip computes, :class:`native.NativeNetwork`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.formats.sensor_layout import POLARITIES
from spikeloom.compiler.targets.base import load_target
from spikeloom.compiler.targets.truenorth.native import (
    LEAK_MOST,
    THRESHOLD_MOST,
    UNIT,
    NativeNetwork,
    Stage,
    highest_level,
)
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.models.networks.layers import time_first
from spikeloom.models.networks.networks import Sizes, TrainedModule
from spikeloom.models.networks.surrogate import RECTANGLE, Surrogate
from spikeloom.models.truenorth.neurons import block_sums, integrate

CONV_GAIN = 4.0
GAIN = 2.7
"""Initial weights lie within this over the root of a neuron's inputs (of one taxel's channels in the
convolution), thresholds being 1: membranes that only add reach them every ten to twenty steps."""

LEAST_THRESHOLD = 8
"""Smallest threshold: a smaller one leaves no room for weights and drifts in whole numbers."""

SPREADS = {2: 1.53, 3: 0.8, 4: 0.42}
"""Distance of two levels, in mean magnitudes of a neuron's weights, which rounds a normal distribution best [1]_.

References
----------
.. [1] J. Max, "Quantizing for Minimum Distortion", IRE Transactions on Information Theory 6(1), 1960: uniform
   quantisers with 3, 7 and 15 levels.
"""

Arrays = dict[str, NDArray[np.float32]]

VECTORS = ("threshold", "floor", "leak")
"""What each neuron of a layer has, beside its levels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NativeArchitecture(Sizes):
    """Sizes of a `NativeNet`."""

    features: int = 16  # Of the convolution, per taxel; a multiple of `groups`
    groups: int = 8  # Blocks of each dense layer
    hidden: tuple[int, ...] = (80, 80)  # Neurons of each group before the last layer; multiples of `groups`
    voters: int = 2  # Output neurons of a class in each group
    copies: int = 3  # Axons of an input, see :mod:`truenorth.native`
    clocks: Clocks = NO_CLOCKS  # That the dense layers receive

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers."""
        return ("conv1", *(f"fc{i}" for i in range(1, len(self.hidden) + 2)))

    def inputs(self) -> list[IntArray]:
        """Neurons from which each group of the dense layers receives, (groups, inputs of a group) for each layer."""
        widths = (self.taxels * self.features, *(self.groups * size for size in self.hidden))
        rows = (self.taxels, *[self.groups] * len(self.hidden))
        return [
            np.arange(width).reshape(row, self.groups, -1).swapaxes(0, 1).reshape(self.groups, -1)
            for width, row in zip(widths, rows, strict=True)
        ]

    def network(self, propagation: FloatArray, *, seed: int = 0, surrogate: Surrogate) -> NativeNet:
        """An untrained network."""
        return NativeNet(self, propagation, seed=seed, surrogate=surrogate)


def size_network(
    *, taxels: int, classes: int, hops: int, features: int, copies: int, clocks: Clocks
) -> NativeArchitecture:
    """The architecture whose groups fill the axons of a core best, as few as can be; OptionError if none fit."""
    axons = load_target("truenorth").limit("core.axons")
    room = axons // copies
    channels = taxels * POLARITIES
    if channels > room:
        raise OptionError(
            f"--copies {copies}: {channels} input channels with {copies} axons each, a core of TrueNorth has "
            f"{axons}; give fewer copies, or a smaller sensor"
        )
    width = room - clocks.channels
    fitting = [g for g in range(1, features + 1) if not features % g and taxels * features // g <= width]
    if not fitting or width < fitting[0]:
        raise OptionError(
            f"--features {features}: no number of groups deals {features} features of {taxels} taxels and "
            f"{clocks.channels} clocks to cores of {room} inputs; give other --features, or fewer --clocks or --copies"
        )
    groups = fitting[0]
    size = width // groups * groups
    return NativeArchitecture(
        taxels=taxels,
        classes=classes,
        hops=hops,
        features=features,
        groups=groups,
        hidden=(size, size),
        copies=copies,
        clocks=clocks,
    )


class NativeNet(TrainedModule):
    """See the module docstring; neurons of the convolution lie taxel by taxel, of the others group by group.

    `propagation` (taxels, taxels) is the normalised adjacency; the `seed` is that of the initial weights:
    the global random state is neither used nor moved. The width of the surrogate, the derivative of a spike,
    is in thresholds.
    """

    def __init__(
        self,
        architecture: NativeArchitecture,
        propagation: FloatArray,
        *,
        seed: int = 0,
        surrogate: Surrogate = RECTANGLE,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.surrogate = surrogate
        generator = torch.Generator().manual_seed(seed)
        powers = np.stack([np.linalg.matrix_power(propagation, k) for k in range(architecture.hops + 1)])
        self.adjacency: Tensor
        self.register_buffer("adjacency", torch.tensor(powers, dtype=torch.float32), persistent=False)
        shape = (architecture.hops + 1, architecture.features, architecture.channels)
        self.hops = nn.Parameter(_uniform(shape, CONV_GAIN / math.sqrt(architecture.channels), generator))
        self.bias = nn.Parameter(torch.zeros(architecture.features))
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        clocks = architecture.clocks.channels
        sizes = (*architecture.hidden, architecture.voters * architecture.classes)
        self.inputs = architecture.inputs()
        for inputs, size in zip(self.inputs, sizes, strict=True):
            groups, width = inputs.shape
            weight = _uniform((groups, width + clocks, size), GAIN / math.sqrt(width), generator)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(groups, size)))

    def rounded(self) -> list[Rounded]:
        """Every layer as the chip holds it."""
        architecture = self.architecture
        dense = torch.einsum("kqp,kfc->pcqf", self.adjacency, self.hops)
        dense = dense.reshape(1, architecture.taxels * architecture.channels, -1)
        most = highest_level(architecture.copies)
        # the weights of a filter over the graph differ by orders of magnitude: the largest decides
        step = dense.detach().abs().amax(1, keepdim=True) / (most + 0.5)
        layers = [self._round(dense, self.bias.repeat(architecture.taxels), 0, step)]
        for depth, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True), 1):
            step = SPREADS[architecture.copies] * weight.detach().abs().mean(1, keepdim=True)
            layers.append(self._round(weight, bias.reshape(-1), depth, step))
        return layers

    def _round(self, weight: Tensor, bias: Tensor, depth: int, step: Tensor) -> Rounded:
        """Whole numbers for weights (blocks, inputs, size), whose levels shall be a `step` (blocks, 1, size) apart."""
        with torch.no_grad():
            threshold = torch.clamp(torch.round(UNIT / step), LEAST_THRESHOLD, THRESHOLD_MOST)
            most = highest_level(self.architecture.copies)
            level = torch.clamp(torch.round(weight * (threshold / UNIT)), -most, most)
            flat = threshold.reshape(-1)
            reach = torch.clamp(torch.floor((flat - 1) / max(1, depth - 1)), max=LEAK_MOST)
            leak = torch.maximum(torch.minimum(torch.round(bias * flat), reach), -reach)
        return Rounded(
            weight=_past(weight * threshold, level * UNIT),
            leak=_past(bias * flat, leak),
            threshold=flat,
            floor=flat,
        )

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Votes per step and output neuron for each class, (samples, classes), for (steps, samples, taxels, channels).

        `lengths` (samples,) are the steps of each recording, where some were filled up with silence.
        """
        architecture = self.architecture
        *_, spikes = run_layers(self.rounded(), self.inputs, architecture.clocks, events, self.surrogate)
        steps, samples, _ = spikes.shape
        cast = spikes.view(steps, samples, -1, architecture.classes)
        if lengths is not None:
            cast = cast * (torch.arange(steps)[:, None] < lengths)[..., None, None]
        votes = cast.sum((0, 2))  # divided once and last, so that equal votes stay equal
        return votes / (cast.shape[2] * (steps if lengths is None else lengths[:, None]))

    def export_weights(self) -> Arrays:
        """Whole numbers of every layer: ``level``, ``threshold``, ``floor`` and ``leak`` after the layer's name."""
        arrays: Arrays = {}
        with torch.no_grad():
            for name, layer in zip(self.architecture.layers, self.rounded(), strict=True):
                whole = {"level": layer.weight / UNIT} | {each: getattr(layer, each) for each in VECTORS}
                arrays |= {f"{name}.{what}": np.round(values.numpy()) for what, values in whole.items()}
        return arrays


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rounded:
    """A layer as the chip holds it, in float32 that holds whole numbers."""

    weight: Tensor  # (blocks, inputs, size); multiples of ``UNIT``
    # leak, threshold, floor: (blocks * size,)
    leak: Tensor
    threshold: Tensor
    floor: Tensor


def run_layers(
    layers: Sequence[Rounded],
    inputs: Sequence[IntArray],
    clocks: Clocks,
    events: Tensor,
    surrogate: Surrogate = RECTANGLE,
) -> list[Tensor]:
    """Spikes of every layer, each (steps, samples, neurons), for (steps, samples, taxels, channels).

    The first of the layers receives the sensor in one block; `inputs` (blocks, width) are what each block of
    the others receives from the layer before.
    """
    steps, samples = events.shape[:2]
    ticks = torch.from_numpy(clocks.events(steps).T.astype(np.float32))
    spikes = _spikes(layers[0], block_sums(events.reshape(steps, samples, -1), layers[0].weight), surrogate)
    layers_spikes = [spikes]
    for layer, received in zip(layers[1:], inputs, strict=True):
        width = received.shape[1]
        sums = block_sums(
            spikes.index_select(2, torch.tensor(received.reshape(-1))), layer.weight[:, :width]
        )
        if layer.weight.shape[1] > width:
            timed = torch.matmul(ticks, layer.weight[:, width:])
            sums = sums + timed.transpose(0, 1).reshape(steps, 1, -1)
        spikes = _spikes(layer, sums, surrogate)
        layers_spikes.append(spikes)
    return layers_spikes


def _spikes(layer: Rounded, sums: Tensor, surrogate: Surrogate) -> Tensor:
    return integrate(sums + layer.leak, layer.threshold, layer.floor, surrogate)


def native_network(
    architecture: NativeArchitecture, arrays: Mapping[str, NDArray[np.float32]]
) -> NativeNetwork:
    """Network from what `NativeNet.export_weights` returned."""
    channels = np.arange(architecture.taxels * architecture.channels)[None]
    return NativeNetwork(
        taxels=architecture.taxels,
        polarities=architecture.channels,
        classes=architecture.classes,
        copies=architecture.copies,
        clocks=architecture.clocks,
        stages=tuple(
            Stage(
                name=name,
                inputs=inputs,
                **{n: arrays[f"{name}.{n}"].astype(np.int64) for n in ("level", *VECTORS)},
            )
            for name, inputs in zip(architecture.layers, [channels, *architecture.inputs()], strict=True)
        ),
    )


def votes_by_step(network: NativeNetwork, events: EventArray) -> IntArray:
    """Votes (steps, classes) in one recording (1, taxels, polarities, steps)."""
    spikes = run_network(network, events)[network.stages[-1].name][0]
    return np.asarray(spikes.reshape(len(spikes), -1, network.classes).sum(axis=1))


def run_network(network: NativeNetwork, events: EventArray) -> dict[str, BoolArray]:
    """Spikes of every layer (samples, steps, neurons), as the model computes them in training.

    `events` are (samples, taxels, polarities, steps) uint8.
    """
    layers = [
        Rounded(
            weight=torch.from_numpy((stage.level * UNIT).astype(np.float32)),
            **{name: torch.tensor(getattr(stage, name), dtype=torch.float32) for name in VECTORS},
        )
        for stage in network.stages
    ]
    with torch.no_grad():
        computed = run_layers(
            layers, [stage.inputs for stage in network.stages[1:]], network.clocks, time_first(events)
        )
    pairs = zip(network.stages, computed, strict=True)
    return {stage.name: spikes.numpy().astype(np.bool_).swapaxes(0, 1) for stage, spikes in pairs}


def _past(real: Tensor, whole: Tensor) -> Tensor:
    """The whole numbers, to the bit, with the gradient of the real ones."""
    return whole.detach() + (real - real.detach())


def _uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator) -> Tensor:
    return torch.empty(shape).uniform_(-bound, bound, generator=generator)
