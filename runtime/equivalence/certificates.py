"""How much of what the float model does in any order of summation the chip does, too.

An entry (recording, step, neuron) that is certain by :mod:`equivalence.certain_spikes` is certified to be equal to the
float model's, or to be different. Registers of the chip are bounded by :func:`range_proof.prove_ranges`, for any input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.interpret import cut
from spikeloom.compiler.ir import IntegerNetwork, Network
from spikeloom.compiler.passes.expand import Factored
from spikeloom.compiler.passes.range_proof import prove_ranges
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.equivalence.certain_spikes import certain_spikes
from spikeloom.runtime.machines.votes import readout_counts


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
    `unproven` layers may bring a register out of its range.
    """

    layers: Mapping[str, LayerCertificate]
    samples: int
    decisions: int
    unproven: tuple[str, ...]


def wins(decisions: IntArray, least: IntArray, most: IntArray) -> BoolArray:
    """Whether a class wins the vote whatever the counts between their bounds; ties go to the lowest class.

    `decisions` is the class in question, (samples,); `least` and `most` bound the votes, (samples, classes).

    Examples
    --------
    >>> least, most = np.array([[3, 3], [3, 3], [2, 1]]), np.array([[3, 3], [3, 4], [4, 2]])
    >>> wins(np.array([0, 0, 0]), least, most).tolist()
    [True, False, True]
    """
    rows, classes = np.arange(len(decisions)), np.arange(least.shape[1])
    ahead = least[rows, decisions][:, None] - most
    ahead[rows, decisions] = 0  # no class has to beat itself
    sure: BoolArray = np.all(ahead >= (classes < decisions[:, None]), axis=1)
    return sure


def certify(
    model: Factored | Network,
    integer: IntegerNetwork,
    events: npt.NDArray[np.uint8],
    chip: Sequence[BoolArray],
    decisions: IntArray,
    *,
    kept: Sequence[slice | IntArray] | None = None,
    lengths: IntArray | None = None,
) -> Certificate:
    """Certify spikes and decisions of the chip on recordings, and its registers on any input.

    `chip` holds the spikes of each layer, (samples, steps, kept neurons) bool, aligned with the data and cut to
    `lengths`, of those neurons that `kept` names: all by default, and always all of the last layer. Its classes
    `decisions` are (samples,). The others are those of :func:`certain_spikes`.
    """
    neurons = [slice(None)] * len(chip) if kept is None else kept
    float_model = [
        (cut(certain[..., part], lengths), cut(doubt[..., part], lengths))
        for part, (certain, doubt) in zip(neurons, certain_spikes(model, events), strict=True)
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
