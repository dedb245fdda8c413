"""The network on the chip's own integers, as a torch model with gradients: what it computes is what the chip computes.

Weights, biases and thresholds are rounded by :func:`fixedpoint.round_steps`, the compiler's own rounding. Synaptic
sums are sums of integers in float32, exact below 2**24, which the 21-bit accumulator guarantees; the recurrence runs in
integers. Gradients pass the rounding straight through, and a spike by the same surrogate as in training.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from spikeloom.compiler import fixedpoint
from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.formats.tensors import members, side_by_side
from spikeloom.compiler.ir import Form
from spikeloom.compiler.passes.expand import effective_weight, stack_of
from spikeloom.compiler.systems import in_order
from spikeloom.models.networks.layers import differentiate, events_of, gather, rates_of, scatter, time_first
from spikeloom.models.networks.surrogate import RECTANGLE

SHRINK = 0.98
"""A neuron whose weights would overflow the accumulator has them scaled by this, until they do not."""

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Integers:
    """One layer in chip integers, rounded once per step of the optimizer."""

    units: Array  # (inputs, neurons) float32; weights in weight units, whole numbers (halves of a step never occur)
    real: Array  # (neurons, inputs) float32; the same in the float model's units
    # bias, threshold: (neurons,) int64; in membrane units
    bias: Array
    threshold: Array
    unit: Array  # (neurons,) float64; membrane of the float model in one membrane unit
    keep: int  # What a membrane keeps in a step, in 1/4096


class QuantisedNet(nn.Module):
    """A network on chip integers: a checkpoint on what its first layer sees, see :func:`expand.stack_of`.

    `forms` say how the chip stores each layer, conv1 first.
    """

    def __init__(self, checkpoint: Checkpoint, adjacency: Array, forms: Sequence[Form]) -> None:
        super().__init__()
        self.forms = tuple(forms)
        self.names = ("conv1", *(dense.name for dense in checkpoint.dense))
        self.theta = checkpoint.theta
        self.keep = (1 << fixedpoint.DECAY_BITS) - fixedpoint.decay_registers(checkpoint.beta)[1]
        self.system = checkpoint.system
        self.stack = stack_of(checkpoint, adjacency)
        self.hops = nn.Parameter(torch.tensor(checkpoint.hops))
        self.conv_bias = nn.Parameter(torch.tensor(checkpoint.conv_bias))
        self.weights = nn.ParameterList(nn.Parameter(torch.tensor(dense.weight)) for dense in checkpoint.dense)
        self.biases = nn.ParameterList(nn.Parameter(torch.tensor(dense.bias)) for dense in checkpoint.dense)
        self.integers: tuple[Integers, ...] = ()
        self.round()

    def real_weights(self) -> list[tuple[Array, Array]]:
        """Weights (neurons, inputs) and biases (neurons,) of each layer, float64, the convolution expanded."""
        hops = self.hops.detach().numpy().astype(np.float64)
        conv = in_order(self.system, effective_weight(self.stack, hops))
        bias = np.tile(self.conv_bias.detach().numpy().astype(np.float64), (self.stack.shape[1], 1))
        layers = [(conv.reshape(len(conv), -1), in_order(self.system, bias))]
        for weight, bias in zip(self.weights, self.biases, strict=True):
            layers.append((weight.detach().numpy().astype(np.float64), bias.detach().numpy().astype(np.float64)))
        return layers

    def round(self) -> None:
        """Round all weights, after every change of them; `make_legal` sees that every bias has a register value."""
        found = []
        for (weight, bias), form in zip(self.real_weights(), self.forms, strict=True):
            scale = form.threshold / self.theta
            steps = fixedpoint.round_steps(weight, scale[:, None], form.bits, form.exponents)
            units = steps * fixedpoint.step_units(form.bits, form.exponents)
            mantissa, exponent = fixedpoint.encode_bias(bias * scale * (1 << fixedpoint.MEMBRANE_SHIFT))
            found.append(
                Integers(
                    units=np.ascontiguousarray(units.T, np.float32),
                    real=(units / scale[:, None]).astype(np.float32),
                    bias=mantissa << exponent,
                    threshold=form.threshold << fixedpoint.MEMBRANE_SHIFT,
                    unit=1 / (scale * (1 << fixedpoint.MEMBRANE_SHIFT)),
                    keep=self.keep,
                )
            )
        self.integers = tuple(found)

    def clip_weights(self) -> None:
        """Keep the weights of dense layers within half a step of what their storage holds, so that none gets lost."""
        with torch.no_grad():
            for weight, form in zip(self.weights, self.forms[1:], strict=True):
                step = fixedpoint.step_units(form.bits, form.exponents) * self.theta / form.threshold
                limit = torch.tensor((fixedpoint.reach(form.bits, form.exponents) + 0.5) * step, dtype=torch.float32)[
                    :, None
                ]
                weight.copy_(torch.clamp(weight, -limit, limit))

    def make_legal(self) -> None:
        """Shrink weights and biases until no accumulator can overflow and every bias has a register value; round."""
        with torch.no_grad():
            for layer, form in enumerate(self.forms):
                bias = self.conv_bias if layer == 0 else self.biases[layer - 1]
                most = (
                    (fixedpoint.BIAS_MANTISSA_MAX << fixedpoint.BIAS_EXPONENT_MAX)
                    * self.theta
                    / (form.threshold << fixedpoint.MEMBRANE_SHIFT)
                )
                bound = torch.tensor(most.min() if layer == 0 else most, dtype=torch.float32) * SHRINK
                bias.copy_(torch.clamp(bias, -bound, bound))
            over = True
            while over:
                self.round()
                over = False
                for layer, integers in enumerate(self.integers):
                    up = np.maximum(integers.units, 0).sum(axis=0, dtype=np.float64)
                    down = np.maximum(-integers.units, 0).sum(axis=0, dtype=np.float64)
                    wrong = np.maximum(up, down) > fixedpoint.ONE_STEP_SUM_MAX
                    if not wrong.any():
                        continue
                    over = True
                    if layer:
                        self.weights[layer - 1][torch.tensor(wrong)] *= SHRINK
                    else:
                        places, features = self.stack.shape[1], self.hops.shape[1]
                        feature = in_order(self.system, np.tile(np.arange(features), (places, 1)))
                        self.hops[:, torch.tensor(np.unique(feature[wrong]))] *= SHRINK

    def spikes_of(self, events: Tensor) -> list[Tensor]:
        """Spikes of every layer, (steps, samples, neurons), for events (steps, samples, taxels, channels)."""
        stack = torch.tensor(self.stack, dtype=torch.float32)
        places, features = stack.shape[1], self.hops.shape[1]
        # for the gradient only; the integers come from float64
        conv = in_order(self.system, torch.einsum("kij,kfc->ifjc", stack, self.hops))
        bias = in_order(self.system, self.conv_bias.repeat(places).view(places, features))
        found, spikes = [], events.flatten(2)
        pairs = [(conv.reshape(len(conv), -1), bias), *zip(self.weights, self.biases, strict=True)]
        for (weight, bias), integers in zip(pairs, self.integers, strict=True):
            spikes = _ChipLayer.apply(spikes, weight, bias, integers, self.theta)  # type: ignore[no-untyped-call]
            found.append(spikes)
        return found

    def forward(self, events: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Spikes per step of each output neuron, (samples, classes), for events (steps, samples, taxels, channels).

        `lengths` (samples,) has the steps of each recording, where some were filled up with silence.
        """
        return rates_of(self.spikes_of(events)[-1], lengths)


class _ChipLayer(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, spikes: Tensor, _weight: Tensor, _bias: Tensor, integers: Integers, theta: float) -> Tensor:
        steps, samples, inputs = spikes.shape
        source, bounds = events_of(spikes.detach().reshape(-1, inputs).contiguous().numpy())
        sums = np.zeros((steps * samples, integers.units.shape[1]), np.float32)
        gather(source, bounds, integers.units, sums)
        shape = steps, sums.size // steps
        fired, membrane = np.empty(shape, np.float32), np.empty(shape, np.float32)
        tiled = [np.tile(a, samples) for a in (integers.bias, integers.threshold, integers.unit)]
        _integrate_chip(sums.reshape(shape), tiled[0], tiled[1], tiled[2], integers.keep, fired, membrane)
        ctx.kept = source, bounds, membrane, integers, theta, samples
        return torch.from_numpy(fired).view(steps, samples, -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None, None]:
        source, bounds, membrane, integers, theta, samples = ctx.kept
        above = gradients[0].contiguous().view(membrane.shape).numpy()
        current = np.empty_like(membrane)
        differentiate(above, membrane, integers.keep / (1 << fixedpoint.DECAY_BITS), theta, RECTANGLE, current)
        rows = current.reshape(len(membrane) * samples, -1)
        weight = np.zeros_like(integers.units)
        scatter(source, bounds, rows, weight)
        below = None
        if ctx.needs_input_grad[0]:
            below = torch.from_numpy(rows @ integers.real).view(len(membrane), samples, -1)
        return below, torch.from_numpy(weight.T), torch.from_numpy(rows.sum(0)), None, None


@numba.njit(cache=True)
def _chip_step(sums: Any, v: Any, bias: Any, threshold: Any, unit: Any, keep: Any, fired: Any, membrane: Any) -> None:
    for i in range(len(v)):
        magnitude = abs(v[i]) * keep >> fixedpoint.DECAY_BITS
        u = (magnitude if v[i] >= 0 else -magnitude) + (np.int64(sums[i]) << fixedpoint.MEMBRANE_SHIFT) + bias[i]
        u = min(max(u, -fixedpoint.MEMBRANE_MAX), fixedpoint.MEMBRANE_MAX)
        spike = u > threshold[i]
        fired[i] = spike
        membrane[i] = u * unit[i]
        v[i] = 0 if spike else u


@numba.njit(cache=True)
def _integrate_chip(sums: Any, bias: Any, threshold: Any, unit: Any, keep: Any, fired: Any, membrane: Any) -> None:
    """The chip's compartment without a current of its own, along the first axis; its ``spec`` module defines it."""
    v = np.zeros(sums.shape[1], np.int64)
    for t in range(len(sums)):
        _chip_step(sums[t], v, bias, threshold, unit, keep, fired[t], membrane[t])


def quantised_spikes(
    checkpoint: Checkpoint, adjacency: NDArray[np.float64], events: NDArray[np.uint8]
) -> dict[str, NDArray[np.bool_]]:
    """Spikes of every layer of a fine-tuned checkpoint as its torch model computes them, (samples, steps, neurons)."""
    if checkpoint.towers > 1:
        return side_by_side(checkpoint, [quantised_spikes(m, adjacency, events) for m in members(checkpoint)])
    assert checkpoint.forms is not None, "only a fine-tuned checkpoint has a quantised model"
    network = QuantisedNet(checkpoint, adjacency, checkpoint.forms)
    found: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in network.names}
    with torch.no_grad():
        for recording in events:
            layers = network.spikes_of(time_first(recording[None]))
            for name, spikes in zip(network.names, layers, strict=True):
                found[name].append(spikes[:, 0].bool().numpy())
    return {name: np.stack(parts) for name, parts in found.items()}
