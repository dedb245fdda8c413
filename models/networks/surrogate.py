"""The surrogate derivative of a spike, in training."""

from dataclasses import dataclass

RECTANGULAR = "rectangular"
FAST_SIGMOID = "fast-sigmoid"
SHAPES = (RECTANGULAR, FAST_SIGMOID)


@dataclass(frozen=True, slots=True, kw_only=True)
class Surrogate:
    """Derivative that stands for that of a spike, by the distance of the membrane from the threshold."""

    # {"rectangular", "fast-sigmoid"}; 1 within `width` and 0 beyond, or ``1 / (1 + distance / width)**2``
    shape: str = RECTANGULAR
    width: float = 0.5  # In membrane units
    reset: bool = True  # Whether the gradient runs through the reset, too


RECTANGLE = Surrogate()
"""The released code's."""
