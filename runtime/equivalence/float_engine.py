"""The float network driven by its events: as fast as the chip's engine, for runs by the thousand.

What :func:`interpret.run_float` means, in float32, without a dense product: a spike adds the weights that it
has to others, source by source, those of the layer itself after all others, and the bias comes last. Sums are taken in
another order than in the released code, so that a spike decided by the last bit of a sum may differ from
:mod:`reference`; ``verify`` counts such spikes as ill-posed, and the released network has none.

Spikes are handed back at a bit each, at the place and in the chip step in which the chip would fire them: a trace of
the chip (``Trace.packed``) is compared word by word.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist
from spikeloom.compiler.ir import INPUT, Network, Projection
from spikeloom.compiler.layer_kernel import DENORMAL
from spikeloom.compiler.types import IntArray

Floats = npt.NDArray[np.float32]
Words = npt.NDArray[np.uint64]
AnyArray = npt.NDArray[Any]

NOWHERE = -1
"""Seat of a neuron that the chip does not hold."""


class Runs(NamedTuple):
    """Weights by source: bounds of each source's runs of neighbouring targets; of each run the first target and weight.

    Shapes: (sources + 1,), (runs,), (runs + 1,) and, float32, (synapses,).
    """

    run: IntArray
    target: IntArray
    offset: IntArray
    weight: Floats


_NONE = np.zeros(0, np.int64)
NO_RUNS = Runs(_NONE, _NONE, _NONE, _NONE.astype(np.float32))
"""Of no source."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """One population, prepared.

    `pres` are its other presynaptic populations, ``INPUT`` for the input, whose neurons are numbered one after the
    other in `runs`; `own` are its recurrent weights. It lags `depth` chip steps behind the data, `late` of them beyond
    the one that follows the layer before, which cost it as many steps of its input. `seat` is each neuron's compartment
    or ``NOWHERE``; those whose spikes reach no neuron are not `compared` with the chip's.
    """

    pres: tuple[int, ...]
    runs: Runs
    own: Runs
    bias: Floats
    beta: float
    theta: float
    alpha: float
    depth: int
    late: int
    seat: IntArray
    compared: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloatEngine:
    """A float network prepared by :func:`prepare`; holds no state."""

    network: Network
    netlist: Netlist
    layers: tuple[Layer, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloatRun:
    """What recordings brought.

    Votes (recordings, classes); spikes (recordings, layers) that are compared with the chip's, and those of them by
    neurons that it does not hold (`elsewhere`); all spikes (recordings, chip steps, words), as in ``Trace.packed``.
    """

    votes: IntArray
    spikes: IntArray
    elsewhere: IntArray
    packed: Words


def prepare(network: Network, netlist: Netlist) -> FloatEngine:
    """Lay a float network out for runs beside a netlist of the same populations."""
    depth = [layer.depth for layer in netlist.layers]
    layers = []
    for post, population in enumerate(network.populations):
        into = [p for p in network.projections if p.post == post != p.pre]
        itself = [p for p in network.projections if p.post == post == p.pre]
        pres = tuple(dict.fromkeys(projection.pre for projection in into))
        sizes = {pre: network.input.size if pre == INPUT else network.populations[pre].size for pre in pres}
        seat, compared = np.full(population.size, NOWHERE), np.ones(population.size, np.bool_)
        ids = netlist.compartments_of(post)
        seat[netlist.neuron[ids]] = ids
        compared[list(netlist.layers[post].unread)] = False
        before = max((-1 if pre == INPUT else depth[pre] for pre in pres), default=-1)
        layers.append(
            Layer(
                pres=pres,
                runs=_runs(into, sizes),
                own=_runs(itself, {post: population.size}) if itself else NO_RUNS,
                bias=population.bias.astype(np.float32),
                beta=population.beta,
                theta=population.theta,
                alpha=population.alpha,
                depth=depth[post],
                late=depth[post] - before - 1,
                seat=seat,
                compared=compared,
            )
        )
    return FloatEngine(network=network, netlist=netlist, layers=tuple(layers))


def _runs(into: list[Projection], sizes: dict[int, int]) -> Runs:
    """Weights of all projections by source."""
    first = dict(zip(sizes, np.cumsum([0, *sizes.values()]).tolist(), strict=False))
    row = np.concatenate([np.repeat(np.arange(p.weight.shape[0]), np.diff(p.weight.indptr)) for p in into])
    column = np.concatenate([p.weight.indices + first[p.pre] for p in into])
    data = np.concatenate([p.weight.data for p in into]).astype(np.float32)
    # a stable order by source keeps targets ascending within one projection
    order = np.argsort(column, kind="stable")
    row, column, data = row[order], column[order], data[order]
    begins = np.ones(len(row), np.bool_)
    begins[1:] = (np.diff(column) != 0) | (np.diff(row) != 1)
    offset = np.flatnonzero(begins)
    run = np.searchsorted(column[offset], np.arange(sum(sizes.values()) + 1))
    return Runs(run, row[offset].astype(np.int64), np.append(offset, len(row)), data)


def run(
    engine: FloatEngine,
    inputs: npt.NDArray[np.uint8],
    *,
    lengths: IntArray | None = None,
    begin: IntArray | None = None,
) -> FloatRun:
    """Run a batch of recordings, each from rest.

    `inputs` (recordings, channels, T) uint8 holds the events of all input channels, clocks among them; recordings may
    be shorter, `lengths` (recordings,). Spikes count from the data step `begin` (recordings,) on, the first by default;
    ``packed`` holds all of them.
    """
    n, _, steps = inputs.shape
    ends = np.full(n, steps) if lengths is None else lengths
    begins = np.zeros(n, np.int64) if begin is None else begin
    layers, netlist, readout = len(engine.layers), engine.netlist, engine.network.readout
    sizes = {INPUT: engine.network.input.size} | {i: len(layer.bias) for i, layer in enumerate(engine.layers)}
    found = FloatRun(
        votes=np.zeros((n, engine.network.classes), np.int64),
        spikes=np.zeros((n, layers), np.int64),
        elsewhere=np.zeros((n, layers), np.int64),
        packed=np.zeros((n, steps + netlist.max_depth, -(-netlist.n_compartments // 64)), np.uint64),
    )
    for index in range(n):
        step, channel = np.nonzero(inputs[index, :, : ends[index]].T)
        sent = {INPUT: (channel.astype(np.int32), np.searchsorted(step, np.arange(ends[index] + 1)))}
        for number, layer in enumerate(engine.layers):
            source, bounds = _arrivals(layer.pres, sent, sizes)
            counts = np.zeros(sizes[number], np.int64)
            sent[number] = _integrate_layer(
                source,
                bounds,
                layer.late,
                layer.runs,
                layer.own,
                layer.bias,
                np.float32(layer.beta),
                np.float32(layer.theta),
                np.float32(layer.alpha),
                layer.seat,
                found.packed[index, layer.depth : layer.depth + ends[index]],
                int(begins[index]),
                counts,
            )
            found.spikes[index, number] = counts[layer.compared].sum()
            found.elsewhere[index, number] = counts[layer.compared & (layer.seat == NOWHERE)].sum()
            if number == readout.population:
                np.add.at(found.votes[index], readout.label, counts)
    return found


def _arrivals(
    pres: tuple[int, ...], sent: dict[int, tuple[AnyArray, IntArray]], sizes: dict[int, int]
) -> tuple[AnyArray, IntArray]:
    """Spikes that reach a layer, step after step; of several populations, one after the other."""
    if len(pres) == 1:
        return sent[pres[0]]
    firsts = np.cumsum([0, *(sizes[pre] for pre in pres)]).tolist()
    lengths = [np.diff(sent[pre][1]) for pre in pres]
    step = np.concatenate([np.repeat(np.arange(len(length)), length) for length in lengths])
    source = np.concatenate([sent[pre][0] + first for pre, first in zip(pres, firsts, strict=False)])
    return source[np.argsort(step, kind="stable")], np.append(0, np.cumsum(np.sum(lengths, axis=0)))


# Each step is a function of its own on one-dimensional arrays: only so does the compiler vectorise the loops.


@numba.njit(cache=True, nogil=True)
def _add(total: Any, first: Any, weight: Any, begin: Any, length: Any) -> None:
    # unsigned, so that no index may count from the end: only then is the loop vectorised
    for i in range(np.uint64(length)):
        total[np.uint64(first) + i] += weight[np.uint64(begin) + i]


@numba.njit(cache=True, nogil=True)
def _arrive(total: Any, runs: Any, source: Any, begin: Any, end: Any) -> None:
    for event in range(begin, end):
        for r in range(runs.run[source[event]], runs.run[source[event] + 1]):
            _add(total, runs.target[r], runs.weight, runs.offset[r], runs.offset[r + 1] - runs.offset[r])


@numba.njit(cache=True, nogil=True)
def _keep(current: Any, alpha: Any) -> None:
    for i in range(len(current)):
        current[i] *= alpha


@numba.njit(cache=True, nogil=True)
def _integrate(membrane: Any, current: Any, bias: Any, beta: Any, theta: Any, fired: Any) -> None:
    zero = membrane.dtype.type(0)
    for i in range(len(bias)):
        u = (zero if membrane[i] > theta else membrane[i] * beta) + (current[i] + bias[i])
        membrane[i] = u
        fired[i] = u > theta


@numba.njit(cache=True, nogil=True)
def _flush(values: Any, least: Any) -> None:
    zero = values.dtype.type(0)
    for i in range(len(values)):
        values[i] = zero if abs(values[i]) < least else values[i]


@numba.njit(cache=True, nogil=True)
def _integrate_layer(
    source: Any,
    bounds: Any,
    late: Any,
    runs: Any,
    own: Any,
    bias: Any,
    beta: Any,
    theta: Any,
    alpha: Any,
    seat: Any,
    packed: Any,
    begin: Any,
    counts: Any,
) -> Any:
    """All steps of one layer: neurons that fired, step after step, and where each step's begin."""
    steps, size = len(bounds) - 1, len(bias)
    membrane, current = np.zeros(size, np.float32), np.zeros(size, np.float32)
    fired = np.zeros(-(-size // 8) * 8, np.uint8)
    eight = fired.view(np.uint64)
    out, out_bounds = np.empty(steps * size, np.int32), np.zeros(steps + 1, np.int64)
    found, least = 0, np.float32(DENORMAL)
    for t in range(steps):
        if alpha:
            _keep(current, alpha)
        else:
            current[:] = 0
        if t + late < steps:
            _arrive(current, runs, source, bounds[t + late], bounds[t + late + 1])
        if len(own.run) and t:
            _arrive(current, own, out, out_bounds[t - 1], out_bounds[t])
        _integrate(membrane, current, bias, beta, theta, fired)
        if t % 16 == 15:  # decaying values end in denormals, which cost a hundred times a normal operation
            _flush(membrane, least)
            _flush(current, least)
        for word in range(len(eight)):
            if eight[word]:
                for neuron in range(word * 8, word * 8 + 8):
                    if fired[neuron]:
                        out[found] = neuron
                        found += 1
                        counts[neuron] += t >= begin
                        place = seat[neuron]
                        if place >= 0:
                            packed[t, place >> 6] |= np.uint64(1) << np.uint64(place & 63)
        out_bounds[t + 1] = found
    return out[:found].copy(), out_bounds
