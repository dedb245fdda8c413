"""The float model of a checkpoint, in the released operator order, as ``verify`` compares the chip with it.

Released order: hop 0 first, then one propagation and one linear map per hop, added up, bias last; then the
recurrence. In float32 this gives every spike of the released code on the released test recordings. A GCN is mapped
first and then propagated, as torch_geometric does it; the sums of the others are one product. Towers of a joined
network run one after the other, so that each has every spike that it has alone.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import RELAY_WEIGHT
from spikeloom.compiler.formats.tensors import members, side_by_side
from spikeloom.compiler.interpret import threads
from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached, copy, integrate_float, keep
from spikeloom.compiler.systems import GCN, TACTILESGNET, feature_major, in_order
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, FloatArray

BATCH = 8
"""Recordings that run together."""

STEPS = 32
"""Steps of these that run together: few enough for the caches."""


def float_spikes(
    checkpoint: Checkpoint, adjacency: FloatArray, events: EventArray, *, dtype: str = "float32"
) -> dict[str, BoolArray]:
    """Spikes of every layer, (samples, steps, neurons) by name, on recordings (samples, taxels, channels, steps).

    What the first layer sees, see :func:`expand.stack_of`, is rounded to `dtype`; networks are trained in float32.
    """
    return _run(checkpoint, adjacency, events, np.dtype(dtype), membranes=False)


def float_membranes(
    checkpoint: Checkpoint, adjacency: FloatArray, events: EventArray, *, dtype: str = "float32"
) -> dict[str, npt.NDArray[np.floating]]:
    """Membranes of every layer before the comparison; as :func:`float_spikes`, (samples, steps, neurons) of `dtype`."""
    return _run(checkpoint, adjacency, events, np.dtype(dtype), membranes=True)


def _run(
    checkpoint: Checkpoint, adjacency: AnyArray, events: AnyArray, dtype: np.dtype[Any], *, membranes: bool
) -> dict[str, AnyArray]:
    if checkpoint.towers > 1:
        every = [_run(each, adjacency, events, dtype, membranes=membranes) for each in members(checkpoint)]
        return side_by_side(checkpoint, every)
    shape = (len(events), events.shape[3])
    kind = dtype if membranes else np.bool_
    kept = {name: np.empty((*shape, neurons), kind) for name, neurons in checkpoint.neurons.items()}

    def batch(start: int) -> None:
        rows = slice(start, start + BATCH)
        layers = _layers(checkpoint, adjacency, dtype)
        for first in range(0, shape[1], STEPS):
            steps = slice(first, first + STEPS)
            spikes = np.ascontiguousarray(events[rows, :, :, steps].transpose(3, 0, 1, 2), dtype)
            for name, layer in zip(checkpoint.neurons, layers, strict=True):
                spikes, compared = layer(spikes)
                if layer is layers[0]:
                    spikes, compared = _with_relays(checkpoint, spikes, compared, first)
                kept[name][rows, steps] = (compared if membranes else spikes).transpose(1, 0, 2)

    list(threads().map(batch, range(0, len(events), BATCH)))
    return kept


def _layers(
    checkpoint: Checkpoint, adjacency: AnyArray, dtype: np.dtype[Any]
) -> list[Callable[[AnyArray], tuple[AnyArray, AnyArray]]]:
    """What turns spikes of some steps into spikes and membranes of each layer, from rest at first."""
    dynamics = checkpoint.dynamics
    hops = checkpoint.hops.astype(dtype)
    propagation = adjacency.astype(dtype)
    bias = checkpoint.conv_bias.astype(dtype)
    # the bias is part of what the spikes bring, unless that outlasts its step
    inside = np.zeros_like(bias) if dynamics.alpha(0) else bias
    drives = [lambda x: _first(checkpoint.system, x, propagation, hops, inside)]
    biases = [in_order(checkpoint.system, np.tile(bias, (checkpoint.places, 1)))]
    for layer, dense in enumerate(checkpoint.dense, 1):
        weight = dense.weight.T.astype(dtype)
        bias = dense.bias.astype(dtype)
        drives.append(_linear(weight, np.zeros_like(bias) if dynamics.alpha(layer) else bias))
        biases.append(bias)
    return [
        _Neurons(drive, bias, dynamics.alpha(layer), dynamics.beta(layer, checkpoint.beta), checkpoint.theta)
        for layer, (drive, bias) in enumerate(zip(drives, biases, strict=True))
    ]


def _linear(weight: AnyArray, bias: AnyArray) -> Callable[[AnyArray], AnyArray]:
    return lambda spikes: spikes @ weight + bias


class _Neurons:
    """Neurons of a layer and their state; what arrives is what `drive` makes of spikes (steps, samples, neurons)."""

    def __init__(
        self, drive: Callable[[AnyArray], AnyArray], bias: AnyArray, alpha: float, beta: float, theta: float
    ) -> None:
        self._drive, self._bias = drive, bias if alpha else np.zeros_like(bias)
        self._constants = [bias.dtype.type(value) for value in (alpha, beta, theta)]
        self._state: AnyArray = np.zeros(0, bias.dtype)

    def __call__(self, spikes: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Spikes, zeros and ones of the float type, and membranes of some steps."""
        drive = np.ascontiguousarray(self._drive(spikes))
        if not len(self._state):
            self._state = np.zeros((2, drive[0].size), drive.dtype)
        fired = np.empty(drive.shape, np.uint8)
        rows = drive.reshape(len(drive), -1)
        _integrate(rows, np.tile(self._bias, drive.shape[1]), *self._constants, *self._state, fired.reshape(rows.shape))
        return fired.astype(drive.dtype), drive


@compiled
def _add(values: Any, more: Any) -> None:
    for i in range(len(values)):
        values[i] += more[i]


@compiled_and_cached
def _integrate(
    drive: Any, bias: Any, alpha: Any, beta: Any, theta: Any, current: Any, membrane: Any, fired: Any
) -> None:
    """Run neurons for some steps; `drive` becomes the membranes that were compared."""
    for t in range(len(drive)):
        keep(current, alpha)
        _add(current, drive[t])
        integrate_float(membrane, current, bias, beta, theta, fired[t])
        copy(membrane, drive[t])


def _with_relays(
    checkpoint: Checkpoint, spikes: AnyArray, membranes: AnyArray, first: int
) -> tuple[AnyArray, AnyArray]:
    """Add those of the relays, which spike as their clocks tick."""
    clocks = checkpoint.dynamics.clocks
    ticks = clocks.events(len(spikes), first=first).T.astype(spikes.dtype)
    relays = np.broadcast_to(ticks[:, None], (*spikes.shape[:2], clocks.channels))
    return (
        np.concatenate([spikes, relays], axis=2),
        np.concatenate([membranes, relays * (RELAY_WEIGHT * checkpoint.theta)], axis=2),
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
