"""One layer of a fine-tuned network: forward the chip's integers, backward gradients as if nothing were rounded.

Synaptic sums are sums of integers in float32, exact below 2**24, which the 21-bit accumulator guarantees;
the recurrence runs in integers. Gradients pass the rounding straight through, and a spike by the same
surrogate as in training; those of a recurrent layer run through its own spikes, too.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from spikeloom.compiler.layer_kernel import charged, decayed, integrated, saturated
from spikeloom.compiler.targets.compartments import IntegerPopulation, registers
from spikeloom.models.networks.layers import differentiate_step, events_of, gather, scatter
from spikeloom.models.networks.learned import Array, Stage
from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Integers:
    """One layer in chip integers, rounded once per step of the optimizer."""

    stage: Stage
    units: Array  # (inputs, neurons) float32; weights in weight units, whole numbers (halves of a step never occur)
    real: Array  # (neurons, inputs) float32; the same in the float model's units
    population: IntegerPopulation
    full: Array  # (neurons,) float64; the fullest that any input makes the accumulator, see :func:`fullest`


class ChipLayer(torch.autograd.Function):
    """Spikes of a layer from those it receives, (steps, samples, inputs); weights and biases get gradients only."""

    @staticmethod
    def forward(
        ctx: Any, spikes: Tensor, _weight: Tensor, _bias: Tensor, integers: Integers, surrogate: Surrogate
    ) -> Tensor:
        """Spikes by the integers."""
        steps, samples, inputs = spikes.shape
        population = integers.population
        stage = integers.stage
        source, bounds = events_of(spikes)
        sums = np.zeros((steps * samples, population.size), np.float32)
        gather(source, bounds, integers.units[:inputs], sums)
        shape = steps, samples * population.size
        fired = np.empty(shape, np.float32)
        membrane = np.empty(shape, np.float32)
        unit = 1 / stage.membrane_scale  # membrane of the float model in one membrane unit
        threshold = population.threshold << registers.MEMBRANE_SHIFT
        bias, threshold, unit = (np.tile(each, samples) for each in (population.bias, threshold, unit))
        alpha, beta = (
            round(kept * registers.DECAY_ONE)
            for kept in (population.realised_alpha, population.realised_beta)
        )
        recurrent = integers.units[inputs:]
        _integrate_chip(sums.reshape(shape), recurrent, bias, threshold, unit, alpha, beta, fired, membrane)
        ctx.kept = source, bounds, fired, membrane, integers, samples, surrogate
        return torch.from_numpy(fired).view(steps, samples, -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None, None]:
        """Gradients of received spikes, weights and biases."""
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
            weight[inputs:] = _product(fired[:-1].reshape(-1, neurons).T, rows[samples:])
        below = None
        if ctx.needs_input_grad[0]:
            below = torch.from_numpy(_product(rows, integers.real[:, :inputs]))
            below = below.view(len(membrane), samples, -1)
        bias = through_bias.reshape(-1, neurons).sum(0)
        return below, torch.from_numpy(weight[stage.column, stage.row]), torch.from_numpy(bias), None, None


def _product(left: Array, right: Array) -> Array:
    """``left @ right`` by torch; numpy adds up in another order by threads and processor, which a seed would show."""
    product: Array = torch.mm(torch.from_numpy(left), torch.from_numpy(right)).numpy()
    return product


def _backwards(
    above: Array, membrane: Array, integers: Integers, samples: int, surrogate: Surrogate
) -> tuple[Array, Array]:
    """Gradients of what flows into the currents and of the bias, both (steps, samples * neurons), from the spikes'."""
    recurrent = integers.real[:, integers.stage.inputs :]
    population = integers.population
    alpha = np.float32(population.realised_alpha)
    theta = np.float32(integers.stage.population.theta)
    beta, width, reset = map(np.float32, (population.realised_beta, surrogate.width, surrogate.reset))
    smooth = surrogate.shape == FAST_SIGMOID
    current = np.empty_like(membrane)
    direct = np.empty_like(membrane)
    later, drained = np.zeros((2, membrane.shape[1]), np.float32)
    for t in range(len(membrane) - 1, -1, -1):
        given = above[t]
        if recurrent.size:
            given = given + _product(drained.reshape(samples, -1), recurrent).ravel()
        differentiate_step(given, membrane[t], later, beta, theta, width, reset, smooth, direct[t])
        later = direct[t]
        np.add(later, alpha * drained, out=current[t])
        drained = current[t]
    return current, direct


@numba.njit(cache=True)
def _chip_step(
    sums: Any,
    i: Any,
    v: Any,
    bias: Any,
    threshold: Any,
    unit: Any,
    keep_u: Any,
    keep_v: Any,
    fired: Any,
    membrane: Any,
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
    sums: Any,
    recurrent: Any,
    bias: Any,
    threshold: Any,
    unit: Any,
    keep_u: Any,
    keep_v: Any,
    fired: Any,
    membrane: Any,
) -> None:
    """The chip's compartment along the first axis; its ``spec`` module defines it.

    `recurrent` (neurons, neurons), or (0, neurons), are weights from what the layer fired in the step
    before.
    """
    neurons = recurrent.shape[1]
    i = np.zeros(sums.shape[1], np.int64)
    v = np.zeros(sums.shape[1], np.int64)
    for t in range(len(sums)):
        if t > 0 and len(recurrent) > 0:
            for n in range(len(v)):
                if fired[t - 1, n] > 0:
                    first = n // neurons * neurons
                    for m in range(neurons):
                        sums[t, first + m] += recurrent[n - first, m]
        _chip_step(sums[t], i, v, bias, threshold, unit, keep_u, keep_v, fired[t], membrane[t])
