"""What the float model does in any order of summation, and how much of it the chip does, too.

A float run decides a spike by one rounding of one sum; another library, or another order of adding, may decide
otherwise. Here every membrane is an interval that holds it for *every* such run, in float32 or any finer arithmetic:
centre and radius, layer by layer, where the radius grows by a bound on rounding [1]_ and by the input spikes that are
themselves uncertain. An entry (recording, step, neuron) whose interval lies on one side of the threshold is certain; it
is certified to be equal on the chip, or to be different. Registers of the chip are bounded for any input.

References
----------
.. [1] N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., SIAM 2002, section 3.1: ``n`` roundings
   of a sum of products err by at most ``gamma_n = n u / (1 - n u)`` of the sum of magnitudes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from spikeloom.compiler.interpret import BATCH, channels_last, cut, raster, synapses_of, threads
from spikeloom.compiler.ir import INPUT, IntegerNetwork, Network, Population
from spikeloom.compiler.layer_kernel import (
    DENORMAL,
    Synapses,
    arrive,
    by_source,
    clear,
    compiled,
    compiled_and_cached,
    flush,
    list_fired,
)
from spikeloom.compiler.passes.expand import Factored, effective_weight, expand, stack_of
from spikeloom.compiler.passes.range_proof import prove_ranges
from spikeloom.compiler.systems import TACTILESGNET, in_order
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines.votes import readout_counts, wins

UNIT = 2.0**-24
"""Unit roundoff of float32."""

SPARE = 8
"""Roundings beside the sums: of a weight, a bias and its addition, of the recurrence, of the float64 used here."""

FLOOR = 10 * DENORMAL
"""Added to every radius: underflow, and membranes that a run flushes to zero."""

SLACK = 1.01
"""Magnitudes are float32 and summed in float64; they stay an upper bound by this factor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """Weights and magnitudes of a layer, of its `sources` and of itself.

    `magnitude` sums the magnitudes of all products that make up a weight. A current has `roundings`, and one more for
    each input spike if it is one plain sum over them (`per_spike`): a product with a zero is exact and adds exactly.
    """

    population: Population
    sources: tuple[int, ...]
    weight: Synapses
    magnitude: Synapses
    own: Synapses
    own_magnitude: Synapses
    roundings: int
    per_spike: bool


def _layers(model: Factored | Network) -> list[_Layer]:
    if isinstance(model, Network):
        return [_plain(model, post) for post in range(len(model.populations))]
    checkpoint, adjacency = model.checkpoint, model.propagation
    network = expand(checkpoint, adjacency)
    first, *others = (_plain(network, post) for post in range(len(network.populations)))
    hops = checkpoint.hops.astype(np.float64)
    # Hop after hop on its own, as the released operator does: its terms may cancel only after they were rounded.
    spelled = in_order(checkpoint.system, effective_weight(stack_of(checkpoint, np.abs(adjacency)), np.abs(hops)))
    weight = sum((p.weight for p in network.projections if p.post == 0), start=0).toarray()
    magnitude = np.abs(weight)
    neurons, channels = len(spelled), spelled[0].size  # the relays of clocks come after the neurons
    magnitude[:neurons, :channels] = spelled.reshape(neurons, channels)
    kept = sparse.csr_array(magnitude)
    row = np.repeat(np.arange(len(weight)), np.diff(kept.indptr))
    aligned = sparse.csr_array((weight[row, kept.indices], kept.indices, kept.indptr), shape=kept.shape)
    # Of a graph the longest sum into a taxel, hop after hop; of a stack that into a place, filter after filter.
    gathered = int(np.count_nonzero(adjacency, axis=-1).max(initial=0)) + 1
    chain = len(hops) * gathered + hops.shape[2] * len(hops) + 1 + len(hops)
    if checkpoint.system == TACTILESGNET:
        chain = (len(hops) - 1) * gathered + hops.shape[2] + 1 + len(hops)
    sums, bounds = by_source([aligned], np.float64), by_source([kept], np.float32)
    return [
        replace(first, weight=sums, magnitude=bounds, roundings=SPARE + chain, per_spike=False),
        *(replace(layer, roundings=SPARE) for layer in others),
    ]


def _plain(network: Network, post: int) -> _Layer:
    """A layer whose current is the plain sum over its synapses, as the float stage of the compiler has it."""
    into = [p for p in network.projections if p.post == post]
    sources, (weight, own) = synapses_of([(p, p.weight) for p in into], np.float64)
    _, (magnitude, own_magnitude) = synapses_of([(p, abs(p.weight)) for p in into], np.float32)
    return _Layer(
        population=network.populations[post],
        sources=sources,
        weight=weight,
        magnitude=magnitude,
        own=own,
        own_magnitude=own_magnitude,
        roundings=SPARE + len(into),
        per_spike=True,
    )


@compiled
def _step(centre: Any, radius: Any, c: Any, r: Any, beta: Any, least: Any, most: Any, fired: Any, unsure: Any) -> None:
    """Let the currents `c` with radius `r` into the membranes; who surely fires, and who may."""
    for i in range(len(centre)):
        # Decay: beta itself rounded, the product, and the sum that follows.
        lost = abs(centre[i]) * (8 * UNIT * beta)
        wide = radius[i] * (beta * (1 + 8 * UNIT)) + lost + r[i] + FLOOR
        middle = centre[i] * beta + c[i]
        low, high = middle - wide, middle + wide
        fires, silent = low > most, high <= least
        unknown = fires == silent
        # It was reset, or it is still below its threshold.
        down, up = min(low, 0.0), max(min(high, most), 0.0)
        middle = (down + up) / 2 if unknown else (middle if silent else 0.0)
        wide = (up - down) / 2 * (1 + UNIT) if unknown else (wide if silent else 0.0)
        centre[i], radius[i] = middle, wide
        fired[i], unsure[i] = fires, unknown


@compiled
def _currents(c: Any, half: Any, r: Any, doubtful: Any, bias: Any, error: Any) -> None:
    """Radius of plain sums: of a share of their magnitude, and of spikes that may be missing."""
    for i in range(len(c)):
        c[i] = c[i] + 0.5 * half[i] + bias[i]
        r[i] = (r[i] + doubtful[i] + abs(bias[i])) * error + 0.5 * SLACK * doubtful[i]


@compiled
def _lasting(c: Any, r: Any, before_c: Any, before_r: Any, alpha: Any, bias: Any) -> None:
    """Add what is left of the currents of the step before, and the bias, which goes past them."""
    for i in range(len(c)):
        # Decay as of membranes: alpha itself rounded, the product, and the sum that follows.
        r[i] += alpha * (1 + 8 * UNIT) * before_r[i] + 8 * UNIT * alpha * abs(before_c[i]) + FLOOR
        c[i] += alpha * before_c[i]
        before_c[i], before_r[i] = c[i], r[i]
        # It is rounded, added, and added to the membrane.
        r[i] += SLACK * 4 * UNIT * (abs(c[i]) + abs(bias[i]))
        c[i] += bias[i]


@compiled_and_cached
def _run(
    sure: Any,
    doubt: Any,
    weight: Any,
    magnitude: Any,
    own: Any,
    own_magnitude: Any,
    bias: Any,
    constants: Any,
    roundings: Any,
    per_spike: Any,
    state: Any,
    listed: Any,
    fired: Any,
    unsure: Any,
) -> None:
    """Run recordings through a layer; `fired` and `unsure` (recordings, steps, neurons) uint8 are filled."""
    start = np.int64(0)  # a plain 0 is a type of its own: all would be compiled once more
    alpha, beta, least, most = constants
    recordings, steps, _ = fired.shape
    c, half, r, doubtful, nothing = state[0], state[1], state[2], state[3], state[4]
    centre, radius, before_c, before_r = state[5], state[6], state[7], state[8]
    for recording in range(recordings):
        for row in range(len(state)):
            clear(state[row])
        for t in range(steps):
            for row in range(4):
                clear(state[row])
            at = recording * steps + t
            first, last = sure.bounds[at], sure.bounds[at + 1]
            arrive(c, weight, sure.source, first, last)
            arrive(r, magnitude, sure.source, first, last)
            spikes = last - first
            first, last = doubt.bounds[at], doubt.bounds[at + 1]
            arrive(half, weight, doubt.source, first, last)
            arrive(doubtful, magnitude, doubt.source, first, last)
            spikes += last - first
            if len(own.run) and t:  # what was uncertain in a step is so in the next
                found = list_fired(fired[recording, t - 1], listed)
                arrive(c, own, listed, start, found)
                arrive(r, own_magnitude, listed, start, found)
                spikes += found
                found = list_fired(unsure[recording, t - 1], listed)
                arrive(half, own, listed, start, found)
                arrive(doubtful, own_magnitude, listed, start, found)
                spikes += found
            added = (roundings + (spikes if per_spike else 0)) * UNIT
            _currents(c, half, r, doubtful, nothing if alpha else bias, SLACK * added / (1 - added))
            if alpha:
                _lasting(c, r, before_c, before_r, alpha, bias)
            _step(centre, radius, c, r, beta, least, most, fired[recording, t], unsure[recording, t])
            if t % 16 == 15:
                flush(centre, DENORMAL)
                flush(before_c, DENORMAL)


class Certainty:
    """Which spikes of a float model no order of summation can change, in float32 or finer; prepared once."""

    def __init__(self, model: Factored | Network) -> None:
        """A network sums over its synapses, a checkpoint as its operator does."""
        self._layers = _layers(model)
        self._clocks = model.input.clocks if isinstance(model, Network) else model.checkpoint.dynamics.clocks

    def spikes(self, events: EventArray) -> list[tuple[BoolArray, BoolArray]]:
        """Of each layer two arrays (samples, steps, neurons) bool: what surely spikes, and what may or may not.

        All others surely do not. `events` is (samples, taxels, polarities, steps) uint8.
        """
        inputs = channels_last(events, self._clocks)
        parts = threads().map(self._batch, (inputs[start : start + BATCH] for start in range(0, len(inputs), BATCH)))
        return [
            (np.concatenate([certain for certain, _ in layer]), np.concatenate([doubt for _, doubt in layer]))
            for layer in zip(*parts, strict=True)
        ]

    def _batch(self, part: BoolArray) -> list[tuple[BoolArray, BoolArray]]:
        sent = {INPUT: (part, np.zeros_like(part))}
        for post, layer in enumerate(self._layers):
            population = layer.population
            fired, unsure = np.zeros((2, *part.shape[:2], population.size), np.bool_)
            _run(
                raster([sent[pre][0] for pre in layer.sources]),
                raster([sent[pre][1] for pre in layer.sources]),
                layer.weight,
                layer.magnitude,
                layer.own,
                layer.own_magnitude,
                np.asarray(population.bias, np.float64),
                (population.alpha, population.beta, *sorted((population.theta, float(np.float32(population.theta))))),
                layer.roundings,
                layer.per_spike,
                np.empty((9, population.size)),
                np.empty(population.size, np.int32),
                fired.view(np.uint8),
                unsure.view(np.uint8),
            )
            sent[post] = fired, unsure
        return [sent[post] for post in range(len(self._layers))]


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerCertificate:
    """Entries (recording, step, neuron) of a layer that are equal, or differ, in any order of float sums."""

    entries: int
    equal: int
    different: int

    json_properties = ("undecided",)

    @property
    def undecided(self) -> int:
        """Entries in which rounding, or an uncertain spike before it, may decide."""
        return self.entries - self.equal - self.different


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """What is proven.

    Of the recordings' spikes, layer by layer, and decisions, in whatever order the float model adds; and of any input:
    `unproven` layers may bring a register out of its range, those of them that are `saturating` only a membrane.
    """

    layers: Mapping[str, LayerCertificate]
    samples: int
    decisions: int
    unproven: tuple[str, ...]
    saturating: tuple[str, ...]


class Certifier:
    """Certifies spikes and decisions of the chip, some recordings after others, and its registers on any input."""

    def __init__(self, model: Factored | Network, integer: IntegerNetwork, kept: Sequence[slice | IntArray]) -> None:
        """`kept` names the neurons of each layer that are compared; in the last layer all."""
        self._integer, self._certainty, self._kept = integer, Certainty(model), kept
        self._entries, self._unknown, self._different = np.zeros((3, len(integer.populations)), np.int64)
        self._samples = self._decisions = 0

    def add(
        self,
        events: EventArray,
        chip: Sequence[BoolArray],
        decisions: IntArray,
        lengths: IntArray | None = None,
    ) -> None:
        """Certify recordings (samples, taxels, polarities, steps).

        `chip` holds the spikes of each layer, (samples, steps, kept neurons) bool, aligned with the data and cut to
        `lengths`; its classes `decisions` are (samples,).
        """
        float_model = [
            (cut(certain[..., part], lengths), cut(doubt[..., part], lengths))
            for part, (certain, doubt) in zip(self._kept, self._certainty.spikes(events), strict=True)
        ]
        steps = events.shape[3] * len(events) if lengths is None else int(lengths.sum())
        for index, ((certain, doubt), spikes) in enumerate(zip(float_model, chip, strict=True)):
            self._entries[index] += steps * spikes.shape[2]
            self._unknown[index] += np.count_nonzero(doubt)
            self._different[index] += np.count_nonzero((certain != spikes) & ~doubt)
        readout, classes = self._integer.readout, self._integer.classes
        least, more = (readout_counts(readout, classes, each) for each in float_model[readout.population])
        self._samples += len(events)
        self._decisions += int(np.count_nonzero(wins(decisions, least, least + more)))

    def certificate(self) -> Certificate:
        """What is proven of all of them."""
        figures = zip(self._entries.tolist(), self._unknown.tolist(), self._different.tolist(), strict=True)
        layers = {
            population.name: LayerCertificate(entries=entries, equal=entries - unknown - different, different=different)
            for population, (entries, unknown, different) in zip(self._integer.populations, figures, strict=True)
        }
        loose = [proof for proof in prove_ranges(self._integer) if not proof.holds]
        return Certificate(
            layers=layers,
            samples=self._samples,
            decisions=self._decisions,
            unproven=tuple(proof.layer for proof in loose),
            saturating=tuple(proof.layer for proof in loose if not proof.stops),
        )
