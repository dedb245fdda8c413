"""What commands say of the layers and towers of a checkpoint."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerSize:
    """Neurons of a layer."""

    name: str
    neurons: int


def tower_line(tower: Mapping[str, Any]) -> str:
    """Where a tower of a joined network is from, in one line."""
    notes = (f"{key} {tower[key]}" for key in ("weights", "seed", "sha256") if key in tower)
    return f"{tower.get('file')}, {', '.join(notes)}"
