"""What the tensors of a checkpoint must be: names, shapes, finite values. Every fault is found, not the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.formats.names import printable

Arrays = dict[str, npt.NDArray[Any]]

Shape = tuple[int | str, ...]
"""A wanted shape; a word stands for any size from 1."""


def faults_of(
    arrays: Mapping[str, npt.NDArray[Any]], wanted: Mapping[str, Shape], title: str = "a TactileSGNet"
) -> list[str]:
    """Missing, mis-shaped and unknown tensors, and values that are not finite, in that order per tensor.

    Examples
    --------
    >>> faults_of({"a": np.ones((2, 3)), "c": np.ones(1)}, {"a": (2, 4), "b": (2,)})
    ['a is (2, 3), wanted (2, 4)', 'b is missing', 'c is not part of a TactileSGNet']
    >>> faults_of({"a": np.array([1.0, np.nan])}, {"a": ("features",)})
    ['a has 1 of 2 values NaN or infinite']
    """
    faults = []
    for name, shape in wanted.items():
        array = arrays.get(name)
        if array is None:
            faults.append(f"{name} is missing")
        elif not _fits(array.shape, shape):
            faults.append(f"{name} is {array.shape}, wanted {_shown(shape)}")
        elif bad := int(np.count_nonzero(~np.isfinite(array))):
            faults.append(f"{name} has {bad} of {array.size} values NaN or infinite")
    return faults + [f"{printable(name)} is not part of {title}" for name in arrays if name not in wanted]


def wanted_dense(
    arrays: Mapping[str, npt.NDArray[Any]], stages: int, inputs: int | str = "taxels * features"
) -> dict[str, Shape]:
    """Shapes of ``fc1`` … as their weights announce them: each takes what the one before gives."""
    wanted: dict[str, Shape] = {}
    for stage in range(1, stages + 1):
        outputs = size(arrays, f"fc{stage}.weight", 2, 0, "outputs")
        wanted[f"fc{stage}.weight"] = (outputs, inputs)
        wanted[f"fc{stage}.bias"] = (outputs,)
        inputs = outputs
    return wanted


def taxel_faults(arrays: Mapping[str, npt.NDArray[Any]], features: int, clocks: int = 0) -> list[str]:
    """Whether the first dense stage was made for a whole number of taxels, and the clocks beside them."""
    inputs = arrays["fc1.weight"].shape[1]
    if inputs <= clocks or (inputs - clocks) % features:
        beside = f" beside {clocks} clocks" if clocks else ""
        return [f"fc1.weight has {inputs} inputs, not a whole number of taxels with {features} features each{beside}"]
    return []


def apart(arrays: Mapping[str, npt.NDArray[Any]], towers: int) -> tuple[Arrays, ...]:
    """Arrays of each tower of a joined network, whose filters, rows and biases lie one tower after the other.

    Examples
    --------
    >>> both = {"conv1.hops": np.ones((1, 4, 2)), "conv1.bias": np.arange(4), "fc1.weight": np.ones((6, 5))}
    >>> [{name: array.shape for name, array in one.items()} for one in apart(both, 2)][1]
    {'conv1.hops': (1, 2, 2), 'conv1.bias': (2,), 'fc1.weight': (3, 5)}
    """
    parts = {name: np.split(array, towers, axis=_tower_axis(name)) for name, array in arrays.items()}
    return tuple({name: part[tower] for name, part in parts.items()} for tower in range(towers))


def together(towers: Sequence[Mapping[str, npt.NDArray[Any]]]) -> Arrays:
    """Inverse of :func:`apart`."""
    return {name: np.concatenate([one[name] for one in towers], axis=_tower_axis(name)) for name in towers[0]}


def tower_faults(arrays: Mapping[str, npt.NDArray[Any]], towers: int) -> list[str]:
    """Arrays that do not hold as much for every tower."""
    return [
        f"{printable(name)} is {array.shape}, not as much for each of {towers} towers"
        for name, array in arrays.items()
        if array.ndim <= _tower_axis(name) or array.shape[_tower_axis(name)] % towers
    ]


def _tower_axis(name: str) -> int:
    """Axis along which the towers of a joined network lie: the features of filters, the rows of all else."""
    return 1 if name == "conv1.hops" else 0


def size(arrays: Mapping[str, npt.NDArray[Any]], name: str, dimensions: int, axis: int, word: str) -> int | str:
    """Length of one axis of a tensor, or `word` where the tensor cannot say."""
    array = arrays.get(name)
    return array.shape[axis] if array is not None and array.ndim == dimensions and array.size else word


def _fits(found: tuple[int, ...], wanted: Shape) -> bool:
    pairs = zip(found, wanted, strict=False)
    return len(found) == len(wanted) and all(a == b if isinstance(b, int) else a >= 1 for a, b in pairs)


def _shown(shape: Shape) -> str:
    return f"({', '.join(str(length) for length in shape)}{',' if len(shape) == 1 else ''})"
