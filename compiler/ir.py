"""The intermediate representation: populations, projections, input and read-out of a network in real numbers.

Populations are numbered by their place in the tuple; ``INPUT`` (-1) stands for the input wherever a
projection names its source. A projection from a population to itself is recurrent: it brings the spikes of
the step before. Weights are sparse matrices whose *stored* entries are the structural synapses: a stored
zero is a synapse of weight zero. What one object can know is checked on construction, everything else in
:mod:`compiler.invariants`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from scipy import sparse

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks
from spikeloom.compiler.types import AnyArray, Float32Array, FloatArray, IntArray

INPUT = -1
"""Source id of a projection that starts at the input."""

Sparse = Any
"""A ``scipy.sparse.csr_array``; scipy ships no types."""

PART = 1 << 17
"""Synapses that are worked on at a time where that saves memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Input:
    """Event input: channel ``taxel * polarities + polarity``, then one channel for each clock.

    A step joins `bins` bins of the recordings, with an event where one of them has any.
    """

    taxels: int
    polarities: int
    clocks: Clocks = NO_CLOCKS
    bins: int = 1

    @property
    def size(self) -> int:
        """Number of channels."""
        return self.taxels * self.polarities + self.clocks.channels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Readout:
    """Spike-count vote over one population."""

    population: int  # Index of the population that votes
    label: (
        IntArray  # (neurons,) int64; class that each votes for; most spikes win, the lowest index on a tie
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Population:
    """LIF neurons of the float model.

    ``i <- alpha * i + W s``, ``u <- beta * u * (1 - s) + i + bias``, ``s = u > theta``.
    """

    name: str  # Unique in the network
    beta: float  # Decay, 0 to 1
    theta: float  # Threshold, in the model's membrane units
    bias: FloatArray  # (neurons,) float64; added in every step
    alpha: float = 0.0  # Share of the synaptic current that a step keeps, 0 to below 1
    relays: int = (
        0  # Neurons at the end that relay a clock each: whatever is rounded, they must spike when it ticks
    )

    @property
    def size(self) -> int:
        """Number of neurons."""
        return len(self.bias)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """Synapses from one population to another, or to itself."""

    pre: int  # Index of the source population, or ``INPUT``
    post: int  # Index of the target; if it is the source, spikes of a step arrive in the next one
    weight: Sparse  # ``weight[i, j]`` is from neuron j of `pre` to neuron i of `post`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Form:
    """How one population is stored."""

    bits: int  # Storage width of a mantissa
    exponents: tuple[int, ...]  # Exponent of each plane, finest first
    threshold: IntArray  # (neurons,) int64; threshold mantissas, at least 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Convolution:
    """The first layer as it was trained: filters that all its places share, see :mod:`compiler.systems`.

    Sums of float32 depend on their order. With the filters a network can be run in the order in which it was
    trained, and trained further, while its projections hold the same weights, written out synapse by synapse
    in float64.
    """

    system: str  # One of ``SYSTEMS``
    filters: Float32Array  # (filters, features, channels)
    bias: Float32Array  # (features,)
    # Of a TactileSGNet the normalised adjacency A, (taxels, taxels); else the stack (filters, places,
    # taxels)
    propagation: FloatArray
    towers: tuple[IntArray, ...] = ()  # Of a joined network, by layer: see :func:`checkpoint.towers_of`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Network:
    """A spiking network in real numbers."""

    input: Input
    populations: tuple[Population, ...]
    projections: tuple[Projection, ...]
    readout: Readout
    classes: int
    forms: tuple[Form, ...] | None = (
        None  # How the chip stores each population, where it was fine-tuned for it
    )
    # Where it comes from a checkpoint; whatever changes weights leaves it out. Not printed: it says nothing
    # new
    convolution: Convolution | None = field(default=None, repr=False)


class Neurons(Protocol):
    """A population in any kind of numbers."""

    @property
    def name(self) -> str:
        """Unique in the network."""

    @property
    def size(self) -> int:
        """Number of neurons."""


class Synapses(Protocol):
    """A projection in any kind of numbers."""

    @property
    def pre(self) -> int:
        """Index of the source population, or ``INPUT``."""

    @property
    def post(self) -> int:
        """Index of the target."""

    @property
    def weight(self) -> Sparse:
        """From neuron (column) to neuron (row)."""


class Graph(Protocol):
    """A network in any kind of numbers, real ones or a chip's."""

    @property
    def input(self) -> Input:
        """What it receives."""

    @property
    def populations(self) -> Sequence[Neurons]:
        """In an order in which all but their own spikes run forward."""

    @property
    def projections(self) -> Sequence[Synapses]:
        """Between them."""

    @property
    def readout(self) -> Readout:
        """What votes."""

    @property
    def classes(self) -> int:
        """Number of classes."""


def depths(network: Graph) -> tuple[int, ...]:
    """Steps that each population lags behind the data: the longest path from the input, loops aside, minus one."""
    depth = [0] * len(network.populations)
    for post in range(len(network.populations)):
        sources = [projection.pre for projection in network.projections if projection.post == post]
        depth[post] = max((depth[pre] + 1 for pre in sources if pre not in (INPUT, post)), default=0)
    return tuple(depth)


def recurrent(network: Graph) -> tuple[str, ...]:
    """Names of the populations that receive their own spikes."""
    loops = {projection.post for projection in network.projections if projection.pre == projection.post}
    return tuple(network.populations[post].name for post in sorted(loops))


def fan_in(network: Graph, post: int) -> IntArray:
    """Structural synapses into each neuron of a population, planes of one synapse counted once; shape (neurons,)."""
    into = ((p.pre, p.weight) for p in network.projections if p.post == post)
    ones = added_up((pre, with_data(weight, np.ones(weight.nnz, np.bool_))) for pre, weight in into)
    nothing = np.zeros(network.populations[post].size, np.int64)
    return sum((np.diff(weight.indptr) for weight in ones.values()), start=nothing)


def added_up(weights: Iterable[tuple[int, Sparse]]) -> dict[int, Sparse]:
    """Weights from each source, those of several planes together."""
    total: dict[int, Sparse] = {}
    for pre, weight in weights:
        total[pre] = total[pre] + weight if pre in total else weight
    return total


def with_data(weight: Sparse, data: AnyArray) -> Sparse:
    """A csr_array of other numbers that shares its structure with `weight`: change neither in place."""
    return sparse.csr_array((data, weight.indices, weight.indptr), shape=weight.shape)


def entry_parts(weight: Sparse) -> Iterator[slice]:
    """Synapses of a matrix in turn, ``PART`` at a time."""
    return (slice(first, first + PART) for first in range(0, weight.nnz, PART))


def row_parts(weight: Sparse) -> Iterator[slice]:
    """Rows of a matrix in turn, so many that they hold about ``PART`` synapses.

    >>> list(row_parts(sparse.csr_array((2, 5))))
    [slice(0, 2, None)]
    """
    first = 0
    rows = weight.shape[0]
    while first < rows:
        last = int(np.searchsorted(weight.indptr, weight.indptr[first] + PART, side="right")) - 1
        last = min(max(last, first + 1), rows)
        yield slice(first, last)
        first = last
