"""What the tensors of a checkpoint must be: names, shapes, finite values. Every fault is found, not the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.formats.names import printable

Arrays = dict[str, npt.NDArray[Any]]

Shape = tuple[str, ...]
"""A wanted shape; a word stands for any size from 1, the same wherever it occurs."""


def faults_of(
    arrays: Mapping[str, npt.NDArray[Any]], wanted: Mapping[str, Shape], title: str = "a TactileSGNet"
) -> list[str]:
    """Missing, mis-shaped and unknown tensors, and values that are not finite, in that order per tensor.

    Examples
    --------
    >>> faults_of({"a": np.ones(2), "b": np.ones((2, 3)), "d": np.ones(1)}, {"a": ("n",), "b": ("m", "n"), "c": ("n",)})
    ['b is (2, 3), wanted (2, 2)', 'c is missing', 'd is not part of a TactileSGNet']
    >>> faults_of({"a": np.array([1.0, np.nan])}, {"a": ("features",)})
    ['a has 1 of 2 values NaN or infinite']
    """
    faults = []
    sizes: dict[str, int] = {}
    for name, shape in wanted.items():
        array = arrays.get(name)
        if array is None:
            faults.append(f"{name} is missing")
            continue
        if array.ndim == len(shape) and array.size:
            sizes = dict(zip(shape, array.shape, strict=True)) | sizes
        expected = tuple(sizes.get(word, word) for word in shape)
        if array.shape != expected:
            faults.append(f"{name} is {array.shape}, wanted {_shown(expected)}")
        elif bad := int(np.count_nonzero(~np.isfinite(array))):
            faults.append(f"{name} has {bad} of {array.size} values NaN or infinite")
    return faults + [f"{printable(name)} is not part of {title}" for name in arrays if name not in wanted]


def wanted_dense(stages: int) -> dict[str, Shape]:
    """Shapes of ``fc1`` …: each takes what the one before gives."""
    wanted: dict[str, Shape] = {}
    inputs = "taxels * features"
    for stage in range(1, stages + 1):
        outputs = f"outputs of fc{stage}"
        wanted |= {f"fc{stage}.weight": (outputs, inputs), f"fc{stage}.bias": (outputs,)}
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


def _shown(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(str(length) for length in shape)}{',' if len(shape) == 1 else ''})"
