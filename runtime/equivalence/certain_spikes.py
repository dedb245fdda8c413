"""Spikes of the float model that hold in any order of summation.

A float run decides a spike by one rounding of one sum; another library, or another order of adding, may decide
otherwise. Here every membrane is an interval that holds it for *every* such run, in float32 or any finer arithmetic:
centre and radius, layer by layer, where the radius grows by a bound on rounding [1]_ and by the input spikes that are
themselves uncertain. An entry (recording, step, neuron) whose interval lies on one side of the threshold is certain.

References
----------
.. [1] N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., SIAM 2002, section 3.1: ``n`` roundings
   of a sum of products err by at most ``gamma_n = n u / (1 - n u)`` of the sum of magnitudes.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.interpret import BATCH, channels_last
from spikeloom.compiler.ir import INPUT, Network, Population
from spikeloom.compiler.layer_kernel import DENORMAL
from spikeloom.compiler.passes.expand import Factored, effective_weight, expand, stack_of
from spikeloom.compiler.systems import TACTILESGNET, in_order
from spikeloom.compiler.types import BoolArray, FloatArray

Floats = npt.NDArray[np.float32]

UNIT = 2.0**-24
"""Unit roundoff of float32."""

SPARE = 8
"""Roundings beside the sums: of a weight, a bias and its addition, of the recurrence, of the float64 used here."""

FLOOR = 10 * DENORMAL
"""Added to every radius: underflow, and membranes that a run flushes to zero."""

SLACK = np.float32(1.01)
"""Magnitudes are summed in float32, and stay an upper bound by this factor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """Weights (n_pre, n_post) of a layer: a row for each neuron of the sources, then for each of its own.

    `magnitude` sums the magnitudes of all products that make up a weight. A current has `roundings`, and one more for
    each input spike if it is one plain sum over them (`per_spike`): a product with a zero is exact and adds exactly.
    `loops` is the number of projections to itself.
    """

    population: Population
    weight: FloatArray
    magnitude: Floats
    roundings: int
    per_spike: bool
    sources: tuple[int, ...]
    loops: int


def _layers(model: Factored | Network) -> list[_Layer]:
    if isinstance(model, Network):
        return [_plain(model, post) for post in range(len(model.populations))]
    checkpoint, adjacency = model.checkpoint, model.propagation
    network = expand(checkpoint, adjacency)
    first, *others = (_plain(network, post) for post in range(len(network.populations)))
    hops = checkpoint.hops.astype(np.float64)
    # Hop after hop on its own, as the released operator does: its terms may cancel only after they were rounded.
    spelled = in_order(checkpoint.system, effective_weight(stack_of(checkpoint, np.abs(adjacency)), np.abs(hops)))
    magnitude = first.magnitude.copy()
    neurons, channels = len(spelled), spelled[0].size  # the relays of clocks come after the neurons
    magnitude[:channels, :neurons] = spelled.reshape(neurons, channels).T
    # Of a graph the longest sum into a taxel, hop after hop; of a stack that into a place, filter after filter.
    gathered = int(np.count_nonzero(adjacency, axis=-1).max(initial=0)) + 1
    chain = len(hops) * gathered + hops.shape[2] * len(hops) + 1 + len(hops)
    if checkpoint.system == TACTILESGNET:
        chain = (len(hops) - 1) * gathered + hops.shape[2] + 1 + len(hops)
    return [
        replace(first, magnitude=magnitude, roundings=SPARE + chain, per_spike=False),
        *(replace(layer, roundings=SPARE) for layer in others),
    ]


def _plain(network: Network, post: int) -> _Layer:
    """A layer whose current is the plain sum over its synapses, as the float stage of the compiler has it."""
    # those from itself come last
    into = sorted((p for p in network.projections if p.post == post), key=lambda p: p.pre == post)
    sources = tuple(projection.pre for projection in into if projection.pre != post)
    weight = np.ascontiguousarray(np.concatenate([projection.weight.toarray().T for projection in into]))
    return _Layer(
        population=network.populations[post],
        weight=weight,
        magnitude=np.abs(weight).astype(np.float32),
        roundings=SPARE + len(into),
        per_spike=True,
        sources=sources,
        loops=len(into) - len(sources),
    )


def _sums(layer: _Layer, certain: BoolArray, doubt: BoolArray) -> tuple[FloatArray, Floats]:
    """Centre and radius of what spikes bring, (samples, steps, n_post), with the bias if no current outlasts a step."""
    population = layer.population
    sure, unsure = (spikes.reshape(-1, spikes.shape[-1]) for spikes in (certain, doubt))
    possible = (sure | unsure).astype(np.float32)
    centre = (sure + 0.5 * unsure) @ layer.weight
    radius: Floats = possible @ layer.magnitude
    if not population.alpha:
        centre += population.bias
        radius += np.abs(population.bias).astype(np.float32)
    added = np.full(len(sure), float(layer.roundings))
    if layer.per_spike:
        added += possible.sum(axis=1, dtype=np.float64)
    radius *= (SLACK * added * UNIT / (1 - added * UNIT))[:, None].astype(np.float32)
    rows = np.flatnonzero(unsure.any(axis=1))  # few
    radius[rows] += 0.5 * SLACK * (unsure[rows].astype(np.float32) @ layer.magnitude)
    shape = *certain.shape[:2], -1
    return centre.reshape(shape), radius.reshape(shape)


def _keep(alpha: float, step: int, before: tuple[FloatArray, Floats], centre: FloatArray, radius: Floats) -> None:
    """Add to a step's currents, in place, what is left of those of the step before, given by centre and radius."""
    # Decay as of membranes: alpha itself rounded, the product, and the sum that follows.
    lost = alpha * (1 + 8 * UNIT) * before[1] + 8 * UNIT * alpha * np.abs(before[0]) + FLOOR
    radius[:] = np.nextafter((radius + lost).astype(np.float32), np.float32(np.inf))
    centre += alpha * before[0]
    if step % 16 == 15:
        centre[np.abs(centre) < DENORMAL] = 0


class _Membranes:
    """Membranes of a layer, (samples, neurons), as centre and radius, step after step."""

    def __init__(self, beta: float, theta: float, shape: tuple[int, ...]) -> None:
        self._beta = beta
        self._least, self._most = sorted((theta, float(np.float32(theta))))
        self._centre, self._radius = np.zeros(shape), np.zeros(shape)

    def step(self, step: int, centre: FloatArray, radius: Floats) -> tuple[BoolArray, BoolArray]:
        """Let currents in; certain and uncertain spikes."""
        # Decay: beta itself rounded, the product, and the sum that follows.
        lost = np.abs(self._centre) * (8 * UNIT * self._beta)
        r = self._radius * (self._beta * (1 + 8 * UNIT)) + lost + radius + FLOOR
        c = self._centre * self._beta + centre
        low, high = c - r, c + r
        fired, silent = low > self._most, high <= self._least
        unknown = fired == silent
        c *= silent
        r *= silent
        # It was reset, or it is still below its threshold.
        down = np.minimum(low[unknown], 0)
        up = np.maximum(np.minimum(high[unknown], self._most), 0)
        c[unknown] = (down + up) / 2
        r[unknown] = (up - down) / 2 * (1 + UNIT)
        if step % 16 == 15:
            c[np.abs(c) < DENORMAL] = 0
        self._centre, self._radius = c, r
        return fired, unknown


def _spikes(layer: _Layer, certain: BoolArray, doubt: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Certain and uncertain spikes of a layer from those of its sources, all (samples, steps, neurons)."""
    population = layer.population
    shape = *certain.shape[:2], population.size
    fired, unsure = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    membranes = _Membranes(population.beta, population.theta, shape[::2])
    before = np.zeros(shape[::2]), np.zeros(shape[::2], np.float32)
    sums = None if layer.loops else _sums(layer, certain, doubt)
    for step in range(shape[1]):
        if sums is not None:
            centre, radius = sums[0][:, step], sums[1][:, step]
        else:  # what was uncertain in a step is so in the next; of step 0 nothing is known yet
            now, last = slice(step, step + 1), slice(max(step - 1, 0), max(step, 1))
            both = (
                np.concatenate([sent[:, now], *[own[:, last]] * layer.loops], axis=2)
                for sent, own in ((certain, fired), (doubt, unsure))
            )
            centres, radii = _sums(layer, *both)
            centre, radius = centres[:, 0], radii[:, 0]
        if population.alpha:
            if step:
                _keep(population.alpha, step, before, centre, radius)
            before = centre, radius
            # The bias goes past currents that last: it is rounded, added, and added to the membrane.
            more = (np.abs(centre) + np.abs(population.bias)).astype(np.float32)
            centre, radius = centre + population.bias, radius + SLACK * np.float32(4 * UNIT) * more
        fired[:, step], unsure[:, step] = membranes.step(step, centre, radius)
    return fired, unsure


def certain_spikes(model: Factored | Network, events: npt.NDArray[np.uint8]) -> list[tuple[BoolArray, BoolArray]]:
    """Spikes of the float model that no order of summation can change, in float32 or finer.

    Of each layer two arrays (samples, steps, neurons) bool: entries that surely spike, and entries that may or may not.
    All others surely do not. `events` is (samples, taxels, polarities, steps) uint8; a network sums over its
    synapses.
    """
    layers = _layers(model)
    inputs = channels_last(
        events, model.input.clocks if isinstance(model, Network) else model.checkpoint.dynamics.clocks
    )

    def batch(part: BoolArray) -> list[tuple[BoolArray, BoolArray]]:
        sent = {INPUT: (part, np.zeros_like(part))}
        for post, layer in enumerate(layers):
            sources = zip(*(sent[source] for source in layer.sources), strict=True)
            sent[post] = _spikes(layer, *(np.concatenate(each, axis=-1) for each in sources))
        return [sent[post] for post in range(len(layers))]

    parts = [inputs[start : start + BATCH] for start in range(0, len(inputs), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(batch, parts))
    return [
        (np.concatenate([certain for certain, _ in of_layer]), np.concatenate([doubt for _, doubt in of_layer]))
        for of_layer in zip(*results, strict=True)
    ]
