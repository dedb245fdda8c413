"""An explanation in numbers: roots by layer and cause, and the first of them in full, each with what removes it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from spikeloom.compiler.ir import IntegerNetwork
from spikeloom.runtime.equivalence.explanation.causes import Explanation, RootCause
from spikeloom.runtime.equivalence.explanation.deviations import (
    BETA,
    BIAS,
    LEFT_OUT,
    SATURATION,
    THRESHOLD,
    TIE,
    TRUNCATION,
    WEIGHTS,
)

_BOUND = ", as far as the accumulator lets it"


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerRoots:
    """Entries (neuron and step) of a layer that spike or differ: differences are roots, or follow from roots."""

    name: str
    float_spikes: int
    chip_spikes: int
    different: int
    roots: int
    propagated: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseRoots:
    """Roots of one cause, by layer; how many of them would go if no large weight were cut off by its range."""

    cause: str
    roots: int
    layers: Mapping[str, int]
    from_clipped_weights: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RootEntry:
    """One root: membranes and their distance to the threshold in the float model's units, registers as stored.

    What the chip has is None where it does not hold the neuron; `moved` is how far each cause moved its membrane.
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
class Explained:
    """Why chip and float model differ on one recording, its number counted from 0.

    So many recordings were `searched` for a difference. Of the `different` entries `roots` follow from no other; the
    `diagnosis` is the cause of most. `faults` says where the netlist is not the rounding of the checkpoint at all;
    `top` are the roots that drag most along.
    """

    sample: str
    split: str
    recording: int
    searched: int
    steps: int
    graph: str | None
    reference: str
    different: int
    roots: int
    diagnosis: str | None
    layers: tuple[LayerRoots, ...]
    causes: tuple[CauseRoots, ...]
    faults: tuple[str, ...]
    top: tuple[RootEntry, ...]


def layer_roots(found: Explanation, names: list[str]) -> tuple[LayerRoots, ...]:
    """Roots by layer."""
    roots = Counter(root.root.layer for root in found.roots)
    return tuple(
        LayerRoots(
            name=name,
            float_spikes=found.float_spikes[i],
            chip_spikes=found.chip_spikes[i],
            different=found.different[i],
            roots=roots[i],
            propagated=found.different[i] - roots[i],
        )
        for i, name in enumerate(names)
    )


def cause_roots(found: Explanation, names: list[str]) -> tuple[CauseRoots, ...]:
    """Roots by cause."""
    both = Counter((root.cause, names[root.root.layer]) for root in found.roots)
    return tuple(
        CauseRoots(
            cause=cause,
            roots=count,
            layers={name: both[cause, name] for name in names},
            from_clipped_weights=sum(root.clipped and root.cause == cause for root in found.roots),
        )
        for cause, count in Counter(root.cause for root in found.roots).most_common()
    )


def root_entry(found: RootCause, integer: IntegerNetwork, features: int | None) -> RootEntry:
    """One root; `features` of a taxel where its layer is a graph convolution."""
    root, held = found.root, found.held
    name = integer.populations[root.layer].name
    stored = [p for p in integer.projections if p.post == root.layer]
    bits, planes = max(p.bits for p in stored), len({p.exponent for p in stored})
    return RootEntry(
        layer=name,
        neuron=root.neuron,
        taxel=None if features is None else root.neuron // features,
        feature=None if features is None else root.neuron % features,
        step=root.step,
        remembers_from_step=root.begin,
        float_fires=found.float_fires,
        float_membrane=found.float_membrane,
        float_distance=found.float_membrane - found.theta,
        theta=found.theta,
        chip_membrane=found.chip_membrane if held else None,
        chip_distance=found.chip_membrane - found.chip_theta if held else None,
        chip_theta=found.chip_theta if held else None,
        chip_register=found.chip_register if held else None,
        chip_threshold_register=found.chip_threshold if held else None,
        cause=found.cause,
        held=held,
        clipped_weights=found.clipped,
        sufficient=found.sufficient,
        moved=dict(found.moved),
        change=remedy(found, name, bits=bits, planes=planes),
        dragged=root.dragged,
        dragged_alone=root.alone,
    )


def remedy(found: RootCause, layer: str, *, bits: int, planes: int) -> str:
    """The change that would remove a root of a layer that is stored with so many bits and planes."""
    if found.cause == WEIGHTS:
        why = "the range cuts off its largest weights" if found.clipped else "its weights are too coarse"
        if not found.held:
            why = "no input can make it fire with its rounded weights"
        wider = "--weight-bits 8 or " if bits < 8 else ""
        if planes < 3:
            return f"{why}: compile {layer} with {wider}--planes {planes + 1}{_BOUND if planes > 1 else ''}"
        return f"{why}: compile {layer} with {wider}--scale-groups 8{_BOUND}"
    return {
        BIAS: f"a bias counts in 64ths of a weight unit: compile {layer} with --scale-groups 8, for finer units",
        THRESHOLD: "choose the scale as threshold / theta: compile it again",
        BETA: "none on this chip, whose decay has 12 bits; a model trained with the realised decay would agree",
        TRUNCATION: f"what the chip drops is part of one unit: compile {layer} with --scale-groups 8, for finer units",
        SATURATION: f"the membrane leaves its 23 bits: compile {layer} with a coarser scale",
        LEFT_OUT: "compile without --prune-unused",
        TIE: "none: the order of a sum in float64 decides here, either spike is right",
    }.get(found.cause, "none is known")
