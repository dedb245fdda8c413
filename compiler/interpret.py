"""The meaning of the intermediate representation: layer by layer over all time steps.

One matrix product per projection, then the recurrence. A recurrent population takes a further product in each
step: what it fired in the step before arrives together with what others send. The integer stage is exact: products run
in floating point only where every partial sum is an integer that the type holds (below 2**24 in float32, 2**53 in
float64).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks, with_clocks
from spikeloom.compiler.fixedpoint import MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.ir import (
    INPUT,
    IntegerNetwork,
    IntegerPopulation,
    IntegerProjection,
    Network,
    Population,
    Sparse,
)
from spikeloom.compiler.types import BoolArray, IntArray

Floating = npt.NDArray[np.floating[Any]]

BATCH = 8
"""Recordings that run together: one layer's membranes then stay in cache."""

DENORMAL = 1e-30
"""Membranes and currents below this are flushed to zero; beside a threshold they are nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Activity:
    """Spikes of each population, and the values that were compared with the threshold."""

    spikes: tuple[BoolArray, ...]  # One array per population, all aligned with the data
    # Membrane before the reset; float64 in model units, or int64 register values
    membranes: tuple[npt.NDArray[Any], ...] | None


def product(weight: Sparse, spikes: BoolArray, dtype: npt.DTypeLike) -> Floating:
    """Synaptic sums of every step, (samples, steps, post) of `dtype`, from (samples, steps, pre) spikes."""
    samples, steps, n_pre = spikes.shape
    dense = weight.toarray().astype(dtype)
    sums: Floating = spikes.reshape(samples * steps, n_pre).astype(dtype) @ dense.T
    return sums.reshape(samples, steps, -1)


def integer_sums(weight: Sparse, spikes: BoolArray) -> Floating:
    """Exact synaptic sums of integer weights, in a floating type that holds each of them; (samples, steps, n_post)."""
    largest = int(abs(weight).sum(axis=1).max(initial=0))
    return product(weight, spikes, np.float32 if largest < 2**24 else np.float64)


def step_late(spikes: BoolArray) -> BoolArray:
    """Spikes (samples, steps, neurons) as their own population receives them: each in the step after.

    Examples
    --------
    >>> step_late(np.array([[[True], [False], [True]]])).ravel().tolist()
    [False, True, False]
    """
    late = np.zeros_like(spikes)
    late[:, 1:] = spikes[:, :-1]
    return late


def float_recurrence(
    population: Population, sums: Floating, *, own: Floating | None = None, membranes: bool = False
) -> tuple[BoolArray, Floating | None]:
    """LIF of the definition in :class:`ir.Population` on given synaptic sums, in their type.

    `sums` is overwritten. `own` (neurons, neurons), of the same type, is from each neuron (row) of a recurrent
    population to each.
    """
    bias = population.bias.astype(sums.dtype)
    alpha, beta, theta = (sums.dtype.type(value) for value in (population.alpha, population.beta, population.theta))
    in_steps = own is not None or population.alpha > 0  # else all steps get their bias at once
    current = sums
    if not in_steps:
        current += bias
    held, u = np.zeros((2, *current[:, 0].shape), current.dtype)
    spikes = np.empty(current.shape, np.bool_)
    kept = np.empty_like(current) if membranes else None
    for step in range(current.shape[1]):
        if in_steps:
            held *= alpha
            held += current[:, step]
            if own is not None and step:
                held += spikes[:, step - 1].astype(held.dtype) @ own
            np.add(held, bias, out=current[:, step])
        u *= beta
        u += current[:, step]
        fired = np.greater(u, theta, out=spikes[:, step])
        if kept is not None:
            kept[:, step] = u
        u *= ~fired
        if step % 16 == 15:
            # What decays ends in denormals, which cost a hundred times a normal operation.
            u[np.abs(u) < DENORMAL] = 0
            if in_steps:
                held[np.abs(held) < DENORMAL] = 0
    return spikes, kept


def integer_recurrence(
    population: IntegerPopulation,
    sums: Floating,
    *,
    own: Floating | None = None,
    membranes: bool = False,
    saturates: bool = True,
) -> tuple[BoolArray, IntArray | None]:
    """The chip's compartment on given synaptic sums (in weight units); the machine's ``spec`` holds the definition.

    Runs in float64, exactly: registers times a 12-bit factor stay below 2**36, a product with 2**-12 only moves the
    point, and truncation is the chip's rounding toward zero. With `saturates` off the membrane has no limits, which
    tells what saturation does. `own` as in :func:`float_recurrence`, in weight units.
    """
    spikes = np.empty(sums.shape, np.bool_)
    kept = np.empty(sums.shape, np.int64) if membranes else None
    threshold = (population.threshold << MEMBRANE_SHIFT).astype(np.float64)
    bias = population.bias.astype(np.float64)
    keep_u, keep_v = population.realised_alpha, population.realised_beta
    u = np.zeros(sums.shape[::2])
    v = np.zeros_like(u)
    inflow = np.empty_like(u)
    for step in range(sums.shape[1]):
        arrived = sums[:, step]
        if own is not None and step:
            arrived = arrived + spikes[:, step - 1].astype(own.dtype) @ own
        np.multiply(arrived, 1 << MEMBRANE_SHIFT, out=inflow)
        if keep_u:
            u *= keep_u
            np.trunc(u, out=u)
            u += inflow
        else:
            u = inflow
        v *= keep_v
        np.trunc(v, out=v)
        v += u
        v += bias
        if saturates:
            np.clip(v, -MEMBRANE_MAX, MEMBRANE_MAX, out=v)
        fired = np.greater(v, threshold, out=spikes[:, step])
        if kept is not None:
            kept[:, step] = v
        v *= ~fired
    return spikes, kept


def run_float(
    network: Network, events: BoolArray, *, dtype: npt.DTypeLike = np.float64, membranes: bool = False
) -> Activity:
    """Run the float stage on events (samples, steps, channels), in the arithmetic of `dtype`."""

    def layer(post: int, sums: Floating, own: Floating | None) -> tuple[BoolArray, Floating | None]:
        return float_recurrence(network.populations[post], sums, own=own, membranes=membranes)

    def sums(weight: Sparse, spikes: BoolArray) -> Floating:
        return product(weight, spikes, dtype)

    return _run(network, events, lambda p: p.weight, sums, layer, dtype)


def run_integer(
    network: IntegerNetwork, events: BoolArray, *, membranes: bool = False, saturates: bool = True
) -> Activity:
    """Run the integer stage, aligned with the data; membranes are register values."""

    def layer(post: int, sums: Floating, own: Floating | None) -> tuple[BoolArray, IntArray | None]:
        return integer_recurrence(network.populations[post], sums, own=own, membranes=membranes, saturates=saturates)

    return _run(network, events, IntegerProjection.effective, integer_sums, layer, np.float64)


def _run(
    network: Network | IntegerNetwork,
    events: BoolArray,
    weight_of: Callable[[Any], Sparse],
    sums_of: Callable[[Sparse, BoolArray], Floating],
    layer: Callable[[int, Floating, Floating | None], tuple[BoolArray, npt.NDArray[Any] | None]],
    dtype: npt.DTypeLike,
) -> Activity:
    """Run batch by batch on all cores, population by population."""
    # weights of each population to itself, (from, to), all planes together; None if it is not recurrent
    own: list[Floating | None] = [None] * len(network.populations)
    for p in network.projections:
        if p.pre == p.post:
            weight, before = np.ascontiguousarray(weight_of(p).toarray().astype(dtype).T), own[p.post]
            own[p.post] = weight if before is None else before + weight

    def batch(part: BoolArray) -> list[tuple[BoolArray, npt.NDArray[Any] | None]]:
        done: list[tuple[BoolArray, npt.NDArray[Any] | None]] = []
        for post in range(len(network.populations)):
            sums: Floating | None = None
            for projection in network.projections:
                if projection.post == post != projection.pre:
                    source = part if projection.pre == INPUT else done[projection.pre][0]
                    more = sums_of(weight_of(projection), source)
                    sums = more if sums is None else sums + more
            assert sums is not None, "verify: every population is reached"
            done.append(layer(post, sums, own[post]))
        return done

    parts = [events[i : i + BATCH] for i in range(0, len(events), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(batch, parts))
    spikes = tuple(np.concatenate([result[i][0] for result in results]) for i in range(len(network.populations)))
    if any(trace is None for _, trace in results[0]):
        return Activity(spikes=spikes, membranes=None)
    traces = [np.concatenate([np.asarray(r[i][1]) for r in results]) for i in range(len(network.populations))]
    return Activity(spikes=spikes, membranes=tuple(traces))


def channels_last(events: npt.NDArray[Any], clocks: Clocks = NO_CLOCKS) -> BoolArray:
    """Recordings (samples, taxels, polarities, steps) as the (samples, steps, channels) used here, clocks last."""
    return np.ascontiguousarray(with_clocks(events, clocks).transpose(0, 2, 1)).astype(np.bool_)


def cut(spikes: BoolArray, lengths: IntArray | None) -> BoolArray:
    """Take away spikes (samples, steps, neurons) after the end of each recording; None where all are equally long.

    Examples
    --------
    >>> cut(np.ones((2, 3, 1), bool), np.array([3, 1])).sum(axis=1).ravel().tolist()
    [3, 1]
    """
    return spikes if lengths is None else spikes & (np.arange(spikes.shape[1]) < lengths[:, None])[:, :, None]


def vote(counts: IntArray) -> IntArray:
    """Class of each sample from its spike counts (samples, classes): most spikes, lowest index on a tie.

    Examples
    --------
    >>> vote(np.array([[1, 3, 3], [0, 0, 0]])).tolist()
    [1, 0]
    """
    winner: IntArray = np.argmax(counts, axis=1)
    return winner
