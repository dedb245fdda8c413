"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

import copy
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_type_hints

import numpy as np
import torch
from numpy.typing import NDArray

from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import FileFault, read_whole, reading, write_atomically
from spikeloom.compiler.formats.torch_checkpoint import load_torch

Weights = Mapping[str, NDArray[np.float32]]

E = TypeVar("E")


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
        **_trained(network, optimizer, weights),
    }
    with write_atomically(path) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # torch then finds its file cut short
                raise error.__context__ from None
            raise


def _trained(
    network: torch.nn.Module, optimizer: torch.optim.Optimizer, weights: Mapping[str, Weights]
) -> dict[str, Any]:
    return {
        "network": {name: parameter.detach() for name, parameter in network.named_parameters()},
        "optimizer": optimizer.state_dict(),
        "kept": {which: {name: torch.tensor(array) for name, array in held.items()} for which, held in weights.items()},
    }


def restore(
    path: str | os.PathLike[str],
    options: Mapping[str, Any],
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    order: np.random.Generator,
    epoch: type[E],
    keeps: Callable[[int], Mapping[str, Weights]] = lambda _: {},
) -> tuple[list[E], dict[str, dict[str, NDArray[np.float32]]]]:
    """Put parameters, optimizer and order of recordings back; returns the figures of the epochs and the kept weights.

    Figures are of a dataclass `epoch`; `keeps` gives weights of the shapes that are kept after so many epochs.

    ModelError if the state is missing or damaged, OptionError if it is that of another training.
    """
    path = Path(path)
    with reading(path, ModelError, "delete it and train anew"):
        state = load_torch(read_whole(path, "training state"))
        if not isinstance(state, dict) or not isinstance(found := state.get("options"), dict):
            raise FileFault("is not a training state")
        if differing := sorted(str(name) for name in {*found, *options} if found.get(name) != options.get(name)):
            raise OptionError(
                f"{path}: belongs to a training with other {', '.join(differing)[:100]}; give the same options and "
                "data, or delete it to train anew"
            )
        kinds = get_type_hints(epoch)
        figures = state["history"]
        right = all({name: type(value) for name, value in each.items()} == kinds for each in figures)
        if not right or [each["epoch"] for each in figures] != [*range(1, min(len(figures), options["epochs"]) + 1)]:
            raise FileFault("has no usable history")
        model, stepped = copy.deepcopy((network, optimizer))  # what their state after an epoch looks like
        for parameter in model.parameters():
            parameter.grad = torch.zeros_like(parameter)
        stepped.step()
        due = _trained(model, stepped, keeps(len(figures)))
        if not _alike({name: state[name] for name in due}, due):
            raise FileFault("is not the state of this network")
        network.load_state_dict(state["network"], strict=False)
        optimizer.load_state_dict(state["optimizer"])
        order.bit_generator.state = state["order"]
    kept = {which: {name: array.numpy() for name, array in held.items()} for which, held in state["kept"].items()}
    return [epoch(**each) for each in figures], kept


def _alike(found: Any, wanted: Any) -> bool:
    """Whether a value is another one, but for finite real numbers."""
    if type(found) is not type(wanted):
        return False
    match wanted:
        case dict():
            return found.keys() == wanted.keys() and all(_alike(found[key], each) for key, each in wanted.items())
        case list() | tuple():
            return len(found) == len(wanted) and all(map(_alike, found, wanted))
        case torch.Tensor():
            same = (found.shape, found.dtype, found.layout) == (wanted.shape, wanted.dtype, wanted.layout)
            return same and bool(found.isfinite().all())
    return math.isfinite(found) if isinstance(found, float) else bool(found == wanted)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
