"""How networks for TrueNorth are trained."""

from __future__ import annotations

from spikeloom.models.networks.surrogate import FAST_SIGMOID, Surrogate
from spikeloom.models.training.recipes import ADAMW, COSINE, CROSS_ENTROPY, Recipe

CROSSBARS = Recipe(
    name="truenorth",
    epochs=30,
    batch=4,
    loss=CROSS_ENTROPY,
    gain=60.0,
    surrogate=Surrogate(shape=FAST_SIGMOID, width=0.5, reset=False),
    optimizer=ADAMW,
    weight_decay=0.01,
    learning_rate=3e-3,
    schedule=COSINE,
    features=16,
    clocks=5,
)
"""For networks that TrueNorth holds, which have no other."""
