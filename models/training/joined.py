"""Several trained networks as one: what a join leaves in its checkpoint and says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinedLayer:
    """A layer, towers side by side."""

    name: str
    neurons: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """Networks that were put side by side; `towers` has of each its file, hash and training record."""

    command: str
    towers: Sequence[Mapping[str, Any]]
    system: str
    graph: str | None
    classes: int
    layers: Sequence[JoinedLayer]
    file: str
    sha256: str


def joined_layers(neurons: Mapping[str, int]) -> tuple[JoinedLayer, ...]:
    """Layers from their neurons by name."""
    return tuple(JoinedLayer(name=name, neurons=count) for name, count in neurons.items())
