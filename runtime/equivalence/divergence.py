"""The first entry in which the chip's spikes and the float model's differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.interpret import BoolArray
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1.trace import aligned, comparable


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
    netlist: Netlist,
    prepared: engine.Engine,
    reference: list[BoolArray],
    chip: list[BoolArray],
    wide: list[BoolArray],
    events: npt.NDArray[np.uint8],
    files: tuple[str, ...],
    membrane: Callable[[int, int], npt.NDArray[np.floating]],
) -> Divergence | None:
    """Look for it.

    Parameters
    ----------
    netlist : Netlist
    prepared : Engine
        The same, ready to run.
    reference, chip, wide : list of (samples, steps, compared) bool
        Spikes of each layer of the float32 model, the chip and the float64 model, of neurons that can be compared.
    events : (samples, channels, steps) uint8
        Recordings.
    files : tuple of str
        Their names.
    membrane : callable
        Given a recording and a layer, the float model's membranes (steps, neurons) before the comparison.
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
    layer = netlist.layers[index]
    ill_posed = bool(wide[index][sample, step, neuron] != reference[index][sample, step, neuron])
    neuron = int(np.arange(layer.neurons)[comparable(netlist, index)][neuron])
    trace = engine.simulate(prepared, events[sample : sample + 1], membranes=True)
    assert trace.membranes is not None, "membranes were wanted"
    register = int(aligned(netlist, trace.membranes, index)[0, step, neuron])
    ids = netlist.compartments_of(index)
    held = ids[netlist.neuron[ids] == neuron]  # empty where the chip leaves the neuron out, which then stays at zero
    scale = float(netlist.scale[held[0]]) if len(held) else 1.0
    chip_theta = int(netlist.threshold[held[0]]) / scale if len(held) else layer.theta
    graph = layer.depth == 0 and layer.neurons % netlist.taxels == 0
    features = layer.neurons // netlist.taxels
    return Divergence(
        file=files[sample],
        step=step,
        layer=layer.name,
        neuron=neuron,
        taxel=neuron // features if graph else None,
        feature=neuron % features if graph else None,
        float_membrane=float(membrane(sample, index)[step, neuron]),
        chip_membrane=register / (scale * (1 << MEMBRANE_SHIFT)),
        chip_register=register,
        theta=layer.theta,
        chip_theta=chip_theta,
        ill_posed=ill_posed,
    )
