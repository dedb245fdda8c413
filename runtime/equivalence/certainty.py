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
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.interpret import BATCH, DENORMAL, channels_last
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.passes.expand import effective_weight, expand, stack_of
from spikeloom.compiler.systems import TACTILESGNET, in_order
from spikeloom.compiler.types import BoolArray, FloatArray

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
    """A layer's weights, transposed, (n_pre, n_post); a row for each neuron of the sources, then for each of its own.

    `magnitude` sums the magnitudes of all products that make up a weight. A current has `roundings`, and one more for
    each input spike if it is one plain sum over them (`per_spike`): a product with a zero is exact and adds exactly.
    `own` is the number of projections to itself.
    """

    weight: FloatArray
    magnitude: npt.NDArray[np.float32]
    bias: FloatArray
    roundings: int
    per_spike: bool
    alpha: float
    beta: float
    theta: float
    sources: tuple[int, ...]
    own: int = 0


def _layers(model: Checkpoint | Network, adjacency: FloatArray | None) -> list[_Layer]:
    if isinstance(model, Network):
        return [_plain(model, post) for post in range(len(model.populations))]
    assert adjacency is not None, "a checkpoint has a graph"
    checkpoint, network = model, expand(model, adjacency)
    hops = checkpoint.hops.astype(np.float64)
    # Hop after hop on its own, as the released operator does: its terms may cancel only after they were rounded.
    spelled = in_order(checkpoint.system, effective_weight(stack_of(checkpoint, np.abs(adjacency)), np.abs(hops)))
    # Of a graph the longest sum into a taxel, hop after hop; of a stack that into a place, filter after filter.
    gathered = int(np.count_nonzero(adjacency, axis=-1).max(initial=0)) + 1
    chain = len(hops) * gathered + hops.shape[2] * len(hops) + 1 + len(hops)
    if checkpoint.system == TACTILESGNET:
        chain = (len(hops) - 1) * gathered + hops.shape[2] + 1 + len(hops)
    layers = []
    for post, (population, projection) in enumerate(zip(network.populations, network.projections, strict=True)):
        weight = projection.weight.toarray()
        magnitude = np.abs(weight)
        if not post:  # the relays of clocks come after the neurons
            neurons, channels = len(spelled), spelled[0].size
            magnitude[:neurons, :channels] = spelled.reshape(neurons, channels)
        layers.append(
            _Layer(
                weight=np.ascontiguousarray(weight.T),
                magnitude=np.ascontiguousarray(magnitude.T.astype(np.float32)),
                bias=population.bias,
                roundings=SPARE if post else SPARE + chain,
                per_spike=post > 0,
                alpha=population.alpha,
                beta=population.beta,
                theta=population.theta,
                sources=(projection.pre,),
            )
        )
    return layers


def _plain(network: Network, post: int) -> _Layer:
    """A layer whose current is the plain sum over its synapses, as the float stage of the compiler has it."""
    # those from itself come last
    into = sorted((p for p in network.projections if p.post == post), key=lambda p: p.pre == post)
    sources = tuple(projection.pre for projection in into if projection.pre != post)
    weight = np.concatenate([projection.weight.toarray().T for projection in into])
    population = network.populations[post]
    return _Layer(
        weight=weight,
        magnitude=np.abs(weight).astype(np.float32),
        bias=population.bias,
        roundings=SPARE + len(into),
        per_spike=True,
        alpha=population.alpha,
        beta=population.beta,
        theta=population.theta,
        sources=sources,
        own=len(into) - len(sources),
    )


def _side_by_side(
    sources: tuple[int, ...], part: BoolArray, done: list[tuple[BoolArray, BoolArray]]
) -> tuple[BoolArray, BoolArray | None]:
    """Certain and uncertain spikes of several populations as if they were one; the input is certain."""
    if sources == (INPUT,):
        return part, None
    pairs = [(part, np.zeros_like(part)) if source == INPUT else done[source] for source in sources]
    if len(pairs) == 1:
        return pairs[0]
    return np.concatenate([sure for sure, _ in pairs], axis=-1), np.concatenate([doubt for _, doubt in pairs], axis=-1)


def _sums(layer: _Layer, certain: BoolArray, open_: BoolArray | None) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """Centre and radius of what spikes bring, (samples, steps, n_post), with the bias if no current outlasts a step."""
    samples, steps, n_pre = certain.shape
    sure = certain.reshape(-1, n_pre)
    doubt = None if open_ is None else open_.reshape(-1, n_pre)
    rows = np.zeros(0, np.intp) if doubt is None else np.flatnonzero(doubt.any(axis=1))
    inputs = sure.astype(np.float64)
    possible = sure.astype(np.float32)
    if doubt is not None and len(rows):
        inputs[rows] += 0.5 * doubt[rows]
        possible[rows] += doubt[rows]
    centre = inputs @ layer.weight
    radius: npt.NDArray[np.float32] = possible @ layer.magnitude
    if not layer.alpha:
        centre += layer.bias
        radius += np.abs(layer.bias).astype(np.float32)
    added = np.full(len(sure), float(layer.roundings))
    if layer.per_spike:
        added += possible.sum(axis=1, dtype=np.float64)
    radius *= (SLACK * added * UNIT / (1 - added * UNIT))[:, None].astype(np.float32)
    if doubt is not None and len(rows):
        radius[rows] += 0.5 * SLACK * (doubt[rows].astype(np.float32) @ layer.magnitude)
    return centre.reshape(samples, steps, -1), radius.reshape(samples, steps, -1)


def _outlast(layer: _Layer, centre: FloatArray, radius: npt.NDArray[np.float32]) -> None:
    """Make currents of what the spikes of each step bring, in place, without the bias."""
    for step in range(1, centre.shape[1]):
        _keep(layer.alpha, step, centre[:, step - 1], radius[:, step - 1], centre[:, step], radius[:, step])


def _keep(
    alpha: float,
    step: int,
    before: FloatArray,
    unsure: npt.NDArray[np.float32],
    centre: FloatArray,
    radius: npt.NDArray[np.float32],
) -> None:
    """Add to a step's currents, in place, what is left of those of the step before, given by centre and radius."""
    # Decay as of membranes: alpha itself rounded, the product, and the sum that follows.
    lost = alpha * (1 + 8 * UNIT) * unsure + 8 * UNIT * alpha * np.abs(before) + FLOOR
    radius[:] = np.nextafter((radius + lost).astype(np.float32), np.float32(np.inf))
    centre += alpha * before
    if step % 16 == 15:
        centre[np.abs(centre) < DENORMAL] = 0


def _with_bias(
    layer: _Layer, centre: FloatArray, radius: npt.NDArray[np.float32]
) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """Currents that outlast their step and the bias past them: it is rounded, added, and added to the membrane."""
    more = SLACK * np.float32(4 * UNIT) * (np.abs(centre) + np.abs(layer.bias)).astype(np.float32)
    return centre + layer.bias, radius + more


class _Membranes:
    """Membranes of a layer, (samples, neurons), as centre and radius, step after step."""

    def __init__(self, beta: float, theta: float, shape: tuple[int, ...]) -> None:
        self._beta, self._grown = beta, beta * (1 + 8 * UNIT)
        self._least, self._most = sorted((theta, float(np.float32(theta))))
        self._centre, self._radius = np.zeros(shape), np.zeros(shape)
        self._low, self._high, self._silent = np.empty(shape), np.empty(shape), np.empty(shape, np.bool_)

    def step(
        self,
        step: int,
        centre: FloatArray,
        radius: npt.NDArray[np.float32],
        fired: BoolArray,
        doubt: BoolArray,
    ) -> None:
        """Let currents in; fill the certain and the uncertain spikes, all of the shape of the membranes."""
        c, r, low, high = self._centre, self._radius, self._low, self._high
        # Decay: beta itself rounded, the product, and the sum that follows.
        np.abs(c, out=low)
        low *= 8 * UNIT * self._beta
        r *= self._grown
        r += low
        r += radius
        r += FLOOR
        c *= self._beta
        c += centre
        np.subtract(c, r, out=low)
        np.add(c, r, out=high)
        yes = np.greater(low, self._most, out=fired)
        silent = np.less_equal(high, self._least, out=self._silent)
        unknown = np.equal(yes, silent, out=doubt)
        c *= silent
        r *= silent
        if unknown.any():
            # It was reset, or it is still below its threshold.
            down = np.minimum(low[unknown], 0)
            up = np.maximum(np.minimum(high[unknown], self._most), 0)
            c[unknown] = (down + up) / 2
            r[unknown] = (up - down) / 2 * (1 + UNIT)
        if step % 16 == 15:
            c[np.abs(c) < DENORMAL] = 0


def _recurrence(
    beta: float, theta: float, centre: FloatArray, radius: npt.NDArray[np.float32]
) -> tuple[BoolArray, BoolArray]:
    """Certain and uncertain spikes, (samples, steps, neurons) bool, of currents given by centre and radius."""
    fired, doubt = np.empty(centre.shape, np.bool_), np.empty(centre.shape, np.bool_)
    membranes = _Membranes(beta, theta, centre.shape[::2])
    for step in range(centre.shape[1]):
        membranes.step(step, centre[:, step], radius[:, step], fired[:, step], doubt[:, step])
    return fired, doubt


def _spikes(layer: _Layer, certain: BoolArray, open_: BoolArray | None) -> tuple[BoolArray, BoolArray]:
    """Certain and uncertain spikes of a layer from those of its sources."""
    if layer.own:
        return _recurrent_spikes(layer, certain, np.zeros_like(certain) if open_ is None else open_)
    centre, radius = _sums(layer, certain, open_)
    if layer.alpha:
        _outlast(layer, centre, radius)
        centre, radius = _with_bias(layer, centre, radius)
    return _recurrence(layer.beta, layer.theta, centre, radius)


def _recurrent_spikes(layer: _Layer, certain: BoolArray, open_: BoolArray) -> tuple[BoolArray, BoolArray]:
    """The same of a recurrent layer, one step at a time: what was uncertain in one is so in the next."""
    shape = len(certain), certain.shape[1], len(layer.bias)
    fired, doubt = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    membranes = _Membranes(layer.beta, layer.theta, shape[::2])
    held = np.zeros(shape[::2]), np.zeros(shape[::2], np.float32)
    for step in range(shape[1]):
        now, before = slice(step, step + 1), slice(max(step - 1, 0), max(step, 1))  # of step 0 nothing is known yet
        sure = np.concatenate([certain[:, now], *[fired[:, before]] * layer.own], axis=2)
        unsure = np.concatenate([open_[:, now], *[doubt[:, before]] * layer.own], axis=2)
        centres, radii = _sums(layer, sure, unsure)
        centre, radius = centres[:, 0], radii[:, 0]
        if layer.alpha:
            if step:
                _keep(layer.alpha, step, *held, centre, radius)
            held = centre, radius
            centre, radius = _with_bias(layer, centre, radius)
        membranes.step(step, centre, radius, fired[:, step], doubt[:, step])
    return fired, doubt


def float_certainty(
    model: Checkpoint | Network, adjacency: FloatArray | None, events: npt.NDArray[np.uint8]
) -> list[tuple[BoolArray, BoolArray]]:
    """Spikes of the float model that no order of summation can change, in float32 or finer.

    Parameters
    ----------
    model : Checkpoint or Network
        Float model; a network sums over its synapses.
    adjacency : (taxels, taxels) float64, or None
        Normalised propagation matrix of a checkpoint.
    events : (samples, taxels, polarities, steps) uint8
        Recordings.

    Returns
    -------
    list of (certain, uncertain)
        One pair per layer, each (samples, steps, neurons) bool: entries that surely spike, and entries that may or
        may not. All others surely do not.
    """
    layers = _layers(model, adjacency)
    inputs = channels_last(events, model.input.clocks if isinstance(model, Network) else model.dynamics.clocks)

    def batch(part: BoolArray) -> list[tuple[BoolArray, BoolArray]]:
        done: list[tuple[BoolArray, BoolArray]] = []
        for layer in layers:
            certain, doubt = _side_by_side(layer.sources, part, done)
            done.append(_spikes(layer, certain, doubt))
        return done

    parts = [inputs[start : start + BATCH] for start in range(0, len(inputs), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(batch, parts))
    return [
        (np.concatenate([result[i][0] for result in results]), np.concatenate([result[i][1] for result in results]))
        for i in range(len(layers))
    ]
