"""How weights may be stored: what a user asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from spikeloom.compiler.ir import Form

KEEP = 0.98
"""Share of equal decisions that storage has to keep if nothing else is asked for."""

MAX_PLANES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Packing:
    """How one population is to be stored: what was asked for; a ``Form`` is what came of it."""

    bits: int = 8  # Storage width of a mantissa
    planes: int = 1  # Times that a synapse may be stored, with different exponents
    groups: int = 1  # Different thresholds, and so scales, at most


@dataclass(frozen=True, slots=True)
class Fixed:
    """Storage exactly as it is stated here."""

    packings: tuple[Packing, ...] = (Packing(),)  # One for each layer, or one for all


@dataclass(frozen=True, slots=True)
class Cheapest:
    """The cheapest storage that keeps decisions of held-out training recordings; 8 bits where there are none."""

    keep: float = KEEP  # Least share of decisions that are the float model's


@dataclass(frozen=True, slots=True)
class Exact:
    """Planes and scales are added until every spike on the training recordings is the float64 model's."""

    bits: int = 8  # Storage width of a mantissa


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """Storage that a network was fine-tuned for."""

    forms: Sequence[Form]  # Of each population


EIGHT_BITS = Fixed()
"""The default."""

Storage = Fixed | Cheapest | Exact | Given
"""What decides how weights are stored."""
