"""The first entry in which the chip's spikes and the float model's differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.ir import Network
from spikeloom.compiler.types import BoolArray, FloatArray
from spikeloom.runtime.equivalence.reference import membranes_of, taxel_and_feature
from spikeloom.runtime.machines.integer import IntegerMachine


@dataclass(frozen=True, slots=True, kw_only=True)
class Divergence:
    """The first entry in which chip and float model differ: first recording, then step, layer, neuron.

    Membranes before the comparison and thresholds are in the float model's units, the register is as it stands. Taxel
    and feature are the neuron in a graph convolution's own terms. It is ill-posed if the float64 model sides with the
    chip.
    """

    file: str
    step: int
    layer: str
    neuron: int
    taxel: int | None
    feature: int | None
    float_membrane: float
    chip_membrane: float
    chip_register: int
    theta: float
    chip_theta: float
    ill_posed: bool


def first_divergence(
    machine: IntegerMachine,
    model: Checkpoint | Network,
    adjacency: FloatArray | None,
    reference: list[BoolArray],
    chip: list[BoolArray],
    wide: list[BoolArray],
    events: npt.NDArray[np.uint8],
    files: tuple[str, ...],
) -> Divergence | None:
    """Look for it.

    Spikes of each layer of the float32 model, the chip and the float64 model are (samples, steps, compared), of neurons
    that can be compared.
    """
    differs = [(a != b) for a, b in zip(reference, chip, strict=True)]
    broken = np.any([d.any(axis=(1, 2)) for d in differs], axis=0)
    if not broken.any():
        return None
    sample = int(np.argmax(broken))
    step, index, neuron = min(
        (int(step), layer, int(neuron))
        for layer, d in enumerate(differs)
        for step, neuron in np.argwhere(d[sample])[:1]
    )
    layer = machine.integer.populations[index]
    ill_posed = bool(wide[index][sample, step, neuron] != reference[index][sample, step, neuron])
    neuron = int(np.arange(layer.size)[machine.compared()[index]][neuron])
    recording = events[sample : sample + 1]
    membranes = machine.run(recording, membranes=True).membranes
    assert membranes is not None, "membranes were wanted"
    register = int(membranes[layer.name][0, step, neuron])
    held = not machine.absent[index][neuron]  # a neuron that the chip leaves out stays at zero
    scale = float(layer.scale[neuron])
    taxel, feature = taxel_and_feature(model, index, neuron)
    return Divergence(
        file=files[sample],
        step=step,
        layer=layer.name,
        neuron=neuron,
        taxel=taxel,
        feature=feature,
        float_membrane=float(membranes_of(model, adjacency, recording)[index][0, step, neuron]),
        chip_membrane=register / (scale * (1 << MEMBRANE_SHIFT)),
        chip_register=register,
        theta=layer.theta,
        chip_theta=int(layer.threshold[neuron]) / scale if held else layer.theta,
        ill_posed=ill_posed,
    )
