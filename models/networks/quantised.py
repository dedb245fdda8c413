"""The network on the chip's own integers, as a torch model with gradients: what it computes is what the chip computes.

Weights, biases and thresholds are rounded by the compiler's own rounding. Synaptic sums are sums of integers
in float32, exact below 2**24, which the 21-bit accumulator guarantees; the recurrence runs in integers.
Gradients pass the rounding straight through, and a spike by the same surrogate as in training; those of a
recurrent layer run through its own spikes, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from spikeloom.compiler import ir
from spikeloom.compiler.checkpoint import merge
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.layer_kernel import charged, decayed, integrated, saturated
from spikeloom.compiler.passes.expand import stack_of
from spikeloom.compiler.systems import in_order
from spikeloom.compiler.targets.compartments import (
    IntegerNetwork,
    IntegerPopulation,
    fullest,
    one_sided_sums,
    registers,
    round_population,
)
from spikeloom.compiler.types import EventArray
from spikeloom.models.networks.layers import differentiate_step, events_of, gather, rates_of, scatter, time_first
from spikeloom.models.networks.networks import Weights
from spikeloom.models.networks.surrogate import FAST_SIGMOID, RECTANGLE, Surrogate
from spikeloom.models.networks.towers import split

SHRINK = 0.98
"""A neuron whose weights would overflow the accumulator has them scaled by this, until they do not."""

THETA = 0.5
"""Threshold that a network is brought to if it has another: what the surrogate and the learning rate are made for."""

WITHIN = 0.49
"""Share of a step that a weight may be away from the integer that it starts at."""

RELAY = 100
"""Threshold of a layer of relays alone, in weight units: NIR holds what makes them fire as a bias, which must fit."""

MATRIX_LIMIT = 2**26
"""Weights of a layer, zeros among them, which is one matrix here."""

Array = NDArray[Any]


class Stage:
    """A population and the synapses into it: its sources lie side by side, its own spikes last."""

    def __init__(self, network: ir.Network, post: int, form: ir.Form) -> None:
        into = sorted((p for p in network.projections if p.post == post), key=lambda p: p.pre == post)
        self.population, self.form, self.sources = network.populations[post], form, [p.pre for p in into]
        self.inputs = sum(p.weight.shape[1] for p in into if p.pre != post)
        weight = sparse.hstack([p.weight for p in into], format="csr")
        weight.sort_indices()
        self.shape = weight.shape
        if np.prod(weight.shape) > MATRIX_LIMIT:
            size = f"{weight.shape[0]:,} x {weight.shape[1]:,} weights, zeros among them"
            raise ModelError(f"{self.population.name}: has {size}, fine-tuning holds {MATRIX_LIMIT:,}; use it as it is")
        self.row, self.column = np.repeat(np.arange(weight.shape[0]), np.diff(weight.indptr)), weight.indices
        self.ends = weight.indptr
        # neurons that relay a clock come last; they learn nothing
        self.learning = self.population.size - self.population.relays
        held = int(weight.indptr[self.learning])
        self.weight, self.relays = torch.tensor(weight.data[:held]).float(), torch.tensor(weight.data[held:])
        self.step = registers.step_units(form.bits, form.exponents)
        self.scale = form.threshold / self.population.theta

    def one_sided(self, steps: Array) -> tuple[Array, Array]:
        """Largest positive and negative sum of each neuron, each plane by itself, as :func:`bounds.one_sided`."""
        exponents = self.form.exponents
        planes = zip(registers.split_planes(steps, self.form.bits, exponents), exponents, strict=True)
        sides = [one_sided_sums(registers.in_units(mantissa, exponent), self.ends) for mantissa, exponent in planes]
        positive, negative = np.sum(sides, axis=0)
        return positive, negative


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Integers:
    """One layer in chip integers, rounded once per step of the optimizer."""

    stage: Stage
    units: Array  # (inputs, neurons) float32; weights in weight units, whole numbers (halves of a step never occur)
    real: Array  # (neurons, inputs) float32; the same in the float model's units
    population: IntegerPopulation
    full: Array  # (neurons,) float64; the fullest that any input makes the accumulator, see :func:`fullest`


class QuantisedNet(nn.Module):
    """A network on chip integers; `forms` say how the chip stores each layer.

    Where the first layer has shared filters, these are learned, of everything else each synapse by itself.
    ModelError if a layer is too large for one matrix.
    """

    def __init__(self, network: ir.Network, forms: Sequence[ir.Form], surrogate: Surrogate = RECTANGLE) -> None:
        super().__init__()
        self.surrogate = surrogate
        self.stack: Array | None = None
        convolution = network.convolution
        if convolution is None:
            self.network = in_thresholds(network)
        else:
            self.network = network
            self.system = convolution.system
            self.stack = stack_of(convolution)
            self.hops = nn.Parameter(torch.tensor(convolution.filters))
            self.conv_bias = nn.Parameter(torch.tensor(convolution.bias))
        self.names = tuple(population.name for population in self.network.populations)
        self.forms = tuple(
            replace(form, exponents=(0,), threshold=np.full(each.size, RELAY)) if each.relays == each.size else form
            for each, form in zip(self.network.populations, forms, strict=True)
        )
        self.stages = [Stage(self.network, post, form) for post, form in enumerate(self.forms)]
        self.first = 0 if self.stack is None else 1  # of the layers whose synapses are learned by themselves
        own = self.stages[self.first :]
        biases = (torch.tensor(stage.population.bias[: stage.learning]).float() for stage in own)
        self.weights = nn.ParameterList(nn.Parameter(stage.weight) for stage in own)
        self.biases = nn.ParameterList(map(nn.Parameter, biases))
        self.integers: tuple[Integers, ...] = ()
        self.round()

    def start_at(self, integer: IntegerNetwork) -> None:
        """Move weights and biases to where they round to an integer network of these forms, no farther."""
        for post, stage in list(enumerate(self.stages))[self.first :]:
            planes = ir.added_up((p.pre, p.effective()) for p in integer.projections if p.post == post)
            units = sparse.hstack([planes[pre] for pre in stage.sources]).toarray()
            weight = self.weights[post - self.first]
            bias = self.biases[post - self.first]
            learned = slice(len(weight))
            steps = units[stage.row[learned], stage.column[learned]] / stage.step
            step = (stage.step / stage.scale)[stage.row[learned]]
            near = np.clip(weight.detach().numpy() / step, steps - WITHIN, steps + WITHIN) * step
            held = integer.populations[post].bias / (stage.scale * (1 << registers.MEMBRANE_SHIFT))
            with torch.no_grad():
                weight.copy_(torch.tensor(near))
                bias.copy_(torch.tensor(held[: stage.learning]))
        self.round()

    def given(self, post: int) -> tuple[Tensor, Tensor]:
        """Weights of a layer's synapses and biases of its neurons in float64, a convolution expanded, with relays."""
        stage = self.stages[post]
        if post >= self.first or self.stack is None:
            weight = self.weights[post - self.first].double()
            bias = self.biases[post - self.first].double()
        else:
            held, (places, features) = len(stage.weight), (self.stack.shape[1], self.hops.shape[1])
            conv = torch.einsum("kij,kfc->ifjc", torch.tensor(self.stack), self.hops.double())
            conv = in_order(self.system, conv).reshape(stage.learning, -1)
            weight = conv[stage.row[:held], stage.column[:held]]
            bias = in_order(self.system, self.conv_bias.double().repeat(places).view(places, features))
        if not stage.population.relays:
            return weight, bias
        return torch.cat([weight, stage.relays]), torch.cat([bias, bias.new_zeros(stage.population.relays)])

    def learned(self) -> ir.Network:
        """The network with its present weights and biases, thresholds as of :func:`in_thresholds`."""
        populations = []
        projections = []
        for post, stage in enumerate(self.stages):
            weight, bias = (each.detach().numpy() for each in self.given(post))
            populations.append(replace(stage.population, bias=bias))
            whole = sparse.csr_array((weight, (stage.row, stage.column)), shape=stage.shape)
            first = 0
            for pre in stage.sources:
                size = self.network.input.size if pre == ir.INPUT else self.network.populations[pre].size
                projections.append(ir.Projection(pre=pre, post=post, weight=whole[:, first : first + size]))
                first += size
        changed = replace(self.network, populations=tuple(populations), projections=tuple(projections))
        return replace(changed, convolution=None)

    def tensors(self) -> Weights:
        """Weights and biases as a checkpoint holds them."""
        weights = {"conv1.hops": self.hops, "conv1.bias": self.conv_bias}
        for name, weight, bias in zip(self.names[1:], self.weights, self.biases, strict=True):
            weights |= {f"{name}.weight": weight.view(len(bias), -1), f"{name}.bias": bias}
        return {name: parameter.detach().numpy().copy() for name, parameter in weights.items()}

    def round(self) -> None:
        """Round all weights, after every change of them; `make_legal` sees that every bias has a register value."""
        found = []
        for post, stage in enumerate(self.stages):
            weight, bias = (each.detach().numpy() for each in self.given(post))
            population, _ = round_population(stage.population, (), stage.form, bias=bias)
            steps = registers.round_steps(weight, stage.scale[stage.row], stage.form.bits, stage.form.exponents)
            units = np.zeros(stage.shape[::-1], np.float32)
            units[stage.column, stage.row] = steps * stage.step
            real = np.ascontiguousarray((units / stage.scale.astype(np.float32)).T)
            full = fullest(population, *stage.one_sided(steps))
            found.append(Integers(stage=stage, units=units, real=real, population=population, full=full))
        self.integers = tuple(found)

    def clip_weights(self) -> None:
        """Keep single weights within half a step of what their storage holds, so that none gets lost."""
        with torch.no_grad():
            for weight, stage in zip(self.weights, self.stages[self.first :], strict=True):
                most = (registers.reach(stage.form.bits, stage.form.exponents) + 0.5) * stage.step / stage.scale
                limit = torch.tensor(most[stage.row[: len(weight)]], dtype=torch.float32)
                weight.copy_(torch.clamp(weight, -limit, limit))

    def make_legal(self) -> None:
        """Shrink weights and biases until no accumulator can overflow and every bias has a register value; round."""
        with torch.no_grad():
            for post, stage in enumerate(self.stages):
                shared = post < self.first
                bias = self.conv_bias if shared else self.biases[post - self.first]
                most = (registers.BIAS_MANTISSA_MAX << registers.BIAS_EXPONENT_MAX) / (
                    stage.scale * (1 << registers.MEMBRANE_SHIFT)
                )
                bound = torch.tensor(most.min() if shared else most[: stage.learning], dtype=torch.float32) * SHRINK
                bias.copy_(torch.clamp(bias, -bound, bound))
            self.round()
            while any((integers.full > registers.ONE_STEP_SUM_MAX).any() for integers in self.integers):
                for post, integers in enumerate(self.integers):
                    wrong = integers.full > registers.ONE_STEP_SUM_MAX
                    stage = integers.stage
                    if post >= self.first:
                        weight = self.weights[post - self.first]
                        bias = self.biases[post - self.first]
                        weight[torch.tensor(wrong[stage.row[: len(weight)]])] *= SHRINK
                        if stage.population.alpha:  # what lasts fills the membrane together with the bias
                            bias[torch.tensor(wrong[: stage.learning])] *= SHRINK
                    elif self.stack is not None:
                        places = self.stack.shape[1]
                        features = self.hops.shape[1]
                        feature = in_order(self.system, np.tile(np.arange(features), (places, 1)))
                        self.hops[:, torch.tensor(np.unique(feature[wrong[: stage.learning]]))] *= SHRINK
                        if stage.population.alpha and wrong.any():
                            self.conv_bias.mul_(SHRINK)
                self.round()

    def spikes_of(self, events: Tensor) -> list[Tensor]:
        """Spikes of every layer, (steps, samples, neurons), for events (steps, samples, taxels, channels)."""
        clocks = self.network.input.clocks
        inputs = events.flatten(2)
        if clocks.channels:
            ticks = torch.tensor(clocks.events(len(inputs)), dtype=torch.float32).t()[:, None]
            inputs = torch.cat([inputs, ticks.expand(-1, inputs.shape[1], -1)], dim=2)
        found: list[Tensor] = []
        for post, integers in enumerate(self.integers):
            sources = [inputs if pre == ir.INPUT else found[pre] for pre in integers.stage.sources if pre != post]
            received = sources[0] if len(sources) == 1 else torch.cat(sources, dim=2)
            given = self.given(post)
            found.append(_ChipLayer.apply(received, *given, integers, self.surrogate))  # type: ignore[no-untyped-call]
        return found

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each class, (samples, classes), for events (steps, samples, taxels, channels).

        `lengths` (samples,) has the steps of each recording, where some were filled up with silence.
        """
        readout = self.network.readout
        rates = rates_of(self.spikes_of(events)[readout.population], lengths)
        votes = rates.new_zeros(len(rates), self.network.classes)
        return votes.index_add(1, torch.tensor(readout.label), rates)


def in_thresholds(network: ir.Network) -> ir.Network:
    """The network with weights and biases in units in which every threshold is ``THETA``."""
    factors = [THETA / population.theta for population in network.populations]
    pairs = zip(network.populations, factors, strict=True)
    populations = tuple(replace(each, theta=THETA, bias=each.bias * factor) for each, factor in pairs)
    weights = [ir.with_data(p.weight, p.weight.data * factors[p.post]) for p in network.projections]
    projections = (replace(p, weight=weight) for p, weight in zip(network.projections, weights, strict=True))
    return replace(network, populations=populations, projections=tuple(projections))


class _ChipLayer(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, spikes: Tensor, _weight: Tensor, _bias: Tensor, integers: Integers, surrogate: Surrogate
    ) -> Tensor:
        steps, samples, inputs = spikes.shape
        population = integers.population
        stage = integers.stage
        source, bounds = events_of(spikes.detach().reshape(-1, inputs).contiguous().numpy())
        sums = np.zeros((steps * samples, population.size), np.float32)
        gather(source, bounds, integers.units[:inputs], sums)
        shape = steps, samples * population.size
        fired = np.empty(shape, np.float32)
        membrane = np.empty(shape, np.float32)
        unit = 1 / (stage.scale * (1 << registers.MEMBRANE_SHIFT))  # membrane of the float model in one membrane unit
        threshold = population.threshold << registers.MEMBRANE_SHIFT
        bias, threshold, unit = (np.tile(each, samples) for each in (population.bias, threshold, unit))
        alpha, beta = (
            round(kept * registers.DECAY_ONE) for kept in (population.realised_alpha, population.realised_beta)
        )
        own = integers.units[inputs:]
        _integrate_chip(sums.reshape(shape), own, bias, threshold, unit, alpha, beta, fired, membrane)
        ctx.kept = source, bounds, fired, membrane, integers, samples, surrogate
        return torch.from_numpy(fired).view(steps, samples, -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None, None]:
        source, bounds, fired, membrane, integers, samples, surrogate = ctx.kept
        stage = integers.stage
        inputs = integers.stage.inputs
        neurons = integers.population.size
        above = gradients[0].contiguous().view(membrane.shape).numpy()
        current, through_bias = _backwards(above, membrane, integers, samples, surrogate)
        rows = current.reshape(len(membrane) * samples, -1)
        weight = np.zeros_like(integers.units)
        scatter(source, bounds, rows, weight[:inputs])
        if stage.inputs < len(weight):
            weight[inputs:] = fired[:-1].reshape(-1, neurons).T @ rows[samples:]
        below = None
        if ctx.needs_input_grad[0]:
            below = torch.from_numpy(rows @ integers.real[:, :inputs]).view(len(membrane), samples, -1)
        bias = through_bias.reshape(-1, neurons).sum(0)
        return below, torch.from_numpy(weight[stage.column, stage.row]), torch.from_numpy(bias), None, None


def _backwards(
    above: Array, membrane: Array, integers: Integers, samples: int, surrogate: Surrogate
) -> tuple[Array, Array]:
    """Gradients of what flows into the currents and of the bias, both (steps, samples * neurons), from the spikes'."""
    own = integers.real[:, integers.stage.inputs :]
    population = integers.population
    alpha = np.float32(population.realised_alpha)
    theta = np.float32(integers.stage.population.theta)
    beta, width, reset = map(np.float32, (population.realised_beta, surrogate.width, surrogate.reset))
    smooth = surrogate.shape == FAST_SIGMOID
    current = np.empty_like(membrane)
    direct = np.empty_like(membrane)
    later, drained = np.zeros((2, membrane.shape[1]), np.float32)
    for t in range(len(membrane) - 1, -1, -1):
        given = above[t] + (drained.reshape(samples, -1) @ own).ravel() if own.size else above[t]
        differentiate_step(given, membrane[t], later, beta, theta, width, reset, smooth, direct[t])
        later = direct[t]
        np.add(later, alpha * drained, out=current[t])
        drained = current[t]
    return current, direct


@numba.njit(cache=True)
def _chip_step(
    sums: Any, i: Any, v: Any, bias: Any, threshold: Any, unit: Any, keep_u: Any, keep_v: Any, fired: Any, membrane: Any
) -> None:
    for n in range(len(v)):
        i[n] = charged(i[n], keep_u, np.int64(sums[n]) << registers.MEMBRANE_SHIFT)
        u = saturated(integrated(decayed(v[n], keep_v), i[n], bias[n]), registers.MEMBRANE_MAX)
        spike = u > threshold[n]
        fired[n] = spike
        membrane[n] = u * unit[n]
        v[n] = 0 if spike else u


@numba.njit(cache=True)
def _integrate_chip(
    sums: Any, own: Any, bias: Any, threshold: Any, unit: Any, keep_u: Any, keep_v: Any, fired: Any, membrane: Any
) -> None:
    """The chip's compartment along the first axis; its ``spec`` module defines it.

    `own` (neurons, neurons), or (0, neurons), are weights from what the layer fired in the step before.
    """
    neurons = own.shape[1]
    i = np.zeros(sums.shape[1], np.int64)
    v = np.zeros(sums.shape[1], np.int64)
    for t in range(len(sums)):
        if t > 0 and len(own) > 0:
            for n in range(len(v)):
                if fired[t - 1, n] > 0:
                    first = n // neurons * neurons
                    for m in range(neurons):
                        sums[t, first + m] += own[n - first, m]
        _chip_step(sums[t], i, v, bias, threshold, unit, keep_u, keep_v, fired[t], membrane[t])


def quantised_spikes(network: ir.Network, events: EventArray) -> dict[str, NDArray[np.bool_]]:
    """Spikes of every layer of a fine-tuned network as its torch model computes them, (samples, steps, neurons)."""
    names = [population.name for population in network.populations]
    towers = [_spikes(tower, events) for tower in split(network)]
    owners = () if network.convolution is None else network.convolution.towers
    return dict(zip(names, merge(owners, towers) if owners else towers[0], strict=True))


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
