"""The float model of a checkpoint, in the released operator order, as ``verify`` compares the chip with it.

Released order: hop 0 first, then one propagation and one linear map per hop, added up, bias last; then the
recurrence. In float32 this gives every spike of the released code on the released test recordings. A GCN is mapped
first and then propagated, as torch_geometric does it; the sums of the others are one product. Towers of a joined
network run one after the other, so that each has every spike that it has alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import RELAY_WEIGHT
from spikeloom.compiler.formats.tensors import members, side_by_side
from spikeloom.compiler.systems import GCN, TACTILESGNET, feature_major, in_order
from spikeloom.models.networks.layers import filter_places, lasting_current, lif, tag_convolution
from spikeloom.models.networks.networks import relayed

BATCH = 8
"""Recordings that run together: few enough for the caches."""

DTYPES = {"float32": torch.float32, "float64": torch.float64}


def _layers(
    checkpoint: Checkpoint, adjacency: npt.NDArray[np.float64], events: npt.NDArray[np.uint8], dtype: str
) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
    """Name, spikes and membranes of each layer, (steps, samples, neurons)."""
    kind = DTYPES[dtype]

    def tensor(array: npt.NDArray[np.generic]) -> torch.Tensor:
        return torch.tensor(np.ascontiguousarray(array), dtype=kind)

    def neurons(layer: int, drive: torch.Tensor, bias: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        alpha = dynamics.alpha(layer)
        current = lasting_current(drive, alpha) + bias if alpha else drive
        return lif(current, dynamics.beta(layer, checkpoint.beta), checkpoint.theta)

    def inside(layer: int, bias: torch.Tensor) -> torch.Tensor:
        """The bias as part of what the spikes bring, unless that outlasts its step."""
        return torch.zeros_like(bias) if dynamics.alpha(layer) else bias

    dynamics = checkpoint.dynamics
    x = tensor(events.transpose(3, 0, 1, 2))
    bias = tensor(checkpoint.conv_bias)
    drive = _first(checkpoint.system, x, tensor(adjacency), tensor(checkpoint.hops), inside(0, bias))
    spikes, membranes = neurons(0, drive, _of_neurons(checkpoint, bias))
    if dynamics.clocks.channels:
        ticks = relayed(dynamics.clocks, spikes)
        spikes = torch.cat([spikes, ticks], dim=2)
        membranes = torch.cat([membranes, ticks * (RELAY_WEIGHT * checkpoint.theta)], dim=2)
    yield "conv1", spikes, membranes
    for layer, dense in enumerate(checkpoint.dense, 1):
        bias = tensor(dense.bias)
        drive = torch.nn.functional.linear(spikes, tensor(dense.weight), inside(layer, bias))
        spikes, membranes = neurons(layer, drive, bias)
        yield dense.name, spikes, membranes


def _of_neurons(checkpoint: Checkpoint, bias: torch.Tensor) -> torch.Tensor:
    """Biases of the features as those of the first layer's neurons, in the order of the system."""
    turned: torch.Tensor = in_order(checkpoint.system, bias.repeat(checkpoint.places, 1))
    return turned


def _first(system: str, x: torch.Tensor, propagation: torch.Tensor, hops: torch.Tensor, bias: torch.Tensor) -> Any:
    """Currents of the first layer, (steps, samples, neurons), in the order of the system's neurons."""
    if system == TACTILESGNET:
        return tag_convolution(x, propagation, hops, bias)
    if system == GCN:
        return (propagation[0] @ (x @ hops[0].t()) + bias).flatten(2)
    current = filter_places(x, propagation, hops, bias)
    if feature_major(system):
        return current.view(*current.shape[:2], -1, len(bias)).transpose(2, 3).flatten(2)
    return current


def float_spikes(
    checkpoint: Checkpoint,
    adjacency: npt.NDArray[np.float64],
    events: npt.NDArray[np.uint8],
    *,
    dtype: str = "float32",
) -> dict[str, npt.NDArray[np.bool_]]:
    """Spikes of every layer, (samples, steps, neurons) by name, on recordings (samples, taxels, channels, steps).

    What the first layer sees, see :func:`expand.stack_of`, is rounded to `dtype`; networks are trained in float32.
    """
    if checkpoint.towers > 1:
        return side_by_side(checkpoint, [float_spikes(m, adjacency, events, dtype=dtype) for m in members(checkpoint)])
    batches: dict[str, list[npt.NDArray[np.bool_]]] = {}
    with torch.no_grad():
        for start in range(0, len(events), BATCH):
            for name, spikes, _ in _layers(checkpoint, adjacency, events[start : start + BATCH], dtype):
                batches.setdefault(name, []).append(spikes.bool().transpose(0, 1).numpy())
    return {name: np.concatenate(parts) for name, parts in batches.items()}


def float_membranes(
    checkpoint: Checkpoint,
    adjacency: npt.NDArray[np.float64],
    events: npt.NDArray[np.uint8],
    *,
    dtype: str = "float32",
) -> dict[str, npt.NDArray[np.floating]]:
    """Membranes of every layer before the comparison; as :func:`float_spikes`, (samples, steps, neurons) of `dtype`."""
    if checkpoint.towers > 1:
        every = [float_membranes(m, adjacency, events, dtype=dtype) for m in members(checkpoint)]
        return side_by_side(checkpoint, every)
    with torch.no_grad():
        return {
            name: membranes.transpose(0, 1).contiguous().numpy()
            for name, _, membranes in _layers(checkpoint, adjacency, events, dtype)
        }
