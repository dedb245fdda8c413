"""One recording for the page: spikes of float model and chip, membranes where they part, energy and time by step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.ir import IntegerPopulation, Network
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.reference import membranes_of, spikes_of, taxel_and_feature
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.integer import IntegerMachine
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.page.facts import Sides
from spikeloom.runtime.report.encode import HIDDEN, key

Floats = npt.NDArray[np.floating]

AROUND = 25
"""Steps of membrane that are shown on either side of a divergence."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LayerRaster:
    """Spikes of a layer in one recording, as pairs of step and neuron: where both fire, and where one side does."""

    name: str
    neurons: int
    active: IntArray
    float_spikes: int
    chip_spikes: int
    different: int
    both: IntArray
    float_only: IntArray
    chip_only: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Membranes of a neuron, called `of`, in the float model's units around a step.

    There its spikes differ or, if it does not diverge, its membranes lie furthest apart. Without it on the chip it is
    not held.
    """

    layer: str
    neuron: int
    of: str
    step: int
    held: bool
    first_step: int
    theta: float
    chip_theta: float
    model: Floats = field(metadata=key("float"))
    chip: FloatArray
    float_spikes: IntArray
    chip_spikes: IntArray
    diverges: bool

    @property
    def title(self) -> str:
        """What it shows."""
        where = f"{self.layer} {self.of}, step {self.step}"
        if not self.diverges:
            return f"no spike differs; the membranes lie furthest apart at {where}"
        return f"first spike of {self.layer} that differs: {where}{'' if self.held else ' (not on the chip)'}"

    def fires(self, step: int) -> str:
        """Who fires in a step."""
        sides = step in self.float_spikes, step in self.chip_spikes
        return {(True, True): "both", (True, False): "float only", (False, True): "chip only", (False, False): ""}[
            sides
        ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BySteps:
    """Joules and seconds of each chip step of one recording, and mean seconds of all, by table."""

    energy_j: Mapping[str, FloatArray]
    time_s: Mapping[str, FloatArray]
    mean_time_s: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """One recording on both sides; `input` holds pairs of step and channel, `costs` what estimate says of it."""

    file: str
    index: int
    steps: int
    label: int
    decision: Sides[int]
    votes: Sides[IntArray]
    input: IntArray
    layers: tuple[LayerRaster, ...]
    membranes: tuple[Trace, ...]
    costs: object
    by_step: BySteps
    core_energy_j: Mapping[str, Mapping[str, float]] = field(metadata=HIDDEN)


def recording(
    machine: IntegerMachine,
    loaded: LoadedNetwork,
    data: Recordings,
    index: int,
    mean_step_s: Mapping[str, FloatArray],
    *,
    bin_s: float,
) -> Recording:
    """Everything that the page shows of one recording; `mean_step_s` is of all, `bin_s` the seconds of a bin."""
    steps, netlist = data.steps_of(index), machine.netlist
    events = data.events[index : index + 1, ..., :steps]
    run = machine.run(events, spikes=True, membranes=True)
    assert run.spikes is not None, "spikes were wanted"
    assert run.membranes is not None, "membranes were wanted"
    sides = tuple(
        _layer(machine, layer, ours[0], chip[0], membranes[0], registers[0])
        for layer, (ours, chip, membranes, registers) in enumerate(
            zip(
                spikes_of(loaded.model, loaded.adjacency, events, "float32"),
                run.spikes.values(),
                membranes_of(loaded.model, loaded.adjacency, events),
                run.membranes.values(),
                strict=True,
            )
        )
    )
    costs, readout = machine.page_recording(events, bin_s=bin_s), loaded.network.readout
    votes = readout_counts(readout, netlist.classes, sides[readout.population].float_spikes[None])[0]
    return Recording(
        file=data.files[index],
        index=index,
        steps=steps,
        label=int(data.labels[index]),
        decision=Sides(model=int(votes.argmax()), chip=int(run.decisions[0])),
        votes=Sides(model=votes, chip=run.votes[0]),
        input=np.argwhere(with_clocks(events, netlist.clocks)[0].T),
        layers=tuple(_raster(layer) for layer in sides),
        membranes=_traces(loaded.model, sides),
        costs=costs.costs,
        by_step=BySteps(energy_j=costs.energy_j, time_s=costs.time_s, mean_time_s=mean_step_s),
        core_energy_j=costs.core_energy_j,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Layer:
    """What float32 model and chip do in one layer, aligned with the data, (steps, neurons).

    Spikes are silent where neurons are left out because their spikes reach no neuron; membranes, in the float model's
    units, are those before the comparison, zero where the chip holds no neuron.
    """

    number: int
    population: IntegerPopulation
    absent: BoolArray
    float_spikes: BoolArray
    chip_spikes: BoolArray
    float_membranes: Floats
    chip_membranes: FloatArray


def _layer(
    machine: IntegerMachine, layer: int, ours: BoolArray, chip: BoolArray, membranes: Floats, registers: IntArray
) -> _Layer:
    population, shown = machine.integer.populations[layer], np.zeros(ours.shape[1], np.bool_)
    shown[machine.compared()[layer]] = True
    return _Layer(
        number=layer,
        population=population,
        absent=machine.absent[layer],
        float_spikes=ours & shown,
        chip_spikes=chip & shown,
        float_membranes=membranes,
        chip_membranes=registers / (population.scale * (1 << MEMBRANE_SHIFT)),
    )


def _raster(layer: _Layer) -> LayerRaster:
    ours, chip = layer.float_spikes, layer.chip_spikes
    return LayerRaster(
        name=layer.population.name,
        neurons=ours.shape[1],
        active=np.flatnonzero((ours | chip).any(axis=0)),
        float_spikes=int(ours.sum()),
        chip_spikes=int(chip.sum()),
        different=int((ours != chip).sum()),
        both=np.argwhere(ours & chip),
        float_only=np.argwhere(ours & ~chip),
        chip_only=np.argwhere(chip & ~ours),
    )


def _traces(model: Checkpoint | Network, layers: tuple[_Layer, ...]) -> tuple[Trace, ...]:
    """Membranes around the first divergence of each layer, the first of all first.

    Where no spike differs, those of the neuron whose membranes lie furthest apart.
    """
    places = [
        (int(step), layer.number, int(neuron))
        for layer in layers
        for step, neuron in np.argwhere(layer.float_spikes != layer.chip_spikes)[:1]
    ]
    diverges = bool(places)
    if not diverges:
        gaps = [abs(layer.float_membranes - layer.chip_membranes) * ~layer.absent for layer in layers]
        widest = int(np.argmax([gap.max(initial=0.0) for gap in gaps]))
        step, neuron = np.unravel_index(int(gaps[widest].argmax()), gaps[widest].shape)
        places = [(int(step), widest, int(neuron))]
    return tuple(
        _trace(model, layers[index], step, neuron, diverges=diverges) for step, index, neuron in sorted(places)
    )


def _trace(model: Checkpoint | Network, layer: _Layer, step: int, neuron: int, *, diverges: bool) -> Trace:
    population, held = layer.population, not layer.absent[neuron]
    first = max(0, step - AROUND)
    window = slice(first, step + AROUND + 1)
    return Trace(
        layer=population.name,
        neuron=neuron,
        of=_name(model, layer, neuron),
        step=step,
        held=held,
        first_step=first,
        theta=population.theta,
        chip_theta=float(population.threshold[neuron] / population.scale[neuron]) if held else population.theta,
        model=layer.float_membranes[window, neuron],
        chip=layer.chip_membranes[window, neuron],
        float_spikes=np.flatnonzero(layer.float_spikes[window, neuron]) + first,
        chip_spikes=np.flatnonzero(layer.chip_spikes[window, neuron]) + first,
        diverges=diverges,
    )


def _name(model: Checkpoint | Network, layer: _Layer, neuron: int) -> str:
    """A neuron in the terms of its layer: taxel and feature in a graph convolution, its number elsewhere."""
    taxel, feature = taxel_and_feature(model, layer.number, neuron)
    return f"neuron {neuron}" if taxel is None else f"taxel {taxel}, feature {feature}"
