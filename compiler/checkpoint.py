"""Trained weights as all systems have them: filters of the first layer, fully connected stages, constants.

Files are read and written by :mod:`compiler.formats`; :mod:`passes.expand` writes the first layer out as
synapses.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np

from spikeloom.compiler.arrays import frozen
from spikeloom.compiler.dynamics import PLAIN, Dynamics
from spikeloom.compiler.ir import Form, Readout
from spikeloom.compiler.systems import MLP, TACTILESGNET, Grid, in_order
from spikeloom.compiler.types import AnyArray, BoolArray, Float32Array, IntArray

WEIGHTS = ("last", "best", "clean")
"""Sets that our own format can hold."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dense:
    """A fully connected stage."""

    name: str  # ``fc1`` …
    # (outputs, inputs) float32; of a joined network with the inputs of one tower: no row has weights from
    # another one
    weight: Float32Array
    bias: Float32Array  # (outputs,) float32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint:
    """Trained weights, and what is known about them."""

    hops: Float32Array  # (filters, features, channels) float32; of a TactileSGNet K + 1 filters, one for each hop
    conv_bias: Float32Array  # (features,) float32
    dense: tuple[Dense, ...]  # Fully connected stages in order
    beta: float  # Membrane decay
    theta: float  # Threshold
    layout: str  # Kind of file, as its reader calls it: ``spikeloom``, ``released``, ``state_dict``
    sha256: str  # Of the file
    assumed: tuple[str, ...] = ()  # Which of ``beta`` and ``theta`` neither the file nor the user gave
    graph: str | None = None  # Name of the graph that it was trained on
    edges: IntArray | None = None  # (edges, 2) int64; its edge list, (source, target)
    weights: str = "last"  # {"last", "best", "clean"}; epoch that the weights are from
    sets: tuple[str, ...] = ("last",)  # All epochs that the file holds
    runs: int = 1  # Trainings that the file holds; this is one of them
    training: Mapping[str, Any] | None = None  # JSON values: how it was made and what it reached
    forms: tuple[Form, ...] | None = (
        None  # How the chip stores each layer, where the network was fine-tuned for it
    )
    system: str = TACTILESGNET  # One of ``SYSTEMS``
    grid: Grid | None = None  # Of a grid-based CNN
    dynamics: Dynamics = PLAIN  # Decays of single layers, and clocks
    towers: int = 1  # Networks that lie side by side and vote together, see :mod:`formats.tensors`
    bins: int = 1  # Bins of the recordings that a step joins

    @property
    def places(self) -> int:
        """Number of places that the first fully connected stage was trained on."""
        inputs = self.dense[0].weight.shape[1] - self.dynamics.clocks.channels
        return int(inputs * self.towers // self.hops.shape[1])

    @property
    def taxels(self) -> int:
        """Number of taxels of the sensor."""
        if self.grid is not None:
            return len(self.grid.cells)
        return len(self.hops) if self.system == MLP else self.places

    @property
    def classes(self) -> int:
        """Number of classes."""
        return len(self.dense[-1].bias) // self.towers

    @property
    def neurons(self) -> dict[str, int]:
        """Neurons of each layer, the relays of clocks among those of the first."""
        first = self.places * self.hops.shape[1] + self.dynamics.clocks.channels
        return {"conv1": int(first)} | {dense.name: len(dense.bias) for dense in self.dense}

    @property
    def readout(self) -> Readout:
        """The vote: each tower has one neuron for each class."""
        label = np.arange(len(self.dense[-1].bias)) % self.classes
        return Readout(population=len(self.dense), label=label)


class Weights(TypedDict):
    """Fields of a :class:`Checkpoint` that hold its weights."""

    hops: Float32Array
    conv_bias: Float32Array
    dense: tuple[Dense, ...]


def layers_of(arrays: Mapping[str, AnyArray]) -> Weights:
    """Weights from tensors by name; read-only copies."""
    layers_read = {name: frozen(np.array(array, np.float32, order="C")) for name, array in arrays.items()}
    stages = sorted(
        (
            name.removesuffix(".weight")
            for name in layers_read
            if name.startswith("fc") and name.endswith(".weight")
        ),
        key=lambda name: int(name[2:]),
    )
    dense = tuple(
        Dense(name=name, weight=layers_read[f"{name}.weight"], bias=layers_read[f"{name}.bias"])
        for name in stages
    )
    return Weights(hops=layers_read["conv1.hops"], conv_bias=layers_read["conv1.bias"], dense=dense)


def constant_faults(beta: float | None, theta: float | None) -> list[str]:
    """What is wrong about a decay or a threshold that no neuron has."""
    faults = []
    if beta is not None and not 0 <= beta < 1:
        faults.append(
            f"beta {beta:g}: allowed are 0 <= beta < 1; it is the share of the membrane that a step keeps"
        )
    if theta is not None and not 0 < theta < math.inf:
        faults.append(f"theta {theta:g}: allowed are numbers above 0; it is the threshold of a spike")
    return faults


SHARED = -1
"""Tower number of the relays of clocks, whose spikes every tower receives."""


def towers_of(checkpoint: Checkpoint) -> tuple[IntArray, ...]:
    """Tower of each neuron, one array a layer; relays of clocks are `SHARED`."""
    towers = np.arange(checkpoint.towers)
    features = np.repeat(towers, checkpoint.hops.shape[1] // checkpoint.towers)
    first = in_order(checkpoint.system, np.tile(features, (checkpoint.places, 1)))
    relays = np.full(checkpoint.dynamics.clocks.channels, SHARED)
    dense = (np.repeat(towers, len(stage.bias) // checkpoint.towers) for stage in checkpoint.dense)
    return (np.concatenate([first, relays]), *dense)


def neurons_of(tower: int, owner: IntArray) -> BoolArray:
    """Which neurons of a layer belong to a tower, those that all towers share included."""
    return np.asarray((owner == tower) | (owner == SHARED))


def merge(owners: Sequence[IntArray], parts: Sequence[Sequence[AnyArray]]) -> list[AnyArray]:
    """Values of all neurons by layer, (..., neurons), from those of each tower.

    >>> merge([np.array([0, 1, SHARED])], [[np.array([5, 9])], [np.array([7, 9])]])
    [array([5, 7, 9])]
    """
    merged = []
    for layer, owner in enumerate(owners):
        first = parts[0][layer]
        values = np.empty((*first.shape[:-1], len(owner)), first.dtype)
        for tower, part in enumerate(parts):
            values[..., neurons_of(tower, owner)] = part[layer]
        merged.append(values)
    return merged
