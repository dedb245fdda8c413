"""Why one recording differs, in numbers: entries of each layer, roots by cause, and each root with what removes it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from spikeloom.runtime.equivalence.explanation.replay import (
    BETA,
    BIAS,
    LEFT_OUT,
    SATURATION,
    TIE,
    TRUNCATION,
    WEIGHTS,
)
from spikeloom.runtime.report.encode import HIDDEN, INLINE

_BOUND = ", as far as the accumulator lets it"


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

    Membranes before the comparison and their distance to the threshold are in the float model's units, registers as the
    chip compares them; what the chip has is None where it does not hold the neuron. Each of the `sufficient` causes, if
    it alone were gone, would give the float model's spike, and so would weights that the range does not cut off if
    `clipped_weights`. `moved` says how far each cause moved the chip's membrane against its threshold, largest first.
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
                from_clipped_weights=sum(root.clipped_weights and root.cause == cause for root in self.found),
            )
            for cause, count in Counter(root.cause for root in self.found).most_common()
        )

    @property
    def diagnosis(self) -> str | None:
        """The cause of most roots; None if nothing differs."""
        return self.causes[0].cause if self.found else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Explained:
    """The explanation of one recording, its number counted from 0.

    So many recordings were `searched` for a difference. `faults` says where the netlist is not the rounding of the
    checkpoint at all; `top` are the roots that drag most along.
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


def remedy(cause: str, layer: str, *, bits: int, planes: int, clipped: bool = False, held: bool = True) -> str:
    """The change that would remove a root of a layer that is stored with so many bits and planes."""
    if cause == WEIGHTS:
        why = "the range cuts off its largest weights" if clipped else "its weights are too coarse"
        if not held:
            why = "no input can make it fire with its rounded weights"
        wider = "--weight-bits 8 or " if bits < 8 else ""
        if planes < 3:
            return f"{why}: compile {layer} with {wider}--planes {planes + 1}{_BOUND if planes > 1 else ''}"
        return f"{why}: compile {layer} with {wider}--scale-groups 8{_BOUND}"
    return {
        BIAS: f"a bias counts in 64ths of a weight unit: compile {layer} with --scale-groups 8, for finer units",
        BETA: "none on this chip, whose decay has 12 bits; a model trained with the realised decay would agree",
        TRUNCATION: f"what the chip drops is part of one unit: compile {layer} with --scale-groups 8, for finer units",
        SATURATION: f"the membrane leaves its 23 bits: compile {layer} with a coarser scale",
        LEFT_OUT: "compile without --prune-unused",
        TIE: "none: the order of a sum in float64 decides here, either spike is right",
    }.get(cause, "none is known")
