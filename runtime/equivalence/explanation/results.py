"""Why one recording differs: entries of each layer, roots by cause, and each root with what removes it."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import wrap

from spikeloom.runtime.machines.deviations import TIE
from spikeloom.runtime.report.encode import HIDDEN, INLINE
from spikeloom.runtime.report.sections import Section, Table, Text
from spikeloom.runtime.report.shown import Shown


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerRoots:
    """Entries (neuron and step) of a layer that spike or differ: differences are roots, or follow from roots."""

    name: str
    float_spikes: int
    chip_spikes: int
    different: int
    roots: int

    json_properties = ("propagated",)

    @property
    def propagated(self) -> int:
        """Differences that follow from roots."""
        return self.different - self.roots


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseRoots:
    """Roots of one cause, by layer; how many of them would go if no large weight were cut off by its range."""

    cause: str
    roots: int
    layers: Mapping[str, int]
    from_clipped_weights: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RootCause:
    """A root, why it differs, and what would change that.

    Membranes before the comparison and their distance to the threshold are in the float model's units,
    registers as the chip compares them; what the chip has is None where it does not hold the neuron. Each
    of the `sufficient` causes, if it alone were gone, would give the float model's spike, and so would
    weights that the range does not cut off if `clipped_weights`. `moved` says how far each cause moved the
    chip's membrane against its threshold, largest first.
    """

    layer: str
    neuron: int
    taxel: int | None
    feature: int | None
    step: int
    remembers_from_step: int
    float_fires: bool
    float_membrane: float
    float_distance: float
    theta: float
    chip_membrane: float | None
    chip_distance: float | None
    chip_theta: float | None
    chip_register: int | None
    chip_threshold_register: int | None
    cause: str
    held: bool
    clipped_weights: bool
    sufficient: tuple[str, ...]
    moved: Mapping[str, float]
    change: str
    dragged: int
    dragged_alone: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """All layers, and the roots that were `found`, those first that drag most along."""

    layers: tuple[LayerRoots, ...]
    found: tuple[RootCause, ...] = field(metadata=HIDDEN)

    json_properties = ("different", "roots", "diagnosis", "causes")

    @property
    def different(self) -> int:
        """Entries that differ."""
        return sum(layer.different for layer in self.layers)

    @property
    def roots(self) -> int:
        """Those that follow from no other."""
        return len(self.found)

    @property
    def causes(self) -> tuple[CauseRoots, ...]:
        """Roots by cause, the most frequent first."""
        both = Counter((root.cause, root.layer) for root in self.found)
        return tuple(
            CauseRoots(
                cause=cause,
                roots=count,
                layers={layer.name: both[cause, layer.name] for layer in self.layers},
                from_clipped_weights=sum(
                    root.clipped_weights and root.cause == cause for root in self.found
                ),
            )
            for cause, count in Counter(root.cause for root in self.found).most_common()
        )

    @property
    def diagnosis(self) -> str | None:
        """The cause of most roots; None if nothing differs."""
        return self.causes[0].cause if self.found else None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Explained(Shown):
    """The explanation of one recording, its number counted from 0.

    So many recordings were `searched` for a difference. `faults` says where the netlist is not the
    rounding of the checkpoint at all; `top` are the roots that drag most along.
    """

    sample: str
    split: str
    recording: int
    searched: int
    steps: int
    graph: str | None
    explanation: Explanation = field(metadata=INLINE)
    faults: tuple[str, ...]
    top: tuple[RootCause, ...]
    reference: str = "float64"


WIDTH = 116
"""Columns of a line of text."""


def sections(explained: Explained) -> list[Section]:
    """Where they differ, why, and the roots that drag most along."""
    where = f"{explained.sample} ({explained.split} split, recording {explained.recording} counted from 0)"
    faults = [Text("\n".join(wrap(f"FAULT of the netlist: {fault}", WIDTH))) for fault in explained.faults]
    why = explained.explanation
    if not why.different:
        what = (
            where
            if explained.searched == 1
            else f"the first {explained.searched} recordings of the {explained.split} split"
        )
        equal = Text(f"{what}: every spike of the chip is the float64 model's; nothing to explain")
        return [Section("", [equal, *faults])]
    columns = ("float_spikes", "chip_spikes", "different", "roots", "propagated")
    layers = Table(
        ["layer", *(column.replace("_", " ") for column in columns)],
        [[layer.name, *(f"{getattr(layer, column):,}" for column in columns)] for layer in why.layers],
    )
    names = [layer.name for layer in why.layers]
    causes = Table(
        ["cause of roots", *names, "all"],
        [
            [each.cause, *(f"{each.layers[name]:,}" for name in names), f"{each.roots:,}"]
            for each in why.causes
        ],
    )
    clipped = sum(cause.from_clipped_weights for cause in why.causes)
    line = f"  {clipped:,} of these roots would go if no large weight were cut off by its range"
    shown = (
        f" ({len(explained.top):,} of {why.roots:,} shown, --top shows more)"
        if why.roots > len(explained.top)
        else ""
    )
    entries = (
        f"{why.different:,} entries (neuron and step) differ from the float64 model: {why.roots:,} are roots, "
        f"{why.different - why.roots:,} follow from them"
    )
    return [
        Section("", [Text(where), Text(entries)]),
        Section("Layers", [layers]),
        Section("Causes", [causes, *([Text(line)] if clipped else []), *faults]),
        Section("Diagnosis", [Text(f"diagnosis: {why.diagnosis}")]),
        Section("Roots", [Text(f"roots, those first that drag most along{shown}:")]),
        *(
            Section("", [Text("\n".join(_root(number, root)))])
            for number, root in enumerate(explained.top, 1)
        ),
    ]


def _root(number: int, root: RootCause) -> list[str]:
    graph = "" if root.taxel is None else f" (taxel {root.taxel}, feature {root.feature})"
    fires = (
        "the float model fires, the chip does not"
        if root.float_fires
        else "the chip fires, the float model not"
    )
    chip = "does not hold this neuron"
    if root.chip_membrane is not None and root.chip_distance is not None and root.chip_theta is not None:
        chip = _membrane(root.chip_membrane, root.chip_distance, root.chip_theta)
        chip += f"; registers {root.chip_register} and {root.chip_threshold_register}"
    moved = root.moved.get(root.cause)
    by = "" if moved is None else f", which moved the membrane by {moved:.3g}"
    only = (
        "" if not root.held or root.cause in (TIE, *root.sufficient) else "; no single change is enough here"
    )
    follow = f"{root.dragged:,} later differences, {root.dragged_alone:,} of them from this root alone"
    return [
        f"{number:3}. {root.layer} neuron {root.neuron}{graph}, step {root.step}: {fires}",
        f"     float    {_membrane(root.float_membrane, root.float_distance, root.theta)}",
        f"     chip     {chip}",
        f"     cause    {root.cause}{by}{only}",
        f"     change   {root.change}",
        f"     drags    {follow}",
    ]


def _membrane(value: float, distance: float, theta: float) -> str:
    side = "above" if distance > 0 else "below"
    place = f"{abs(distance):.3g} {side}" if distance else "exactly at"
    return f"membrane {value:9.6f}, {place} the threshold {theta:.6g}"
