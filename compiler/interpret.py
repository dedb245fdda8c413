"""The meaning of the intermediate representation: layer by layer over all time steps.

What a step's spikes bring is summed, then the neurons integrate, compare and reset. A recurrent population
also receives what it fired in the step before.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import ir
from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks, with_clocks
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, IntArray

if TYPE_CHECKING:
    from spikeloom.compiler.layer_kernel import Raster, Synapses

BATCH = 8
"""Recordings that run together, on one core."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Activity:
    """Spikes of each population, and the values that were compared with the threshold."""

    spikes: tuple[BoolArray, ...]  # One array per population, all aligned with the data
    # Membrane before the reset, where it is kept; floats in model units, or int64 register values
    membranes: tuple[AnyArray, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """A population ready to run: it receives from `pres`, and from itself if it is recurrent."""

    pres: tuple[int, ...]
    size: int
    # What :func:`layer_kernel.run_layer` takes between the raster of `pres` and what it fills
    fixed: tuple[Any, ...]

    def run(self, sources: Sequence[BoolArray], *, membranes: bool = False) -> tuple[BoolArray, AnyArray]:
        """Spikes, and membranes if wanted, of recordings from the spikes of `pres`, all (samples, steps, neurons)."""
        shape = *sources[0].shape[:2], self.size
        spikes = np.empty(shape, np.bool_)
        kept = np.empty(shape if membranes else _NONE, self._kind)
        unused = np.empty(_NONE, np.uint8), np.empty((0, 0), np.uint64), np.zeros((2, 0), np.int32)
        self._run(raster(sources), spikes.view(np.uint8), kept, *unused)
        return spikes, kept

    def moved(self, sources: Raster, wanted: EventArray) -> npt.NDArray[np.int32]:
        """In how many steps each neuron differs from what is `wanted`, and how many spikes more it has; (2, neurons).

        `wanted` (samples, steps, bytes) has a bit for each neuron, the first lowest.
        """
        moved = np.zeros((2, self.size), np.int32)
        words = np.zeros((2, wanted.shape[2]), np.uint64)  # of eight neurons, which are compared at once
        unkept = np.empty(_NONE, self._kind)
        self._run(sources, words.view(np.uint8)[None], unkept, np.ascontiguousarray(wanted), words, moved)
        return moved

    def _run(self, *arrays: Any) -> None:
        from spikeloom.compiler.layer_kernel import require_below, run_layer

        require_below("source", arrays[0].source, len(self.fixed[0].run) - 1)
        state = np.empty((3, self.size), self._kind)
        listed = np.empty(self.size, np.int32)
        run_layer(arrays[0], *self.fixed, state, listed, *arrays[1:])

    def with_bias(self, bias: AnyArray) -> Layer:
        """The same neurons with another bias, (neurons,)."""
        return replace(self, fixed=(*self.fixed[:2], bias.astype(self._kind), *self.fixed[3:]))

    @property
    def _kind(self) -> np.dtype[Any]:
        bias: AnyArray = self.fixed[2]
        return bias.dtype


_NONE = (0, 0, 0)


def raster(sources: Sequence[BoolArray]) -> Raster:
    """Spikes of several populations, (samples, steps, neurons) each, as a layer's kernel reads them."""
    from spikeloom.compiler.layer_kernel import raster_of

    return raster_of(sources[0] if len(sources) == 1 else np.concatenate(sources, axis=2))


def float_layer(
    population: ir.Population,
    projections: Sequence[ir.Projection],
    dtype: npt.DTypeLike = np.float64,
    *,
    loops: bool = True,
) -> Layer:
    """A float population with all projections to it, in the arithmetic of `dtype`.

    Without `loops` its own spikes are given from outside, like those of other populations.
    """
    registers = tuple(np.array([population.alpha, population.beta, population.theta], dtype))
    pres, synapses = synapses_of([(p, p.weight) for p in projections], dtype, loops=loops)
    return Layer(
        pres=pres, size=population.size, fixed=(*synapses, population.bias.astype(dtype), registers)
    )


def synapses_of(
    weights: Sequence[tuple[Any, ir.Sparse]], dtype: npt.DTypeLike, *, loops: bool = True
) -> tuple[tuple[int, ...], tuple[Synapses, Synapses]]:
    """Presynaptic populations; weights from these, and from the population itself, all planes together."""
    from spikeloom.compiler.layer_kernel import by_source, no_synapses

    merged = ir.added_up((projection.pre, weight) for projection, weight in weights)
    recurrent = merged.pop(weights[0][0].post, None) if loops and weights else None
    itself = no_synapses(dtype) if recurrent is None else by_source([recurrent], dtype)
    return tuple(merged), (by_source(list(merged.values()), dtype), itself)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation:
    """A network ready to run."""

    layers: tuple[Layer, ...]

    def run(self, events: BoolArray, *, membranes: bool = False) -> Activity:
        """Run recordings (samples, steps, channels), each from rest, some at a time on all cores."""

        def batch(start: int) -> list[tuple[BoolArray, AnyArray]]:
            done: list[tuple[BoolArray, AnyArray]] = []
            for layer in self.layers:
                sources = [
                    events[start : start + BATCH] if pre == ir.INPUT else done[pre][0] for pre in layer.pres
                ]
                done.append(layer.run(sources, membranes=membranes))
            return done

        by_layer = list(zip(*threads().map(batch, range(0, len(events), BATCH)), strict=True))
        spikes = tuple(np.concatenate([spikes for spikes, _ in layer]) for layer in by_layer)
        kept = (np.concatenate([kept for _, kept in layer]) for layer in by_layer if membranes)
        return Activity(spikes=spikes, membranes=tuple(kept))


@cache
def threads() -> ThreadPoolExecutor:
    """One for each core, started once."""
    return ThreadPoolExecutor(os.cpu_count())


def float_simulation(network: ir.Network, dtype: npt.DTypeLike = np.float64) -> Simulation:
    """The float stage, in the arithmetic of `dtype`."""
    into = [[p for p in network.projections if p.post == post] for post in range(len(network.populations))]
    return Simulation(
        layers=tuple(float_layer(*each, dtype) for each in zip(network.populations, into, strict=True))
    )


def run_float(
    network: ir.Network, events: BoolArray, *, dtype: npt.DTypeLike = np.float64, membranes: bool = False
) -> Activity:
    """Run the float stage on events (samples, steps, channels), in the arithmetic of `dtype`."""
    return float_simulation(network, dtype).run(events, membranes=membranes)


def step_late(spikes: BoolArray) -> BoolArray:
    """Spikes (samples, steps, neurons) as their own population receives them: each in the step after.

    >>> step_late(np.array([[[True], [False], [True]]])).ravel().tolist()
    [False, True, False]
    """
    late = np.zeros_like(spikes)
    late[:, 1:] = spikes[:, :-1]
    return late


def channels_last(events: AnyArray, clocks: Clocks = NO_CLOCKS) -> BoolArray:
    """Recordings (samples, taxels, polarities, steps) as the (samples, steps, channels) used here, clocks last."""
    return np.ascontiguousarray(with_clocks(events, clocks).transpose(0, 2, 1)).astype(np.bool_)


def cut(spikes: BoolArray, lengths: IntArray | None) -> BoolArray:
    """Take away spikes (samples, steps, neurons) after the end of each recording; None where all are equally long.

    Where nothing is to be taken away, the same array comes back.

    >>> cut(np.ones((2, 3, 1), bool), np.array([3, 1])).sum(axis=1).ravel().tolist()
    [3, 1]
    """
    if lengths is None or np.all(lengths >= spikes.shape[1]):
        return spikes
    return spikes & (np.arange(spikes.shape[1]) < lengths[:, None])[:, :, None]


def vote(counts: IntArray) -> IntArray:
    """Class of each sample from its spike counts (samples, classes): most spikes, lowest index on a tie.

    >>> vote(np.array([[1, 3, 3], [0, 0, 0]])).tolist()
    [1, 0]
    """
    return np.asarray(np.argmax(counts, axis=1))
