"""What a comparison of float model and chip comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.fixedpoint import IntArray
from spikeloom.runtime.costs.simulated import Part
from spikeloom.runtime.equivalence.breakdowns import Breakdown
from spikeloom.runtime.equivalence.certificates import Certificate
from spikeloom.runtime.equivalence.divergence import Divergence
from spikeloom.runtime.equivalence.rounding import Rounding
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerSpikes:
    """Spikes of one layer over all recordings.

    Parameters
    ----------
    float, chip : int
        Spikes of the float32 reference and of the chip.
    different : int
        Entries (recording, step, neuron) in which they differ.
    ill_posed : int
        Entries in which the float64 model differs from the float32 one.
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
    """What was reached on one of :data:`levels.LEVELS`.

    Parameters
    ----------
    name : str
        One of ``LEVELS``.
    share : float or None
        From 0 to 1; None where the level does not apply.
    text : str
        For people.
    """

    name: str
    share: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Everything that verify finds.

    Parameters
    ----------
    files : tuple of str
        Recordings.
    labels, float_predictions, chip_predictions : (samples,) int64
        Classes.
    float_counts, chip_counts : (samples, classes) int64
        Votes per class.
    spikes : mapping of str to LayerSpikes
        Per layer.
    spec_samples : int
        Recordings on which the specification was run beside the engine.
    spec_equals_engine : bool
        Whether every spike, membrane and count was equal there; with onnxruntime beside, whether its spikes, its
        membranes after the reset and its votes were so too, and its spikes those of our engine on all recordings.
    weights : Rounding
        Whether the netlist holds the rounding of the checkpoint.
    first_divergence : Divergence or None
        None if no spike differs.
    ladder : tuple of Rung
        Differences from the float32 reference with one deviation more on each rung.
    same_checkpoint : bool
        Whether the netlist was compiled from this very checkpoint file and epoch.
    quantised_different : int or None
        Spikes of all layers in which a fine-tuned checkpoint's torch model, on chip integers, and the chip differ;
        None where the checkpoint was not fine-tuned.
    breakdowns : tuple of Breakdown
        Known failures.
    not_compared : mapping of str to int
        Neurons of each layer that the chip leaves out because no neuron receives them, where there are any.
    certificate : Certificate
        What of all this holds in whatever order the float model adds, and of registers for any input.
    engine : str
        One of ``ENGINES``.
    engine_different : int or None
        Spikes in which the further engine differs from ours, on all recordings; None where there is no further one.
    levels : tuple of Level
        Summary on four levels.
    missed : tuple of str
        What was required and is not reached.
    explained_cost : tuple of Part, optional
        What was simulated for all this.
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
