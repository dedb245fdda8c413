"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spikeloom.compiler.archive import npy_bytes, read_npy, stored_members, zip_bytes
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.files import write_atomically


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingState:
    """What an epoch hands to the next."""

    # JSON values that must be equal to go on: digests of data and graph, architecture, epochs, seed, rates
    options: Mapping[str, Any]
    # JSON values, as the training sees fit: history, state of the order's generator, learning rate
    progress: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]  # Parameters, optimizer moments, weights of epochs that are kept


def write_state(path: str | os.PathLike[str], state: TrainingState) -> None:
    """Write a state, whole or not at all."""
    header = json.dumps({"options": dict(state.options), "progress": dict(state.progress)})
    arrays = {"header": np.array(header), **state.arrays}
    content = zip_bytes({f"{name}.npy": npy_bytes(array) for name, array in arrays.items()})
    with write_atomically(path) as file:
        file.write(content)


def read_state(path: str | os.PathLike[str], options: Mapping[str, Any]) -> TrainingState:
    """Read a state; ModelError if it is missing or damaged, OptionError if it is that of another training."""
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"{path}: no interrupted training to resume; omit --resume")
    try:
        members = stored_members(path.read_bytes())
        arrays = {name.removesuffix(".npy"): read_npy(content) for name, content in members.items()}
        header = json.loads(str(arrays.pop("header")))
        found, progress = dict(header["options"]), dict(header["progress"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ModelError(f"{path}: is not a training state or is damaged; delete it and train anew") from error
    differing = sorted(name for name in {*found, *options} if found.get(name) != options.get(name))
    if differing:
        raise OptionError(
            f"{path}: belongs to a training with other {', '.join(differing)}; give the same options and data, "
            "or delete it to train anew"
        )
    return TrainingState(options=found, progress=progress, arrays=arrays)


def pack(network: torch.nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, NDArray[Any]]:
    """Copy parameters and optimizer moments."""
    arrays = {f"network/{name}": p.detach().cpu().numpy().copy() for name, p in network.named_parameters()}
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            arrays[f"optimizer/{index}/{name}"] = value.detach().cpu().numpy().copy()
    return arrays


def unpack(
    arrays: Mapping[str, NDArray[Any]], network: torch.nn.Module, optimizer: torch.optim.Optimizer, rate: float
) -> None:
    """Put parameters, optimizer moments and learning rate back."""
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(torch.tensor(arrays[f"network/{name}"]))
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for key, array in arrays.items():
        if key.startswith("optimizer/"):
            _, index, name = key.split("/")
            moments.setdefault(int(index), {})[name] = torch.tensor(array)
    state = optimizer.state_dict()
    state["state"] = moments
    optimizer.load_state_dict(state)
    set_rate(optimizer, rate)


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
