"""Read the released layout: files of ``torch.save`` with a first layer and dense weights, one state dict per run.

A ``.t7`` file is a dict whose ``net_list`` holds the state dicts, with the weights of the *last* epoch,
while ``best_acc`` belongs to the best one. It holds no graph, no decay and no threshold. Bare state dicts
are read too, both kinds in torch's zip and in its older format, with the keys of current torch_geometric
(``conv1.lins.0.weight`` …) or of old releases (``conv1.lin.weight``, the filters of all hops side by side).

:mod:`torch_file` reads them as data; files that hold code are refused.
"""

import hashlib
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint, layers_of
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.tensors import Arrays, Shape, faults_of, taxel_faults, wanted_dense
from spikeloom.compiler.formats.torch_file import OTHERS, Tensor, read_torch_file
from spikeloom.compiler.types import JsonObject

CHANNELS = 2
"""Polarities of a recording; old keys do not say how many channels a hop has."""

DENSE_STAGES = 3

GIVE = "give a file of spikeloom train or of the released layout"
GIVE_WEIGHTS = "give the weights of a TactileSGNet"
NOT_A_CHECKPOINT = f"is not a checkpoint; {GIVE}"

BETA = 0.2
THETA = 0.5
"""Decay and threshold of the released code; files in its layout do not hold them."""


def read_torch(content: bytes, run: int) -> Checkpoint:
    """Read the content of a torch file; raises as :func:`read_checkpoint`.

    The CRCs of a zip are checked. The format before it has no checksum: a bit of a weight that is flipped goes
    unnoticed.
    """
    if content[:2] != b"PK" and content[:1] != b"\x80":
        raise ModelError(NOT_A_CHECKPOINT)
    loaded = read_torch_file(content)
    if isinstance(loaded, dict) and "net_list" in loaded:
        states = loaded["net_list"]
        layout = "released"
        if not isinstance(states, list | tuple) or not states:
            raise ModelError("net_list holds no run; give the file of a finished training")
    else:
        states = [loaded]
        layout = "state_dict"
    if not 0 <= run < len(states):
        available = "only run 0" if len(states) == 1 else f"runs 0 to {len(states) - 1}"
        raise ModelError(f"--run {run}: the file holds {available}; choose one that it holds")
    return Checkpoint(
        **layers_of(unified(_arrays(states[run], len(content)))),
        beta=BETA,
        theta=THETA,
        assumed=("beta", "theta"),
        layout=layout,
        runs=len(states),
        training=_training(loaded, run, len(states)) if layout == "released" else None,
        sha256=hashlib.sha256(content).hexdigest(),
    )


def _arrays(state: Any, file_size: int) -> Arrays:
    """Convert the tensors of a state dict to float32 arrays."""
    if not isinstance(state, dict) or not any(re.match(r"(conv|fc)\d", str(key)) for key in state):
        keys = [printable(str(key)) for key in state] if isinstance(state, dict) else [type(state).__name__]
        raise ModelError(
            f"holds neither net_list nor weights of a TactileSGNet, but {', '.join(keys[:5]) or 'nothing'}; {OTHERS}"
        )
    checked = ((printable(str(name)), _tensor_fault(value, file_size)) for name, value in state.items())
    faults = [f"{name} {fault}" for name, fault in checked if fault]
    if faults:
        raise ModelError(f"{'; '.join(faults)}; {GIVE_WEIGHTS}")
    with np.errstate(over="ignore"):  # infinity is refused later, by name
        return {str(name): value.array.astype(np.float32) for name, value in state.items()}


def _tensor_fault(value: Any, file_size: int) -> str | None:
    if not isinstance(value, Tensor):
        return f"is a {type(value).__name__}, wanted a tensor"
    if "float" not in value.dtype:
        return f"is a tensor of {value.dtype}, wanted plain floating-point numbers"
    # A tensor may repeat its storage through strides of zero, and so be far larger than the file.
    if math.prod(value.shape) > file_size:
        return f"claims {math.prod(value.shape)} values, more than the file holds"
    return None


def unified(arrays: Arrays) -> Arrays:
    """Check the weights of a TactileSGNet, whose keys are torch_geometric's, new or old, and give them our names.

    Raises ModelError with every fault.
    """
    hops = [
        int(match[1]) for key in arrays if (match := re.fullmatch(r"conv1\.lins\.(0|[1-9]\d?)\.weight", key))
    ]
    wanted: dict[str, Shape]
    if not hops and "conv1.lin.weight" in arrays:
        bias = "conv1.lin.bias"
        wanted = {"conv1.lin.weight": ("features", f"hops * {CHANNELS}"), bias: ("features",)}
    else:
        bias = "conv1.bias"
        wanted = {
            f"conv1.lins.{k}.weight": ("features", "channels") for k in range(max(hops, default=0) + 1)
        }
        wanted[bias] = ("features",)
    faults = faults_of(arrays, wanted | wanted_dense(DENSE_STAGES)) or taxel_faults(
        arrays, len(arrays[bias])
    )
    if not faults and not hops and arrays["conv1.lin.weight"].shape[1] % CHANNELS:
        columns = arrays["conv1.lin.weight"].shape[1]
        faults = [
            f"conv1.lin.weight has {columns} columns, not a whole number of hops with {CHANNELS} channels each"
        ]
    if faults:
        raise ModelError(f"{'; '.join(faults)}; {GIVE_WEIGHTS}")
    if hops:
        filters = np.stack([arrays.pop(f"conv1.lins.{k}.weight") for k in range(len(hops))])
    else:
        side_by_side = arrays.pop("conv1.lin.weight")
        filters = side_by_side.reshape(len(side_by_side), -1, CHANNELS).transpose(1, 0, 2)
    return {"conv1.hops": filters, "conv1.bias": arrays.pop(bias), **arrays}


def _training(loaded: Mapping[str, Any], run: int, runs: int) -> JsonObject:
    """What the released script stored beside the weights, as JSON values; unknown where it is not as it wrote it."""
    training: dict[str, Any] = {"runs": runs, "weights": "last epoch"}
    if isinstance(epochs := loaded.get("num_epochs"), int):
        training["epochs"] = epochs
        # the tensor of a run is listed once per epoch
        last = _number(loaded.get("acc_list"), (run + 1) * epochs - 1, -1)
        training |= {} if last is None else {"last_acc": last}
    if (best := _number(loaded.get("best_acc"), run)) is not None:
        note = "of the best epoch on the test split, not of these weights"
        training |= {"best_acc": best, "best_acc_note": note}
    return training


def _number(value: Any, *places: int) -> float | None:
    """A number in lists and tensors, None where there is none."""
    try:
        for place in places:
            value = (value.array if isinstance(value, Tensor) else value)[place]
        number = round(float(value.array if isinstance(value, Tensor) else value), 4)
    except Exception:  # what is not there, or no number
        return None
    return number if math.isfinite(number) else None
