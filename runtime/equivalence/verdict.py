"""What a comparison of float model and chip comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.runtime.costs.simulated import Part
from spikeloom.runtime.equivalence.breakdowns import Breakdown
from spikeloom.runtime.equivalence.certificates import Certificate
from spikeloom.runtime.equivalence.divergence import Divergence
from spikeloom.runtime.equivalence.rounding import Rounding
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerSpikes:
    """Spikes of one layer over all recordings.

    `different` counts entries (recording, step, neuron) in which float32 reference and chip differ, `ill_posed` those
    in which float64 and float32 do.
    """

    float: int
    chip: int
    different: int
    ill_posed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """A rung of the ladder: entries of each layer that differ from the float32 reference."""

    stage: str
    different: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """What was reached on one of :data:`levels.LEVELS`; the share is None where the level does not apply."""

    name: str
    share: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Everything that verify finds.

    Predictions are (samples,) int64 and votes (samples, classes) int64. The specification ran beside the engine on
    `spec_samples` recordings; `spec_equals_engine` says whether every spike, membrane and count was equal there, and,
    with onnxruntime beside, whether its spikes, membranes after the reset and votes were so too, and its spikes our
    engine's on all recordings: `engine_different` counts those that are not. `quantised_different` counts spikes in
    which a fine-tuned checkpoint's torch model, on chip integers, and the chip differ. `not_compared` are neurons of
    each layer that the chip omits because their spikes reach no neuron. `missed` is what was required.
    """

    files: tuple[str, ...] = field(metadata=HIDDEN)
    labels: IntArray = field(metadata=HIDDEN)
    float_predictions: IntArray = field(metadata=HIDDEN)
    chip_predictions: IntArray = field(metadata=HIDDEN)
    float_counts: IntArray = field(metadata=HIDDEN)
    chip_counts: IntArray = field(metadata=HIDDEN)
    spikes: Mapping[str, LayerSpikes]
    spec_samples: int
    spec_equals_engine: bool
    weights: Rounding
    first_divergence: Divergence | None
    ladder: tuple[Rung, ...]
    same_checkpoint: bool
    quantised_different: int | None
    breakdowns: tuple[Breakdown, ...]
    not_compared: Mapping[str, int]
    certificate: Certificate
    engine: str
    engine_different: int | None
    levels: tuple[Level, ...] = ()
    missed: tuple[str, ...] = ()
    explained_cost: tuple[Part, ...] | None = field(default=None, metadata=OPTIONAL)

    json_properties = ("samples", "accuracy", "decision_agreement")

    @property
    def samples(self) -> int:
        """Recordings."""
        return len(self.files)

    @property
    def accuracy(self) -> Mapping[str, float]:
        """Shares of recordings that each side, ``float`` and ``chip``, gets right."""
        sides = {"float": self.float_predictions, "chip": self.chip_predictions}
        return {side: float(np.mean(decided == self.labels)) for side, decided in sides.items()}

    @property
    def decision_agreement(self) -> float:
        """Share of recordings in which both decide alike."""
        return float(np.mean(self.float_predictions == self.chip_predictions))
