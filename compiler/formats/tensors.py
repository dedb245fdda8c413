"""Tensors of a checkpoint: what they must be, and how those of several networks lie side by side as towers.

A joined network has the filters of all its towers in its first layer, and fully connected layers that are
blocks: a neuron receives its own tower, and the relays of clocks, of which there is one set for all. Each
tower therefore spikes as it does alone. Its last layer has a neuron for every class and tower, ``tower *
classes + class``; the class whose neurons spike most wins.

Neurons of the first layer count as in any network of the system, with the features of all towers at each
place.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spikeloom.compiler.checkpoint import Checkpoint, layers_of, merge, neurons_of, towers_of
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.formats.names import printable
from spikeloom.compiler.ir import Form
from spikeloom.compiler.types import AnyArray

Arrays = dict[str, AnyArray]

Shape = tuple[str, ...]
"""A wanted shape; a word stands for any size from 1, the same wherever it occurs."""


def faults_of(
    arrays: Mapping[str, AnyArray], wanted: Mapping[str, Shape], title: str = "a TactileSGNet"
) -> list[str]:
    """Missing, mis-shaped and unknown tensors, and values that are not finite, in that order per tensor.

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
            shown = str(expected).replace("'", "")
            faults.append(f"{name} is {array.shape}, wanted {shown}")
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


def taxel_faults(arrays: Mapping[str, AnyArray], features: int, clocks: int = 0) -> list[str]:
    """Whether the first dense stage was made for a whole number of taxels, and the clocks beside them."""
    inputs = arrays["fc1.weight"].shape[1]
    if inputs <= clocks or (inputs - clocks) % features:
        beside = f" beside {clocks} clocks" if clocks else ""
        return [
            f"fc1.weight has {inputs} inputs, not a whole number of taxels with {features} features each{beside}"
        ]
    return []


def apart(arrays: Mapping[str, AnyArray], towers: int) -> tuple[Arrays, ...]:
    """Arrays of each tower of a joined network, whose filters, rows and biases lie one tower after the other.

    >>> both = {"conv1.hops": np.ones((1, 4, 2)), "conv1.bias": np.arange(4), "fc1.weight": np.ones((6, 5))}
    >>> [{name: array.shape for name, array in one.items()} for one in apart(both, 2)][1]
    {'conv1.hops': (1, 2, 2), 'conv1.bias': (2,), 'fc1.weight': (3, 5)}
    """
    parts = {name: np.split(array, towers, axis=_tower_axis(name)) for name, array in arrays.items()}
    return tuple({name: part[tower] for name, part in parts.items()} for tower in range(towers))


def together(towers: Sequence[Mapping[str, AnyArray]]) -> Arrays:
    """Inverse of :func:`apart`."""
    return {
        name: np.concatenate([one[name] for one in towers], axis=_tower_axis(name)) for name in towers[0]
    }


def tower_faults(arrays: Mapping[str, AnyArray], towers: int) -> list[str]:
    """Arrays that do not hold as much for every tower."""
    return [
        f"{printable(name)} is {array.shape}, not as much for each of {towers} towers"
        for name, array in arrays.items()
        if array.ndim <= _tower_axis(name) or array.shape[_tower_axis(name)] % towers
    ]


def _tower_axis(name: str) -> int:
    """Axis along which the towers of a joined network lie: the features of filters, the rows of all else."""
    return 1 if name == "conv1.hops" else 0


def members(checkpoint: Checkpoint) -> tuple[Checkpoint, ...]:
    """The networks that a checkpoint was joined from, or the one that it is."""
    if checkpoint.towers == 1:
        return (checkpoint,)
    owners = towers_of(checkpoint)
    parts = []
    for tower, arrays in enumerate(apart(arrays_of(checkpoint), checkpoint.towers)):
        forms = None
        if checkpoint.forms is not None:
            forms = tuple(
                replace(form, threshold=form.threshold[neurons_of(tower, owner)])
                for form, owner in zip(checkpoint.forms, owners, strict=True)
            )
        parts.append(replace(checkpoint, **layers_of(arrays), forms=forms, towers=1))
    return tuple(parts)


def arrays_of(checkpoint: Checkpoint) -> Arrays:
    """Arrays as a file holds them."""
    arrays: Arrays = {"conv1.hops": checkpoint.hops, "conv1.bias": checkpoint.conv_bias}
    for stage in checkpoint.dense:
        arrays |= {f"{stage.name}.weight": stage.weight, f"{stage.name}.bias": stage.bias}
    return arrays


def join(checkpoints: Sequence[Checkpoint], names: Sequence[str]) -> Checkpoint:
    """One network of all towers; where it is from, its training record and hash, are those of the first.

    They are of one system, sensor, graph, sizes, neurons and clocks, and of one storage where they were
    fine-tuned; joined ones give all their towers. `names` are for messages.

    Raises ModelError if they disagree in any of these; all of them are listed.
    """
    facts = [_facts(checkpoint) for checkpoint in checkpoints]
    others = {
        what: [name for name, found in zip(names, facts, strict=True) if found[what] != first]
        for what, first in facts[0].items()
    }
    if differing := [f"{what} ({', '.join(which)})" for what, which in others.items() if which]:
        raise ModelError(
            f"join: networks differ from {names[0]} in {', '.join(differing)}; give networks of one system, sensor and "
            "timing"
        )
    every = [member for checkpoint in checkpoints for member in members(checkpoint)]
    arrays = layers_of(together([arrays_of(member) for member in every]))
    joined = replace(every[0], **arrays, forms=None, towers=len(every))
    return replace(joined, forms=_joined_forms(joined, every))


def _joined_forms(joined: Checkpoint, every: Sequence[Checkpoint]) -> tuple[Form, ...] | None:
    forms = [member.forms for member in every if member.forms is not None]
    if not forms:
        return None
    thresholds = merge(towers_of(joined), [[form.threshold for form in one] for one in forms])
    return tuple(
        replace(form, threshold=threshold) for form, threshold in zip(forms[0], thresholds, strict=True)
    )


def _facts(checkpoint: Checkpoint) -> dict[str, object]:
    """What the networks of a joined one have in common."""
    grid = checkpoint.grid
    dynamics = checkpoint.dynamics
    edges = np.zeros((0, 2), np.int64) if checkpoint.edges is None else checkpoint.edges
    sizes = [len(stage.bias) // checkpoint.towers for stage in checkpoint.dense]
    layers = range(1 + len(sizes))
    return {
        "system": checkpoint.system,
        "sensor": (checkpoint.taxels, checkpoint.hops.shape[2]),
        "grid": grid and (grid.rows, grid.columns, grid.stride, grid.padding, grid.cells.tolist()),
        "graph": sorted(edges.tolist()),
        "classes": checkpoint.classes,
        "layers": (len(checkpoint.hops), checkpoint.hops.shape[1] // checkpoint.towers, *sizes),
        "membrane decays": [dynamics.beta(layer, checkpoint.beta) for layer in layers],
        "current decays": [dynamics.alpha(layer) for layer in layers],
        "threshold": checkpoint.theta,
        "clocks": dynamics.clocks,
        "bins of a step": checkpoint.bins,
        "storage": [(form.bits, form.exponents) for form in checkpoint.forms or ()],
    }
