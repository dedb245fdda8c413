"""Recordings as a worn sensor might send them, which train networks to decide stably."""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import EventArray


def require_chance(chance: float) -> None:
    """Refuse what is not a probability; OptionError."""
    if not 0 <= chance < 1:
        raise OptionError(f"--robust {chance:g}: allowed are numbers from 0 to below 1; choose another")


def disturb(events: EventArray, chance: float, draw: np.random.Generator) -> EventArray:
    """Recordings (samples, taxels, polarities, steps) of which each event is lost, and each taxel, with a `chance`.

    As many events as are lost in the mean come anywhere else. Without a chance nothing is drawn.
    """
    if not chance:
        return events
    dropped = draw.random(events.shape) < chance
    come = draw.random(events.shape) < chance * events.mean(axis=(1, 2, 3), keepdims=True)
    alive = draw.random(events.shape[:2]) >= chance
    left: EventArray = ((events & ~dropped) | come) & alive[:, :, None, None]
    return left
