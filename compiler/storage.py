"""How weights may be stored: what a user asks for."""

from dataclasses import dataclass

KEEP = 0.98
"""Share of equal decisions that storage has to keep if nothing else is asked for."""

MAX_PLANES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Packing:
    """How one population is to be stored: what was asked for; a ``Form`` is what came of it."""

    bits: int = 8  # Storage width of a mantissa
    planes: int = 1  # Times that a synapse may be stored, with different exponents
    groups: int = 1  # Different thresholds, and so scales, at most
