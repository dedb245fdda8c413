"""When the learning rate falls; torch-free, for whoever only names a schedule."""

from __future__ import annotations

EPOCHS = 100
"""Passes over the training recordings of the released protocol."""

DECAY_EPOCHS = 40
"""There the learning rate falls to a tenth after so many epochs; the first of each such block still has the old one."""


def scaled_decay(epochs: int) -> int:
    """Epochs after which the rate of a longer or shorter training falls: the same share of it as in the released one.

    Examples
    --------
    >>> [scaled_decay(epochs) for epochs in (1, 2, 30, 100, 200)]
    [1, 1, 12, 40, 80]
    """
    return max(1, round(DECAY_EPOCHS * epochs / EPOCHS))
