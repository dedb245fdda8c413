"""What a comparison of float model and chip comes to: levels of equivalence, and gates that ask for them.

*EN*: the netlist is its checkpoint, rounded, see :mod:`equivalence.rounding`. *E0*: specification, engine and the
netlist as read from disk agree in every spike, membrane and count. *E1*: a quantisation-aware model equals the chip; it
applies to fine-tuned checkpoints only. *E2*: spikes against the float model, per layer, as ``1 - different / (float +
chip)``. *E3*: decisions against the float model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import shorten
from typing import TYPE_CHECKING

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.passes.range_proof import open_ranges
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.equivalence.breakdowns import Breakdown
from spikeloom.runtime.equivalence.rounding import Rounding
from spikeloom.runtime.machines.simulated import Part
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Block, Section, Table, Text

if TYPE_CHECKING:
    from spikeloom.runtime.equivalence.certificates import Certificate  # it loads numba

LEVELS = {
    "EN": "every number of the netlist is what the checkpoint's becomes by rounding",
    "E0": "the fast simulator does in every bit what the chip's definition does",
    "E1": "a model that was trained on the chip's integers does what the chip does",
    "E2": "share of spikes that float model and chip have in common",
    "E3": "share of recordings that both decide alike",
}
"""What a comparison is held to, from the files to the decisions."""

SHARES = ("E2", "E3")
"""Levels whose gate needs a share."""


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
class Divergence:
    """The first entry in which chip and float model differ: first recording, then step, layer, neuron.

    Membranes before the comparison and thresholds are in the float model's units, the register is as it stands. Taxel
    and feature are the neuron in a graph convolution's own terms. It is ill-posed if the float64 model sides with the
    chip.
    """

    file: str
    step: int
    layer: str
    neuron: int
    taxel: int | None
    feature: int | None
    float_membrane: float
    chip_membrane: float
    chip_register: int
    theta: float
    chip_theta: float
    ill_posed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """A rung of the ladder: entries of each layer that differ from the float32 reference."""

    stage: str
    different: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """What was reached on one of ``LEVELS``; the share is None where the level does not apply."""

    name: str
    share: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """Everything that verify finds.

    Predictions are (samples,) int64 and votes (samples, classes) int64. The specification ran beside the engine on
    `spec_samples` recordings, of a free-running netlist also in a row; `spec_equals_engine` says whether every spike,
    membrane and count was equal there, and, with onnxruntime beside, whether its spikes and votes are our engine's on
    all recordings: `engine_different` counts those that are not. `row_different` are decisions that differ where all
    follow each other on a free-running chip. `quantised_different` counts spikes in
    which a fine-tuned checkpoint's torch model, on chip integers, and the chip differ. `not_compared` are neurons of
    each layer that the chip omits because their spikes reach no neuron. Of the levels the shares `required` have to be
    reached, and EN always.
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
    quantised_different: int | None
    breakdowns: tuple[Breakdown, ...]
    not_compared: Mapping[str, int]
    certificate: Certificate
    engine: str
    engine_different: int | None
    required: Mapping[str, float] = field(metadata=HIDDEN)
    row_different: int | None = field(default=None, metadata=OPTIONAL)
    same_checkpoint: bool = True
    explained_cost: tuple[Part, ...] | None = field(default=None, metadata=OPTIONAL)

    json_properties = ("samples", "accuracy", "decision_agreement", "levels", "missed")

    @property
    def samples(self) -> int:
        """Recordings."""
        return len(self.files)

    @property
    def different(self) -> int:
        """Spikes that are not the float model's."""
        return sum(layer.different for layer in self.spikes.values())

    @property
    def accuracy(self) -> Mapping[str, float]:
        """Shares of recordings that each side, ``float`` and ``chip``, gets right."""
        sides = {"float": self.float_predictions, "chip": self.chip_predictions}
        return {side: float(np.mean(decided == self.labels)) for side, decided in sides.items()}

    @property
    def decision_agreement(self) -> float:
        """Share of recordings in which both decide alike."""
        return float(np.mean(self.float_predictions == self.chip_predictions))

    @property
    def levels(self) -> tuple[Level, ...]:
        """What was reached on each level."""
        return levels_of(self)

    @property
    def missed(self) -> tuple[str, ...]:
        """What was required and is not reached, a line each."""
        return tuple(unmet(self.levels, {"EN": 1.0, **self.required}))


def spike_agreement(spikes: LayerSpikes) -> float:
    """Share of the spikes of a layer that float model and chip have in common, 1 for two silent layers.

    >>> spike_agreement(LayerSpikes(float=60, chip=40, different=20, ill_posed=0))
    0.8
    """
    total = spikes.float + spikes.chip
    return 1 - spikes.different / total if total else 1.0


def in_a_sentence(verdict: Verdict) -> str:
    """What it comes to, for a reader of nothing else."""
    if verdict.missed:
        return f"Do not use this netlist: {'; '.join(verdict.missed)}."
    equal = round(verdict.decision_agreement * verdict.samples)
    chip, model = (round(verdict.accuracy[side] * verdict.samples) for side in ("chip", "float"))
    alike = f"decides as the float model on {equal} of {verdict.samples} recordings"
    return (
        f"The netlist is its checkpoint, rounded; the chip {alike} and is right on {chip}, the float model on {model}."
    )


def mcnemar(labels: IntArray, first: IntArray, second: IntArray) -> tuple[int, int, float]:
    """Exact paired comparison of two classifiers [1]_: recordings that only one gets right, and a two-sided p-value.

    That is the probability of a split at least as uneven if both were equally good (binomial, 1/2).

    References
    ----------
    .. [1] Q. McNemar, "Note on the sampling error of the difference between correlated proportions or percentages",
       Psychometrika 12, 1947.

    >>> import numpy as np
    >>> labels = np.zeros(6, int)
    >>> mcnemar(labels, np.array([0, 0, 0, 0, 0, 1]), np.array([1, 1, 1, 1, 1, 1]))
    (5, 0, 0.0625)
    """
    only_first = int(((first == labels) & (second != labels)).sum())
    only_second = int(((first != labels) & (second == labels)).sum())
    n, k = only_first + only_second, min(only_first, only_second)
    tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
    return only_first, only_second, min(1.0, 2 * tail)


def levels_of(verdict: Verdict) -> tuple[Level, ...]:
    """Summarise a verdict on all levels."""
    agreement = {name: spike_agreement(spikes) for name, spikes in verdict.spikes.items()}
    worst = min(agreement, key=lambda name: agreement[name])
    equal = round(verdict.decision_agreement * len(verdict.files))
    only_float, only_chip, p = mcnemar(verdict.labels, verdict.float_predictions, verdict.chip_predictions)
    moved = int(abs(verdict.float_counts - verdict.chip_counts).sum())
    further, tuned = "", verdict.quantised_different
    if verdict.engine_different is not None:
        where = f"{verdict.engine_different:,} differing spikes on {len(verdict.files)} recordings"
        further = f"; {verdict.engine} beside it, {where}"
    if verdict.row_different is not None:
        further += f", alone and in a row; there {verdict.row_different} of {len(verdict.files)} decisions are others"
    exact = "not applicable: the checkpoint was not fine-tuned on the chip's integers"
    if tuned is not None:
        spikes = sum(layer.chip for layer in verdict.spikes.values())
        exact = f"fine-tuned model = chip: {tuned:,} differing spikes of {spikes:,} on {len(verdict.files)} recordings"
    return (
        Level(name="EN", share=float(verdict.weights.holds), text=verdict.weights.text),
        Level(
            name="E0",
            share=float(verdict.spec_equals_engine),
            text=f"specification = engine {'in' if verdict.spec_equals_engine else 'NOT in'} every spike, membrane and "
            f"count of {verdict.spec_samples} recordings{further}",
        ),
        Level(name="E1", share=None if tuned is None else float(tuned == 0), text=exact),
        Level(
            name="E2",
            share=agreement[worst],
            text="spikes in common with the float model: "
            + ", ".join(f"{name} {100 * share:.2f} %" for name, share in agreement.items()),
        ),
        Level(
            name="E3",
            share=verdict.decision_agreement,
            text=f"{equal} of {len(verdict.files)} decisions equal; right on float only {only_float}, on chip only "
            f"{only_chip} (exact McNemar p = {p:.3g}); class votes moved: {moved:,} of {verdict.float_counts.sum():,}",
        ),
    )


def parse_requirements(words: str) -> dict[str, float]:
    """Read a gate such as ``E0,E2=0.99,E3=0.98``; OptionError if a part is no level, comes twice, or has a wrong share.

    >>> parse_requirements("E0,E3=0.98")
    {'E0': 1.0, 'E3': 0.98}
    """
    required: dict[str, float] = {}
    for part in words.split(","):
        name, given, number = part.strip().partition("=")
        where = f"--require {words}: {part.strip()!r}"
        if name not in LEVELS or name in required:
            raise OptionError(f"{where}: give each of EN, E0, E1, E2=SHARE, E3=SHARE once at most, with commas between")
        if bool(given) != (name in SHARES):
            raise OptionError(f"{where}: {'needs a share, as in ' + name + '=0.98' if not given else 'takes no share'}")
        try:
            share = float(number) if given else 1.0
        except ValueError:
            share = math.nan
        if not 0 <= share <= 1:
            raise OptionError(f"{where}: not a share; give a number from 0 to 1")
        required[name] = share
    return required


def unmet(levels: tuple[Level, ...], required: Mapping[str, float]) -> list[str]:
    """Say which required levels are not reached."""
    missed = []
    for level in levels:
        wanted = required.get(level.name)
        if wanted is None or (level.share is not None and level.share >= wanted):
            continue
        if level.name in SHARES and level.share is not None:
            missed.append(f"{level.name}: {level.share:.4f} reached, {wanted:g} required")
        else:
            missed.append(f"{level.name}: {shorten(level.text, 100, placeholder=' …')}")
    return missed


def sections(verdict: Verdict) -> list[Section]:
    """Accuracies, levels and warnings; spikes; the ladder; the certificate; the first divergence."""
    spikes = [
        [name, *(f"{count:,}" for count in (layer.float, layer.chip, layer.different, layer.ill_posed))]
        for name, layer in verdict.spikes.items()
    ]
    ladder = [[rung.stage, *(f"{rung.different[name]:,}" for name in verdict.spikes)] for rung in verdict.ladder]
    first = verdict.first_divergence
    return [
        Section("Levels", [Text("\n".join(_lines(verdict)))]),
        Section("Spikes", [Table(["spikes", "float", "chip", "different", "ill-posed"], spikes)]),
        Section("Ladder", [Table(["different, adding", *verdict.spikes], ladder)]),
        Section("Certificate", certified(verdict.certificate)),
        Section("First divergence", [Text("no spike differs" if first is None else _divergence(first))]),
    ]


def _lines(verdict: Verdict) -> list[str]:
    right = {side: round(share * verdict.samples) for side, share in verdict.accuracy.items()}
    lines = [
        f"float accuracy:  {percent(right['float'], verdict.samples)}",
        f"chip accuracy:   {percent(right['chip'], verdict.samples)}",
        *(f"{level.name}  {level.text}" for level in verdict.levels),
        *(f"missed: {line}" for line in verdict.missed),
        *(f"breakdown: {breakdown.text}" for breakdown in verdict.breakdowns),
    ]
    if not verdict.same_checkpoint:
        lines.append(
            "note: the netlist was compiled from another checkpoint file than this one, or from other weights of it"
        )
    if verdict.not_compared:
        absent = ", ".join(f"{name} {count:,}" for name, count in verdict.not_compared.items())
        lines.append(f"not compared, left out because their spikes reach no neuron: {absent}")
    return lines


def certified(certificate: Certificate) -> list[Block]:
    """Entries that no order of summation changes, certified decisions, and whether registers stay in range."""
    rows = [
        [
            name,
            f"{layer.entries:,}",
            f"{100 * layer.equal / max(layer.entries, 1):.4f} %",
            f"{layer.different:,}",
            f"{layer.undecided:,}",
        ]
        for name, layer in certificate.layers.items()
    ]
    proof = (
        "; ".join(open_ranges(certificate.unproven, certificate.saturating)) or "no register overflows for any input"
    )
    return [
        Table(["certified in any order of sums", "entries", "equal", "different", "undecided"], rows),
        Text(f"{certificate.decisions} of {certificate.samples} decisions certified equal; {proof}"),
    ]


def _divergence(first: Divergence) -> str:
    """Where the first spike differs, and how near both membranes were to their thresholds."""
    where = f"neuron {first.neuron}"
    if first.taxel is not None:
        where = f"taxel {first.taxel}, feature {first.feature}"
    return (
        f"first divergence: {first.file}, step {first.step}, {first.layer} {where}: membrane "
        f"{first.float_membrane:.6f} float, {first.chip_membrane:.6f} chip ({first.chip_register}/64 units); "
        f"threshold {first.theta:g} and {first.chip_theta:.6f}"
        + (" (ill-posed: float64 sides with the chip)" if first.ill_posed else "")
    )
