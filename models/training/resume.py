"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import write_atomically

Weights = Mapping[str, NDArray[np.float32]]


def write_state(
    path: str | os.PathLike[str],
    options: Mapping[str, Any],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    order: np.random.Generator,
    history: Sequence[Any],
    weights: Mapping[str, Weights] = MappingProxyType({}),
) -> None:
    """Write what an epoch hands to the next, whole or not at all.

    `options` are the JSON values that must be equal to go on: digests of data and graph, architecture, epochs, seed,
    rates. `history` has a dataclass of figures for each epoch, `weights` are those of epochs that are kept.
    """
    state = {
        "options": dict(options),
        "history": [asdict(epoch) for epoch in history],
        "order": order.bit_generator.state,
        "network": {name: parameter.detach() for name, parameter in network.named_parameters()},
        "optimizer": optimizer.state_dict(),
        "kept": {which: {name: torch.tensor(array) for name, array in held.items()} for which, held in weights.items()},
    }
    with write_atomically(path) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # torch then finds its file cut short
                raise error.__context__ from None
            raise


def restore(
    path: str | os.PathLike[str],
    options: Mapping[str, Any],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    order: np.random.Generator,
) -> tuple[list[dict[str, Any]], dict[str, dict[str, NDArray[np.float32]]]]:
    """Put parameters, optimizer and order of recordings back; returns the figures of the epochs and the kept weights.

    ModelError if the state is missing or damaged, OptionError if it is that of another training.
    """
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no interrupted training to resume; omit --resume")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        found = dict(state["options"])
    except Exception as error:  # whatever torch says of a file that it cannot read
        raise ModelError(f"{path}: is not a training state or is damaged; delete it and train anew") from error
    differing = sorted(name for name in {*found, *options} if found.get(name) != options.get(name))
    if differing:
        raise OptionError(
            f"{path}: belongs to a training with other {', '.join(differing)}; give the same options and data, "
            "or delete it to train anew"
        )
    network.load_state_dict(state["network"], strict=False)
    optimizer.load_state_dict(state["optimizer"])
    order.bit_generator.state = state["order"]
    kept = {which: {name: array.numpy() for name, array in held.items()} for which, held in state["kept"].items()}
    return state["history"], kept


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
