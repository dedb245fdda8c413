"""The network on the chip's own integers, as a torch model with gradients: what it computes is what the chip computes.

Weights, biases and thresholds are rounded by the compiler's own rounding, see :mod:`registers`; layers
compute as :mod:`chip_layer` says.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from spikeloom.compiler import ir
from spikeloom.compiler.targets.compartments import IntegerNetwork, fullest, registers, round_population
from spikeloom.compiler.types import EventArray
from spikeloom.models.networks.chip_layer import ChipLayer, Integers
from spikeloom.models.networks.layers import rates_of, time_first
from spikeloom.models.networks.learned import Filters, Learned, Stage, Synapses
from spikeloom.models.networks.networks import Weights
from spikeloom.models.networks.surrogate import RECTANGLE, Surrogate
from spikeloom.models.networks.towers import by_tower

THETA = 0.5
"""Threshold that a network is brought to if it has another: what the surrogate and the learning rate are made for."""

RELAY = 100
"""Threshold of a layer of relays alone, in weight units: NIR holds what makes them fire as a bias, which must fit."""


class QuantisedNet(nn.Module):
    """A network on chip integers; `forms` say how the chip stores each layer.

    Where the first layer has shared filters, these are learned, of everything else each synapse by itself.
    ModelError if a layer is too large for one matrix.
    """

    def __init__(
        self, network: ir.Network, forms: Sequence[ir.Form], surrogate: Surrogate = RECTANGLE
    ) -> None:
        super().__init__()
        self.surrogate = surrogate
        self.network = in_thresholds(network) if network.convolution is None else network
        populations = self.network.populations
        self.names = tuple(population.name for population in populations)
        self.forms = tuple(
            replace(form, exponents=(0,), threshold=np.full(each.size, RELAY))
            if each.relays == each.size
            else form
            for each, form in zip(populations, forms, strict=True)
        )
        stages = [Stage(self.network, post, form) for post, form in enumerate(self.forms)]
        layers: list[Learned] = [Synapses(stage) for stage in stages]
        if network.convolution is not None:
            layers[0] = Filters(stages[0], network.convolution)
        self.learned: tuple[Learned, ...] = tuple(layers)
        self.layers = nn.ModuleList(layers)
        self.integers: tuple[Integers, ...] = ()
        self.round()

    def start_at(self, integer: IntegerNetwork) -> None:
        """Move weights and biases to where they round to an integer network of these forms, no farther."""
        with torch.no_grad():
            for layer in self.learned:
                layer.start_at(integer)
        self.round()

    def expanded(self) -> ir.Network:
        """The network with its present weights and biases, thresholds as of :func:`in_thresholds`."""
        populations = []
        projections = []
        for layer in self.learned:
            stage = layer.stage
            weight, bias = (each.detach().numpy() for each in with_relays(layer))
            populations.append(replace(stage.population, bias=bias))
            whole = sparse.csr_array((weight, (stage.row, stage.column)), shape=stage.shape)
            first = 0
            for pre in stage.sources:
                size = self.network.input.size if pre == ir.INPUT else self.network.populations[pre].size
                projections.append(
                    ir.Projection(pre=pre, post=stage.post, weight=whole[:, first : first + size])
                )
                first += size
        changed = replace(self.network, populations=tuple(populations), projections=tuple(projections))
        return replace(changed, convolution=None)

    def tensors(self) -> Weights:
        """Weights and biases as a checkpoint holds them."""
        weights: dict[str, Tensor] = {}
        for name, layer in zip(self.names, self.learned, strict=True):
            weight, bias = layer.tensors()
            what = "hops" if isinstance(layer, Filters) else "weight"
            weights |= {f"{name}.{what}": weight, f"{name}.bias": bias}
        return {name: parameter.detach().numpy().copy() for name, parameter in weights.items()}

    def round(self) -> None:
        """Round all weights, after every change of them; `make_legal` sees that every bias has a register value."""
        self.integers = tuple(map(_rounded, self.learned))

    def clip_weights(self) -> None:
        """Keep single weights within half a step of what their storage holds, so that none gets lost."""
        with torch.no_grad():
            for layer in self.learned:
                layer.clip()

    def make_legal(self) -> None:
        """Shrink weights and biases until no accumulator can overflow and every bias has a register value; round."""
        most = registers.BIAS_MANTISSA_MAX << registers.BIAS_EXPONENT_MAX
        with torch.no_grad():
            for layer in self.learned:
                layer.clip_bias(most / layer.stage.membrane_scale)
            self.round()
            while any((integers.full > registers.ONE_STEP_SUM_MAX).any() for integers in self.integers):
                for layer, integers in zip(self.learned, self.integers, strict=True):
                    layer.shrink(integers.full > registers.ONE_STEP_SUM_MAX)
                self.round()

    def spikes_of(self, events: Tensor) -> list[Tensor]:
        """Spikes of every layer, (steps, samples, neurons), for events (steps, samples, taxels, channels)."""
        clocks = self.network.input.clocks
        inputs = events.flatten(2)
        if clocks.channels:
            ticks = torch.tensor(clocks.events(len(inputs)), dtype=torch.float32).t()[:, None]
            inputs = torch.cat([inputs, ticks.expand(-1, inputs.shape[1], -1)], dim=2)
        spikes: list[Tensor] = []
        for layer, integers in zip(self.learned, self.integers, strict=True):
            stage = layer.stage
            sources = [
                inputs if pre == ir.INPUT else spikes[pre] for pre in stage.sources if pre != stage.post
            ]
            received = sources[0] if len(sources) == 1 else torch.cat(sources, dim=2)
            fired: Tensor = ChipLayer.apply(  # type: ignore[no-untyped-call]
                received, *with_relays(layer), integers, self.surrogate
            )
            spikes.append(fired)
        return spikes

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each class, (samples, classes), for events (steps, samples, taxels, channels).

        `lengths` (samples,) has the steps of each recording, where some were filled up with silence.
        """
        readout = self.network.readout
        rates = rates_of(self.spikes_of(events)[readout.population], lengths)
        votes = rates.new_zeros(len(rates), self.network.classes)
        return votes.index_add(1, torch.tensor(readout.label), rates)


def with_relays(layer: Learned) -> tuple[Tensor, Tensor]:
    """Weights of a layer's synapses and biases of its neurons in float64, those of the relays of clocks last."""
    weight, bias = layer.values()
    relays = layer.stage.population.relays
    if not relays:
        return weight, bias
    return torch.cat([weight, layer.stage.relays]), torch.cat([bias, bias.new_zeros(relays)])


def _rounded(layer: Learned) -> Integers:
    """A layer in the integers of the chip."""
    stage = layer.stage
    form = stage.form
    weight, bias = (each.detach().numpy() for each in with_relays(layer))
    population, _ = round_population(stage.population, (), form, bias=bias)
    steps = registers.round_steps(weight, stage.scale[stage.row], form.bits, form.exponents)
    units = np.zeros(stage.shape[::-1], np.float32)
    units[stage.column, stage.row] = steps * stage.step
    real = np.ascontiguousarray((units / stage.scale.astype(np.float32)).T)
    full = fullest(population, *stage.one_sided(steps))
    return Integers(stage=stage, units=units, real=real, population=population, full=full)


def in_thresholds(network: ir.Network) -> ir.Network:
    """The network with weights and biases in units in which every threshold is ``THETA``."""
    factors = [THETA / population.theta for population in network.populations]
    pairs = zip(network.populations, factors, strict=True)
    populations = tuple(replace(each, theta=THETA, bias=each.bias * factor) for each, factor in pairs)
    weights = [ir.with_data(p.weight, p.weight.data * factors[p.post]) for p in network.projections]
    projections = (replace(p, weight=weight) for p, weight in zip(network.projections, weights, strict=True))
    return replace(network, populations=populations, projections=tuple(projections))


def quantised_spikes(network: ir.Network, events: EventArray) -> dict[str, NDArray[np.bool_]]:
    """Spikes of every layer of a fine-tuned network as its torch model computes them, (samples, steps, neurons)."""
    return by_tower(network, lambda tower: _spikes(tower, events))


def _spikes(network: ir.Network, events: EventArray) -> list[NDArray[np.bool_]]:
    """Spikes of each layer of a network that is joined of no others."""
    assert network.forms is not None, "only a fine-tuned network has a quantised model"
    model = QuantisedNet(network, network.forms)
    with torch.no_grad():
        by_recording = [
            [spikes[:, 0].bool().numpy() for spikes in model.spikes_of(time_first(recording[None]))]
            for recording in events
        ]
    return [np.stack(layer) for layer in zip(*by_recording, strict=True)]
