"""What a comparison of network and chip comes to: levels of equivalence, and gates that ask for them.

*EN*: the netlist is what its network is lowered to, see :mod:`machines.netlist_check`. *E0*: specification, engine and
the netlist as read from disk agree in every spike, membrane and count. *E1*: the whole-number model that the network
brings (fine-tuned, trained for the chip, or counting) equals the chip. *E2*: spikes against the float model, per layer,
as ``1 - different / (float + chip)``. *E3*: decisions against the float model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import shorten

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.equivalence.breakdowns import Breakdown
from spikeloom.runtime.machines.netlist_check import NetlistCheck
from spikeloom.runtime.report.encode import HIDDEN, OPTIONAL
from spikeloom.runtime.report.numbers import percent
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown

LEVELS = {
    "EN": "every number of the netlist is what lowering its network gives",
    "E0": "the fast simulator does in every bit what the chip's definition does",
    "E1": "the model in whole numbers that the network brings does what the chip does",
    "E2": "share of spikes that float model and chip have in common",
    "E3": "share of recordings that both decide alike",
}
"""What a comparison is held to, from the files to the decisions."""

SHARES = ("E2", "E3")
"""Levels whose gate needs a share."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerSpikes:
    """Spikes of one layer over all recordings.

    `different` counts entries (recording, step, neuron) in which float32 reference and chip differ,
    `ill_posed` those in which float64 and float32 do.
    """

    float: int
    chip: int
    different: int
    ill_posed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Divergence:
    """The first entry in which chip and float model differ: first recording, then step, layer, neuron.

    Membranes before the comparison and thresholds are in the float model's units, the register is as it
    stands. Taxel and feature are the neuron in a graph convolution's own terms. It is ill-posed if the
    float64 model sides with the chip.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSpikes:
    """Spikes of one layer of the lowered model over all recordings, and those of the chip that are not the same."""

    spikes: int
    different: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Verdict(Shown):
    """Everything that verify finds, on any chip.

    Predictions are (samples,) int64 and votes (samples, classes) int64; those of the float model are None
    where the network is whole numbers and there is none.

    netlist: level EN.
    spec_samples, spec_different: recordings on which the specification ran beside the engine, of a
        free-running netlist also in a row; spikes, membranes and counts that differed.
    engine, engine_different: the further engine, and its spikes and votes that are not our engine's.
    model: level E1 by layer; None where the network brings no whole-number model of its own.
    membranes_saturated: membranes that left their register, which the model's do not; None where the chip
        saturates by definition.
    spikes, ladder, first_divergence: level E2; empty where layers of the chip are not those of a float model.
    not_compared: neurons of each layer that the chip omits because their spikes reach no neuron.
    row_different: decisions that differ where all recordings follow each other on a free-running chip.
    required: shares that levels have to reach; EN always.
    """

    target: str
    files: tuple[str, ...] = field(metadata=HIDDEN)
    labels: IntArray = field(metadata=HIDDEN)
    chip_predictions: IntArray = field(metadata=HIDDEN)
    chip_counts: IntArray = field(metadata=HIDDEN)
    float_predictions: IntArray | None = field(default=None, metadata=HIDDEN)
    float_counts: IntArray | None = field(default=None, metadata=HIDDEN)
    netlist: NetlistCheck
    spec_samples: int
    spec_different: int
    engine: str
    engine_different: int | None
    model: Mapping[str, ModelSpikes] | None
    membranes_saturated: int | None
    spikes: Mapping[str, LayerSpikes] = field(default_factory=dict)
    ladder: tuple[Rung, ...] = ()
    first_divergence: Divergence | None = None
    breakdowns: tuple[Breakdown, ...] = ()
    not_compared: Mapping[str, int] = field(default_factory=dict)
    row_different: int | None = field(default=None, metadata=OPTIONAL)
    required: Mapping[str, float] = field(default_factory=dict, metadata=HIDDEN)
    same_checkpoint: bool = True

    json_properties = (
        "samples",
        "accuracy",
        "decision_agreement",
        "votes_moved",
        "spec_equals_engine",
        "levels",
        "missed",
    )

    @property
    def samples(self) -> int:
        """Recordings."""
        return len(self.files)

    @property
    def spec_equals_engine(self) -> bool:
        """Whether specification, engine and the further engine did the same."""
        return not (self.spec_different or self.engine_different)

    @property
    def model_different(self) -> int | None:
        """Spikes that are not the lowered model's."""
        return None if self.model is None else sum(layer.different for layer in self.model.values())

    @property
    def different(self) -> int:
        """Spikes that are not the float model's, or where the network is whole numbers not the lowered model's."""
        return (
            sum(layer.different for layer in self.spikes.values())
            if self.spikes
            else self.model_different or 0
        )

    @property
    def right(self) -> Mapping[str, int]:
        """Recordings that each side, ``float`` and ``chip``, gets right."""
        sides = {"float": self.float_predictions, "chip": self.chip_predictions}
        return {
            side: int(np.count_nonzero(decided == self.labels))
            for side, decided in sides.items()
            if decided is not None
        }

    @property
    def accuracy(self) -> Mapping[str, float]:
        """Share of recordings that each side gets right."""
        return {side: count / self.samples for side, count in self.right.items()}

    @property
    def equal(self) -> int | None:
        """Recordings in which float model and chip decide alike."""
        if self.float_predictions is None:
            return None
        return int(np.count_nonzero(self.float_predictions == self.chip_predictions))

    @property
    def decision_agreement(self) -> float | None:
        """Share of recordings in which they do."""
        return None if self.equal is None else self.equal / self.samples

    @property
    def votes_moved(self) -> int | None:
        """Votes that the chip gives another class than the float model does, or does not give."""
        return None if self.float_counts is None else int(abs(self.float_counts - self.chip_counts).sum())

    @property
    def levels(self) -> tuple[Level, ...]:
        """What was reached on each level."""
        return (
            Level(name="EN", share=float(self.netlist.holds), text=self.netlist.text),
            _engine_level(self),
            _model_level(self),
            _spike_level(self),
            _decision_level(self),
        )

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
    right = verdict.right
    if verdict.equal is None:
        same = "the chip has every spike of its model"
        return f"The netlist is its network; {same} and is right on {right['chip']} of {verdict.samples} recordings."
    alike = f"decides as the float model on {verdict.equal} of {verdict.samples} recordings"
    sides = f"is right on {right['chip']}, the float model on {right['float']}"
    return f"The netlist is its checkpoint, rounded; the chip {alike} and {sides}."


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
    n = only_first + only_second
    k = min(only_first, only_second)
    tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
    return only_first, only_second, min(1.0, 2 * tail)


def _engine_level(verdict: Verdict) -> Level:
    """E0: specification, our engine and another one."""
    samples = verdict.samples
    text = (
        f"specification = engine {'in' if verdict.spec_equals_engine else 'NOT in'} every spike, membrane and "
        f"count of {verdict.spec_samples} recordings"
    )
    if verdict.engine_different is not None:
        where = f"{verdict.engine_different:,} differing spikes on {samples} recordings"
        text += f"; {verdict.engine} beside it, {where}"
    if verdict.row_different is not None:
        text += f", alone and in a row; there {verdict.row_different} of {samples} decisions are others"
    return Level(name="E0", share=float(verdict.spec_equals_engine), text=text)


def _model_level(verdict: Verdict) -> Level:
    """E1: lowered model and chip."""
    different = verdict.model_different
    if verdict.model is None or different is None:
        text = "not applicable: the checkpoint was not fine-tuned on the chip's integers"
        return Level(name="E1", share=None, text=text)
    spikes = sum(layer.spikes for layer in verdict.model.values())
    text = (
        f"lowered model = chip: {different:,} differing spikes of {spikes:,} on {verdict.samples} recordings"
    )
    if verdict.membranes_saturated is not None:
        text += f"; membranes that left their register: {verdict.membranes_saturated:,}"
    return Level(name="E1", share=float(not different and not verdict.membranes_saturated), text=text)


def _spike_level(verdict: Verdict) -> Level:
    """E2: spikes of the float model."""
    if not verdict.spikes:
        return Level(
            name="E2", share=None, text="not applicable: layers of the chip are not those of a float model"
        )
    agreement = {name: spike_agreement(spikes) for name, spikes in verdict.spikes.items()}
    shares = ", ".join(f"{name} {100 * share:.2f} %" for name, share in agreement.items())
    return Level(
        name="E2", share=min(agreement.values()), text=f"spikes in common with the float model: {shares}"
    )


def _decision_level(verdict: Verdict) -> Level:
    """E3: decisions of the float model."""
    agreement = verdict.decision_agreement
    if agreement is None or verdict.float_predictions is None or verdict.float_counts is None:
        return Level(name="E3", share=None, text="not applicable: there is no float model")
    only_float, only_chip, p = mcnemar(verdict.labels, verdict.float_predictions, verdict.chip_predictions)
    text = (
        f"{verdict.equal} of {verdict.samples} decisions equal; right on float only {only_float}, on chip only "
        f"{only_chip} (exact McNemar p = {p:.3g}); class votes moved: {verdict.votes_moved:,} "
        f"of {verdict.float_counts.sum():,}"
    )
    return Level(name="E3", share=agreement, text=text)


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
            raise OptionError(
                f"{where}: give each of EN, E0, E1, E2=SHARE, E3=SHARE once at most, with commas between"
            )
        if bool(given) != (name in SHARES):
            raise OptionError(
                f"{where}: {'needs a share, as in ' + name + '=0.98' if not given else 'takes no share'}"
            )
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
    """Accuracies, levels and warnings; spikes of model and float model; the ladder; the first divergence."""
    chapters = [Section("Levels", [Text("\n".join(_lines(verdict)))])]
    if verdict.model is not None:
        rows = [[name, f"{layer.spikes:,}", f"{layer.different:,}"] for name, layer in verdict.model.items()]
        chapters.append(
            Section("Lowered model", [Table(["layer", "spikes of the model", "different"], rows)])
        )
    if verdict.spikes:
        first = verdict.first_divergence
        divergence = "no spike differs" if first is None else _divergence(first)
        chapters += [
            Section("Spikes", [_spike_table(verdict)]),
            Section("Ladder", [_ladder_table(verdict)]),
            Section("First divergence", [Text(divergence)]),
        ]
    return chapters


def _spike_table(verdict: Verdict) -> Table:
    rows = [
        [name, *(f"{count:,}" for count in (layer.float, layer.chip, layer.different, layer.ill_posed))]
        for name, layer in verdict.spikes.items()
    ]
    return Table(["spikes", "float", "chip", "different", "ill-posed"], rows)


def _ladder_table(verdict: Verdict) -> Table:
    rows = [
        [rung.stage, *(f"{rung.different[name]:,}" for name in verdict.spikes)] for rung in verdict.ladder
    ]
    return Table(["different, adding", *verdict.spikes], rows)


def _lines(verdict: Verdict) -> list[str]:
    lines = [
        *(f"{side + ' accuracy:':<17}{percent(n, verdict.samples)}" for side, n in verdict.right.items()),
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
