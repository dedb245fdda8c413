"""What of the float model holds in any order of summation, and how much of it the chip does.

A float run decides a spike by one rounding of one sum; another library, or another order of adding, may decide
otherwise. Here every membrane is an interval that holds it for *every* such run, in float32 or any finer arithmetic:
centre and radius, layer by layer, where the radius grows by a bound on rounding [1]_ and by the input spikes that are
themselves uncertain. An entry (recording, step, neuron) whose interval lies on one side of the threshold is certain;
the chip's spike is then certified to be equal to the float model's, or to be different. Registers of the chip are
bounded by :func:`compiler.passes.bounds.prove_ranges`, for any input.

References
----------
.. [1] N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., SIAM 2002, section 3.1: ``n`` roundings
   of a sum of products err by at most ``gamma_n = n u / (1 - n u)`` of the sum of magnitudes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from compiler.fixedpoint import FloatArray, IntArray
from compiler.frontends.checkpoint import Checkpoint
from compiler.frontends.systems import TACTILESGNET, in_order
from compiler.interpret import BATCH, DENORMAL, BoolArray, channels_last, cut
from compiler.ir import INPUT, IntegerNetwork, Network
from compiler.passes.bounds import prove_ranges
from compiler.passes.expand import effective_weight, expand, stack_of
from runtime.tables import table
from runtime.votes import readout_counts

UNIT = 2.0**-24
"""Unit roundoff of float32."""

SPARE = 8
"""Roundings beside the sums: of a weight, a bias and its addition, of the recurrence, of the float64 used here."""

FLOOR = 10 * DENORMAL
"""Added to every radius: underflow, and membranes that a run flushes to zero."""

SLACK = np.float32(1.01)
"""Magnitudes are summed in float32, and stay an upper bound by this factor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerCertificate:
    """Entries (recording, step, neuron) of one layer.

    Parameters
    ----------
    entries : int
        All of them.
    equal : int
        Chip and float model have the same spike, or the same silence, in whatever order the float model adds.
    different : int
        They differ in whatever order. The rest is undecided.
    """

    entries: int
    equal: int
    different: int

    @property
    def undecided(self) -> int:
        """Entries in which rounding, or an uncertain spike before it, may decide."""
        return self.entries - self.equal - self.different


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """What is proven, of the recordings and of any input.

    Parameters
    ----------
    layers : mapping of str to LayerCertificate
        Spikes of each layer on the recordings.
    samples : int
        Recordings.
    decisions : int
        Of these, how many float decisions are the chip's in whatever order the float model adds.
    unproven : tuple of str
        Layers that may bring a register out of its range on some input; empty if none can.
    """

    layers: Mapping[str, LayerCertificate]
    samples: int
    decisions: int
    unproven: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """A layer's weights, transposed.

    Parameters
    ----------
    weight : (n_pre, n_post) float64
        As expanded.
    magnitude : (n_pre, n_post) float32
        Sum of the magnitudes of all products that make up a weight.
    bias : (n_post,) float64
        Bias.
    roundings : int
        Roundings in a current, beside one for each input spike where `per_spike`.
    per_spike : bool
        Whether the current is one plain sum over input spikes; a product with a zero is exact and adds exactly.
    alpha, beta, theta : float
        Decays of current and membrane, and threshold.
    sources : tuple of int
        Populations whose neurons lie side by side in the rows, ``INPUT`` among them.
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
    into = [projection for projection in network.projections if projection.post == post]
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
        sources=tuple(projection.pre for projection in into),
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


def _currents(layer: _Layer, certain: BoolArray, open_: BoolArray | None) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """Centre and radius of the currents, (samples, steps, n_post), from certain and uncertain input spikes."""
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
    centre, radius = centre.reshape(samples, steps, -1), radius.reshape(samples, steps, -1)
    if layer.alpha:
        _outlast(layer, centre, radius)
    return centre, radius


def _outlast(layer: _Layer, centre: FloatArray, radius: npt.NDArray[np.float32]) -> None:
    """Make currents of what the spikes of each step bring, in place; the bias comes last, past the current."""
    alpha = layer.alpha
    for step in range(1, centre.shape[1]):
        # Decay as in _recurrence: alpha itself rounded, the product, and the sum that follows.
        before = centre[:, step - 1]
        lost = alpha * (1 + 8 * UNIT) * radius[:, step - 1] + 8 * UNIT * alpha * np.abs(before) + FLOOR
        radius[:, step] = np.nextafter((radius[:, step] + lost).astype(np.float32), np.float32(np.inf))
        centre[:, step] += alpha * before
        if step % 16 == 15:
            centre[:, step][np.abs(centre[:, step]) < DENORMAL] = 0
    # The bias is rounded, added, and the sum is added to the membrane.
    radius += SLACK * np.float32(4 * UNIT) * (np.abs(centre) + np.abs(layer.bias)).astype(np.float32)
    centre += layer.bias


def _recurrence(
    beta: float, theta: float, centre: FloatArray, radius: npt.NDArray[np.float32]
) -> tuple[BoolArray, BoolArray]:
    """Certain and uncertain spikes, (samples, steps, neurons) bool, of currents given by centre and radius."""
    least, most = sorted((theta, float(np.float32(theta))))
    fired, doubt = np.empty(centre.shape, np.bool_), np.empty(centre.shape, np.bool_)
    c, r = np.zeros(centre.shape[::2]), np.zeros(centre.shape[::2])
    low, high, silent = np.empty_like(c), np.empty_like(c), np.empty(c.shape, np.bool_)
    grown = beta * (1 + 8 * UNIT)
    for step in range(centre.shape[1]):
        # Decay: beta itself rounded, the product, and the sum that follows.
        np.abs(c, out=low)
        low *= 8 * UNIT * beta
        r *= grown
        r += low
        r += radius[:, step]
        r += FLOOR
        c *= beta
        c += centre[:, step]
        np.subtract(c, r, out=low)
        np.add(c, r, out=high)
        yes = np.greater(low, most, out=fired[:, step])
        np.less_equal(high, least, out=silent)
        unknown = np.equal(yes, silent, out=doubt[:, step])
        c *= silent
        r *= silent
        if unknown.any():
            # It was reset, or it is still below its threshold.
            down = np.minimum(low[unknown], 0)
            up = np.maximum(np.minimum(high[unknown], most), 0)
            c[unknown] = (down + up) / 2
            r[unknown] = (up - down) / 2 * (1 + UNIT)
        if step % 16 == 15:
            c[np.abs(c) < DENORMAL] = 0
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
            done.append(_recurrence(layer.beta, layer.theta, *_currents(layer, certain, doubt)))
        return done

    parts = [inputs[start : start + BATCH] for start in range(0, len(inputs), BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(batch, parts))
    return [
        (np.concatenate([result[i][0] for result in results]), np.concatenate([result[i][1] for result in results]))
        for i in range(len(layers))
    ]


def wins(decisions: IntArray, least: IntArray, most: IntArray) -> BoolArray:
    """Whether a class wins the vote whatever the counts between their bounds; ties go to the lowest class.

    Parameters
    ----------
    decisions : (samples,) int64
        The class in question.
    least, most : (samples, classes) int64
        Bounds of the votes.

    Examples
    --------
    >>> least, most = np.array([[3, 3], [3, 3], [2, 1]]), np.array([[3, 3], [3, 4], [4, 2]])
    >>> wins(np.array([0, 0, 0]), least, most).tolist()
    [True, False, True]
    """
    rows = np.arange(len(decisions))
    own = least[rows, decisions][:, None]
    classes = np.arange(least.shape[1])
    beaten = np.where(classes < decisions[:, None], most < own, most <= own)
    beaten[rows, decisions] = True
    sure: BoolArray = np.logical_and.reduce(beaten, axis=1)
    return sure


def certify(
    model: Checkpoint | Network,
    adjacency: FloatArray | None,
    integer: IntegerNetwork,
    events: npt.NDArray[np.uint8],
    chip: Sequence[BoolArray],
    decisions: IntArray,
    *,
    kept: Sequence[slice | IntArray] | None = None,
    lengths: IntArray | None = None,
) -> Certificate:
    """Certify spikes and decisions of the chip on recordings, and its registers on any input.

    Parameters
    ----------
    model : Checkpoint or Network
        Float model; a network sums over its synapses.
    adjacency : (taxels, taxels) float64, or None
        Normalised propagation matrix of a checkpoint.
    integer : IntegerNetwork
        The chip's network.
    events : (samples, taxels, polarities, steps) uint8
        Recordings.
    chip : sequence of (samples, steps, kept neurons) bool
        The chip's spikes on them, per layer, aligned with the data and cut to `lengths`.
    decisions : (samples,) int64
        Its classes.
    kept : sequence of slice or int64 array, optional
        Neurons of each layer that `chip` holds; by default all of them. The last layer must be whole.
    lengths : (samples,) int64, optional
        Steps of each recording; by default all of them.
    """
    neurons = [slice(None)] * len(chip) if kept is None else kept
    float_model = [
        (cut(certain[..., part], lengths), cut(doubt[..., part], lengths))
        for part, (certain, doubt) in zip(neurons, float_certainty(model, adjacency, events), strict=True)
    ]
    steps = events.shape[3] * len(events) if lengths is None else int(lengths.sum())
    layers = {}
    for population, (certain, doubt), spikes in zip(integer.populations, float_model, chip, strict=True):
        entries, unknown = steps * spikes.shape[2], int(np.count_nonzero(doubt))
        different = int(np.count_nonzero((certain != spikes) & ~doubt))
        layers[population.name] = LayerCertificate(
            entries=entries, equal=entries - unknown - different, different=different
        )
    votes = [readout_counts(integer.readout, integer.classes, each) for each in float_model[integer.readout.population]]
    least, most = votes[0], votes[0] + votes[1]
    return Certificate(
        layers=layers,
        samples=len(events),
        decisions=int(np.count_nonzero(wins(decisions, least, most))),
        unproven=tuple(proof.layer for proof in prove_ranges(integer) if not proof.holds),
    )


def certificate_json(certificate: Certificate) -> dict[str, Any]:
    """A certificate under the keys that scripts rely on."""
    return {
        "samples": certificate.samples,
        "decisions": certificate.decisions,
        "unproven": list(certificate.unproven),
        "layers": {
            name: {
                "entries": layer.entries,
                "equal": layer.equal,
                "different": layer.different,
                "undecided": layer.undecided,
            }
            for name, layer in certificate.layers.items()
        },
    }


def certificate_text(report: dict[str, Any]) -> str:
    """A certificate for people."""
    rows = [
        [
            name,
            f"{layer['entries']:,}",
            f"{100 * layer['equal'] / max(layer['entries'], 1):.4f} %",
            *(f"{layer[key]:,}" for key in ("different", "undecided")),
        ]
        for name, layer in report["layers"].items()
    ]
    proof = "no register overflows for any input"
    if report["unproven"]:
        proof = f"some input may overflow a register of {', '.join(report['unproven'])}: no proof of range"
    return "\n".join(
        [
            table(["certified in any order of sums", "entries", "equal", "different", "undecided"], rows),
            f"{report['decisions']} of {report['samples']} decisions certified equal; {proof}",
        ]
    )
