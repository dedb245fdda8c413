"""The orders in which storages are tried, and what is found out about each."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from spikeloom.compiler.storage import Packing
from spikeloom.compiler.targets.base import Target


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A storage that was tried: what it keeps, and what it costs."""

    planes: int  # Times that a synapse may be stored
    groups: int  # Scales in a layer, at most
    equal: int = 0  # Decisions of quarters of held-out recordings that are the float model's
    decisions: int = 0  # All of them
    operations: float = (
        0.0  # Synaptic operations of a training recording, where spikes are the float model's
    )
    synapse_words: int = 0  # Memory of all cores
    cores: int = 0
    refused: str | None = field(default=None, metadata={"optional": True})  # Why the chip does not hold it


def cheapest_first(target: Target) -> Iterator[Packing]:
    """What is tried for decisions: more scales cost cores, more planes operations and memory."""
    slots = target.limit("core.threshold_slots")
    return (Packing(planes=planes, groups=groups) for planes in (1, 2) for groups in (1, slots))


def coarsest_first(target: Target, bits: int) -> Iterator[Packing]:
    """What is tried for equal spikes of a layer."""
    slots = target.limit("core.threshold_slots")
    steps = (1, 1), (2, 1), (2, slots), (3, slots)
    return (Packing(bits=bits, planes=planes, groups=groups) for planes, groups in steps)
