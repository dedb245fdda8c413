"""State of a training between two epochs, so that a killed one continues to the same weights, bit for bit."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spikeloom.compiler.archive import npy_bytes, read_npy, stored_members, zip_bytes
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
    weights: Mapping[str, Weights] | None = None,
) -> None:
    """Write what an epoch hands to the next, whole or not at all.

    `options` are the JSON values that must be equal to go on: digests of data and graph, architecture, epochs, seed,
    rates. `history` has a dataclass of figures for each epoch, `weights` are those of epochs that are kept.
    """
    progress = {
        "history": [asdict(epoch) for epoch in history],
        "order": order.bit_generator.state,
        "rate": float(optimizer.param_groups[0]["lr"]),
    }
    arrays: dict[str, Any] = {"header": np.array(json.dumps({"options": dict(options), "progress": progress}))}
    arrays |= {f"network/{name}": parameter.detach().cpu().numpy() for name, parameter in network.named_parameters()}
    for index, moments in optimizer.state_dict()["state"].items():
        arrays |= {f"optimizer/{index}/{name}": value.detach().cpu().numpy() for name, value in moments.items()}
    for which, held in (weights or {}).items():
        arrays |= {f"kept/{which}/{name}": array for name, array in held.items()}
    content = zip_bytes({f"{name}.npy": npy_bytes(array) for name, array in arrays.items()})
    with write_atomically(path) as file:
        file.write(content)


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
    parameters = dict(network.named_parameters())
    moments: dict[int, dict[str, torch.Tensor]] = {}
    weights: dict[str, dict[str, NDArray[np.float32]]] = {}
    for key, array in arrays.items():
        kind, _, name = key.partition("/")
        which, _, part = name.partition("/")
        if kind == "network":
            with torch.no_grad():
                parameters[name].copy_(torch.tensor(array))
        elif kind == "optimizer":
            moments.setdefault(int(which), {})[part] = torch.tensor(array)
        else:
            weights.setdefault(which, {})[part] = array
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
    set_rate(optimizer, progress["rate"])
    order.bit_generator.state = progress["order"]
    return progress["history"], weights


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = rate
