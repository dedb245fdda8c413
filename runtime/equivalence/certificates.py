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
from spikeloom.runtime.equivalence.certain_spikes import Certainty
from spikeloom.runtime.machines.votes import readout_counts, wins


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


class Certifier:
    """Certifies spikes and decisions of the chip, some recordings after others, and its registers on any input."""

    def __init__(
        self, model: Factored | Network, integer: IntegerNetwork, kept: Sequence[slice | IntArray] | None = None
    ) -> None:
        """`kept` names the neurons of each layer that are compared, by default and in the last layer all."""
        self._integer = integer
        self._certainty = Certainty(model)
        self._kept = [slice(None)] * len(integer.populations) if kept is None else kept
        self._entries, self._unknown, self._different = np.zeros((3, len(integer.populations)), np.int64)
        self._samples = self._decisions = 0

    def add(
        self,
        events: npt.NDArray[np.uint8],
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
        return Certificate(
            layers=layers,
            samples=self._samples,
            decisions=self._decisions,
            unproven=tuple(proof.layer for proof in prove_ranges(self._integer) if not proof.holds),
        )
