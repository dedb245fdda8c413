"""When the learning rate falls; torch-free, for whoever only names a schedule."""

from __future__ import annotations

EPOCHS = 100
"""Passes over the training recordings of the released protocol."""

DECAY_EPOCHS = 40
"""There the learning rate falls to a tenth after so many epochs; the first of each such block still has the old one."""
