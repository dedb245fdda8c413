"""The surrogate derivative of a spike, in training."""

from __future__ import annotations

from dataclasses import dataclass

RECTANGULAR, FAST_SIGMOID = SHAPES = ("rectangular", "fast-sigmoid")


@dataclass(frozen=True, slots=True, kw_only=True)
class Surrogate:
    """Derivative that stands for that of a spike, by the distance of the membrane from the threshold.

    Parameters
    ----------
    shape : {"rectangular", "fast-sigmoid"}
        1 within `width` and 0 beyond, or ``1 / (1 + distance / width)**2``.
    width : float
        In membrane units.
    reset : bool
        Whether the gradient runs through the reset, too.
    """

    shape: str = RECTANGULAR
    width: float = 0.5
    reset: bool = True


RECTANGLE = Surrogate()
"""The released code's."""
