"""What turns gradients into weights: the optimizer of a recipe, and the course of its learning rate."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import nn

from spikeloom.models.training.recipes import ADAMW, COSINE, Recipe


def optimizer_of(recipe: Recipe, network: nn.Module, device: str) -> torch.optim.Optimizer:
    """Optimizer of a recipe on the parameters of a network."""
    rate, fused = recipe.learning_rate, device == "cpu"
    if recipe.optimizer == ADAMW:
        return torch.optim.AdamW(
            network.parameters(), lr=rate, weight_decay=recipe.weight_decay, amsgrad=True, fused=fused
        )
    return torch.optim.Adam(network.parameters(), lr=rate, amsgrad=True, fused=fused)


def course_of(recipe: Recipe, epoch: int, epochs: int) -> Callable[[float], float] | None:
    """Learning rate within an epoch by the share of it that is done, counted from 0; None where it is constant."""
    if recipe.schedule != COSINE:
        return None
    return lambda share: recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * (epoch + share) / epochs))


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
