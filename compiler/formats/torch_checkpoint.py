"""Read the released layout: files of ``torch.save`` with a first layer and dense weights, one state dict per run.

A ``.t7`` file is a dict whose ``net_list`` holds the state dicts, with the weights of the *last* epoch,
while ``best_acc`` belongs to the best one. It holds no graph, no decay and no threshold. Bare state dicts
are read too, both kinds in torch's zip and in its older format, with the keys of current torch_geometric
(``conv1.lins.0.weight`` …) or of old releases (``conv1.lin.weight``, the filters of all hops side by side).

torch is imported here only, late, and always with ``weights_only=True``: files that hold code are refused.
"""

import hashlib
import io
import math
import pickle
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from spikeloom.compiler.archive import stored_members, zip_bytes
from spikeloom.compiler.checkpoint import Checkpoint, layers_of
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.formats.tensors import Arrays, Shape, faults_of, taxel_faults, wanted_dense
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


OTHERS = "another network comes as ONNX or NIR, or in Python as spikeloom.compile(module, example=…): docs/formats.md"
"""What to do with a file of torch that holds no network of ours."""


def read_torch(content: bytes, run: int) -> Checkpoint:
    """Read the content of a torch file; raises as :func:`read_checkpoint`."""
    loaded = load_torch(content)
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


def load_torch(content: bytes) -> Any:
    """Let torch read the content if it looks like a zip or a pickle.

    The CRCs of a zip are checked here, for torch does not. The format before it has no checksum: a bit of a
    weight that is flipped goes unnoticed.
    """
    if content[:2] != b"PK" and content[:1] != b"\x80":
        raise ModelError(NOT_A_CHECKPOINT)
    import torch

    if content[:2] == b"PK":
        content = zip_bytes(stored_members(content))

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of its own old storage classes
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises nearly anything on damaged files
        if isinstance(error, pickle.UnpicklingError) and (
            named := re.search(r"GLOBAL ([\w.]+)", str(error))
        ):
            raise ModelError(
                f"is a pickle that calls {named[1]}, allowed are tensors alone, since code in a file could "
                f"do anything; save the state_dict of a TactileSGNet and nothing else; {OTHERS}"
            ) from error
        if re.search(r"Unsupported operand 1(4\d|5[0-2])\b", str(error)):  # what protocol 4 added
            raise ModelError(
                "is pickled with protocol 4 or newer, which torch does not read without running it; "
                "save it with torch.save as it is by default"
            ) from error
        raise


def _arrays(state: Any, file_size: int) -> Arrays:
    """Convert the tensors of a state dict to float32 arrays."""
    import torch

    if not isinstance(state, Mapping) or not any(re.match(r"(conv|fc)\d", str(key)) for key in state):
        keys = (
            [printable(str(key)) for key in state] if isinstance(state, Mapping) else [type(state).__name__]
        )
        raise ModelError(
            f"holds neither net_list nor weights of a TactileSGNet, but {', '.join(keys[:5]) or 'nothing'}; {OTHERS}"
        )
    checked = ((printable(str(name)), _tensor_fault(value, file_size)) for name, value in state.items())
    faults = [f"{name} {fault}" for name, fault in checked if fault]
    if faults:
        raise ModelError(f"{'; '.join(faults)}; {GIVE_WEIGHTS}")
    return {str(name): value.detach().to(torch.float32).numpy() for name, value in state.items()}


def _tensor_fault(value: Any, file_size: int) -> str | None:
    import torch

    if not isinstance(value, torch.Tensor):
        return f"is a {type(value).__name__}, wanted a tensor"
    if value.layout != torch.strided or value.device.type != "cpu" or not value.is_floating_point():
        return (
            f"is a tensor of {str(value.dtype).removeprefix('torch.')}, wanted plain floating-point numbers"
        )
    # A tensor may repeat its storage through strides of zero, and so be far larger than the file.
    if value.numel() * value.element_size() > file_size:
        return f"claims {value.numel()} values, more than the file holds"
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
        last = _number(lambda: loaded["acc_list"][(run + 1) * epochs - 1][-1])
        training |= {} if last is None else {"last_acc": last}
    if (best := _number(lambda: loaded["best_acc"][run])) is not None:
        note = "of the best epoch on the test split, not of these weights"
        training |= {"best_acc": best, "best_acc_note": note}
    return training


def _number(find: Callable[[], Any]) -> float | None:
    try:
        number = round(float(find()), 4)
    except Exception:  # what is not there, or no number
        return None
    return number if math.isfinite(number) else None
