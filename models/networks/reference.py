"""The float model of a trained network in the released operator order, as ``verify`` compares the chip with it.

Released order: hop 0 first, then one propagation and one linear map per hop, added up, bias last; then the
recurrence. In float32 this gives every spike of the released code on the released test recordings. A GCN is
mapped first and then propagated, as torch_geometric does it; the sums of the others are one product. Towers
of a joined network run one after the other, so that each has every spike that it has alone.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from spikeloom.compiler.dynamics import RELAY_WEIGHT
from spikeloom.compiler.interpret import threads
from spikeloom.compiler.ir import Network, Population, Projection
from spikeloom.compiler.layer_kernel import add, compiled_and_cached, copy, integrate_float, keep
from spikeloom.compiler.systems import GCN, TACTILESGNET, feature_major
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray
from spikeloom.models.networks.towers import by_tower

BATCH = 8
"""Recordings that run together."""

STEPS = 32
"""Steps of these that run together: few enough for the caches."""


def float_spikes(network: Network, events: EventArray, *, dtype: str = "float32") -> dict[str, BoolArray]:
    """Spikes of every layer, (samples, steps, neurons) by name, on recordings (samples, taxels, channels, steps).

    The network is one with a convolution, whose propagation is rounded to `dtype`; networks are trained in
    float32.
    """
    return by_tower(network, lambda tower: _run(tower, events, np.dtype(dtype), membranes=False))


def float_membranes(
    network: Network, events: EventArray, *, dtype: str = "float32"
) -> dict[str, npt.NDArray[np.floating]]:
    """Membranes of every layer before the comparison; as :func:`float_spikes`, (samples, steps, neurons) of `dtype`."""
    return by_tower(network, lambda tower: _run(tower, events, np.dtype(dtype), membranes=True))


def _run(network: Network, events: AnyArray, dtype: np.dtype[Any], *, membranes: bool) -> list[AnyArray]:
    """Spikes, or membranes, of each layer of a network that is joined of no others."""
    samples = len(events)
    steps = events.shape[3]
    kind = dtype if membranes else np.bool_
    drives = _drives(network, dtype)
    kept = [np.empty((samples, steps, population.size), kind) for population in network.populations]

    def batch(start: int) -> None:
        rows = slice(start, start + BATCH)
        layers = [_Neurons(*each, dtype) for each in zip(drives, network.populations, strict=True)]
        for first in range(0, steps, STEPS):
            part = slice(first, first + STEPS)
            spikes = np.ascontiguousarray(events[rows, :, :, part].transpose(3, 0, 1, 2), dtype)
            for layer, integrate in enumerate(layers):
                spikes, compared = integrate(spikes)
                if layer == 0:
                    spikes, compared = _with_relays(network, spikes, compared, first)
                kept[layer][rows, part] = (compared if membranes else spikes).transpose(1, 0, 2)

    with _blas().limit(limits=1, user_api="blas"):  # its threads and ours would wait for each other
        list(threads().map(batch, range(0, samples, BATCH)))
    return kept


@cache
def _blas() -> ThreadpoolController:
    """What numpy multiplies matrices with; it takes milliseconds to find."""
    return ThreadpoolController()


def _drives(network: Network, dtype: np.dtype[Any]) -> list[Callable[[AnyArray], AnyArray]]:
    """What spikes of some steps bring to each layer."""
    dense = zip(network.populations[1:], network.projections[1:], strict=True)
    return [_convolution(network, dtype), *(_linear(*each, dtype) for each in dense)]


def _convolution(network: Network, dtype: np.dtype[Any]) -> Callable[[AnyArray], AnyArray]:
    """What spikes bring to the first layer, the relays of clocks aside."""
    convolution = network.convolution
    assert convolution is not None, "only a checkpoint says in which order it is summed"
    filters = convolution.filters.astype(dtype)
    propagation = convolution.propagation.astype(dtype)
    bias = convolution.bias.astype(dtype)
    # the bias is part of what the spikes bring, unless that outlasts its step
    inside = np.zeros_like(bias) if network.populations[0].alpha else bias
    return lambda spikes: _first(convolution.system, spikes, propagation, filters, inside)


def _linear(
    population: Population, projection: Projection, dtype: np.dtype[Any]
) -> Callable[[AnyArray], AnyArray]:
    """What spikes bring to a fully connected layer, all of whose synapses are stored."""
    weight = projection.weight.data.reshape(population.size, -1).T.astype(dtype)
    bias = np.zeros(population.size, dtype) if population.alpha else population.bias.astype(dtype)
    return lambda spikes: spikes @ weight + bias


class _Neurons:
    """Neurons of a layer and their state; what arrives is what `drive` makes of spikes (steps, samples, neurons)."""

    def __init__(
        self, drive: Callable[[AnyArray], AnyArray], population: Population, dtype: np.dtype[Any]
    ) -> None:
        self._drive = drive
        bias = population.bias[: population.size - population.relays].astype(dtype)
        self._bias = bias if population.alpha else np.zeros_like(bias)
        self._constants = [
            dtype.type(value) for value in (population.alpha, population.beta, population.theta)
        ]
        self._state: AnyArray = np.zeros(0, dtype)

    def __call__(self, spikes: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Spikes, zeros and ones of the float type, and membranes of some steps."""
        drive = np.ascontiguousarray(self._drive(spikes))
        if not len(self._state):
            self._state = np.zeros((2, drive[0].size), drive.dtype)
        fired = np.empty(drive.shape, np.uint8)
        rows = drive.reshape(len(drive), -1)
        _integrate(
            rows,
            np.tile(self._bias, drive.shape[1]),
            *self._constants,
            *self._state,
            fired.reshape(rows.shape),
        )
        return fired.astype(drive.dtype), drive


@compiled_and_cached
def _integrate(
    drive: Any, bias: Any, alpha: Any, beta: Any, theta: Any, current: Any, membrane: Any, fired: Any
) -> None:
    """Run neurons for some steps; `drive` becomes the membranes that were compared."""
    for t in range(len(drive)):
        keep(current, alpha)
        add(current, drive[t])
        integrate_float(membrane, current, bias, beta, theta, fired[t])
        copy(membrane, drive[t])


def _with_relays(
    network: Network, spikes: AnyArray, membranes: AnyArray, first: int
) -> tuple[AnyArray, AnyArray]:
    """Add those of the relays, which spike as their clocks tick."""
    clocks = network.input.clocks
    ticks = clocks.events(len(spikes), first=first).T.astype(spikes.dtype)
    relays = np.broadcast_to(ticks[:, None], (*spikes.shape[:2], clocks.channels))
    return (
        np.concatenate([spikes, relays], axis=2),
        np.concatenate([membranes, relays * (RELAY_WEIGHT * network.populations[0].theta)], axis=2),
    )


def _first(system: str, x: AnyArray, propagation: AnyArray, hops: AnyArray, bias: AnyArray) -> AnyArray:
    """Currents of the first layer, (steps, samples, neurons), in the order of the system's neurons."""
    steps, samples, taxels, channels = x.shape
    if system == GCN:
        current: AnyArray = propagation[0] @ (x @ hops[0].T) + bias
        return current.reshape(steps, samples, -1)
    # taxels first: a hop is then one product of (taxels, taxels) with a wide matrix
    reached = x.transpose(2, 0, 1, 3).reshape(taxels, -1)
    if system == TACTILESGNET:
        for k, hop in enumerate(hops):
            reached = propagation @ reached if k else reached
            rows = reached.reshape(taxels, -1, channels).transpose(1, 0, 2).reshape(-1, channels)
            current = current + rows @ hop.T if k else rows @ hop.T
        return (current + bias).reshape(steps, samples, -1)
    filters, places, _ = propagation.shape
    seen = propagation.transpose(1, 0, 2).reshape(-1, taxels) @ reached
    rows = seen.reshape(places, filters, -1, channels).transpose(2, 0, 1, 3).reshape(-1, filters * channels)
    current = (rows @ hops.transpose(0, 2, 1).reshape(filters * channels, -1) + bias).reshape(
        steps, samples, places, -1
    )
    if feature_major(system):
        current = current.transpose(0, 1, 3, 2)
    return current.reshape(steps, samples, -1)
