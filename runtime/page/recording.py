"""One recording for the page: spikes of float model and chip, membranes where they part, energy and time by step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT
from spikeloom.compiler.ir import Network
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.reference import membranes_of, spikes_of
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.base import Run
from spikeloom.runtime.machines.integer import IntegerMachine
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.page.results import BySteps, Decided, LayerSpikes, Recording, Sides, Trace

AROUND = 25
"""Steps of membrane that are shown on either side of a divergence."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BothSides:
    """What float32 model and chip do on one recording, layer by layer and aligned with the data.

    Spikes (steps, neurons) are silent where neurons are left out because their spikes reach no neuron; membranes, in
    the float model's units, are those before the comparison, zero where the chip holds no neuron.
    """

    float_spikes: tuple[BoolArray, ...]
    chip_spikes: tuple[BoolArray, ...]
    float_membranes: tuple[npt.NDArray[np.floating], ...]
    chip_membranes: tuple[FloatArray, ...]
    run: Run


def run_both(machine: IntegerMachine, loaded: LoadedNetwork, events: npt.NDArray[np.uint8]) -> BothSides:
    """Run one recording, (1, taxels, polarities, steps), on both sides."""
    run = machine.run(events, spikes=True, membranes=True)
    assert run.spikes is not None, "spikes were wanted"
    assert run.membranes is not None, "membranes were wanted"
    kept, populations = machine.compared(), machine.integer.populations
    float_spikes = spikes_of(loaded.model, loaded.adjacency, events, "float32")
    return BothSides(
        float_spikes=tuple(_only(keep, each[0]) for keep, each in zip(kept, float_spikes, strict=True)),
        chip_spikes=tuple(_only(keep, each[0]) for keep, each in zip(kept, run.spikes.values(), strict=True)),
        float_membranes=tuple(each[0] for each in membranes_of(loaded.model, loaded.adjacency, events)),
        chip_membranes=tuple(
            each[0] / (population.scale * (1 << MEMBRANE_SHIFT))
            for each, population in zip(run.membranes.values(), populations, strict=True)
        ),
        run=run,
    )


def _only(keep: slice | IntArray, spikes: BoolArray) -> BoolArray:
    kept = np.zeros_like(spikes)
    kept[:, keep] = spikes[:, keep]
    return kept


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
    steps, names = data.steps_of(index), machine.layers
    events = data.events[index : index + 1, ..., :steps]
    sides, costs = run_both(machine, loaded, events), machine.page_recording(events, bin_s=bin_s)
    readout = loaded.network.readout
    float_votes = readout_counts(readout, machine.netlist.classes, sides.float_spikes[readout.population][None])[0]
    return Recording(
        file=data.files[index],
        index=index,
        steps=steps,
        label=int(data.labels[index]),
        decision=Decided(model=int(float_votes.argmax()), chip=int(sides.run.decisions[0])),
        votes=Sides(model=float_votes, chip=sides.run.votes[0]),
        input=np.argwhere(with_clocks(events, machine.netlist.clocks)[0].T),
        layers=tuple(
            _layer(name, ours, chip)
            for name, ours, chip in zip(names, sides.float_spikes, sides.chip_spikes, strict=True)
        ),
        membranes=_traces(machine, loaded.model, sides),
        costs=costs.costs,
        by_step=BySteps(energy_j=costs.energy_j, time_s=costs.time_s, mean_time_s=mean_step_s),
        core_energy_j=costs.core_energy_j,
    )


def _layer(name: str, ours: BoolArray, chip: BoolArray) -> LayerSpikes:
    return LayerSpikes(
        name=name,
        neurons=ours.shape[1],
        active=np.flatnonzero((ours | chip).any(axis=0)),
        float_spikes=int(ours.sum()),
        chip_spikes=int(chip.sum()),
        different=int((ours != chip).sum()),
        both=np.argwhere(ours & chip),
        float_only=np.argwhere(ours & ~chip),
        chip_only=np.argwhere(chip & ~ours),
    )


# -- membranes ---------------------------------------------------------------------------------------------------------


def _traces(machine: IntegerMachine, model: Checkpoint | Network, sides: BothSides) -> tuple[Trace, ...]:
    """Membranes around the first divergence of each layer, the first of all first.

    Where no spike differs, those of the neuron whose membranes lie furthest apart.
    """
    places: list[tuple[int, int, int]] = []
    for index, (ours, chip) in enumerate(zip(sides.float_spikes, sides.chip_spikes, strict=True)):
        places += [(int(step), index, int(neuron)) for step, neuron in np.argwhere(ours != chip)[:1]]
    diverges = bool(places)
    if not diverges:
        pairs = zip(sides.float_membranes, sides.chip_membranes, machine.absent, strict=True)
        gaps = [abs(ours - chip) * ~absent for ours, chip, absent in pairs]
        widest = int(np.argmax([gap.max(initial=0.0) for gap in gaps]))
        step, neuron = np.unravel_index(int(gaps[widest].argmax()), gaps[widest].shape)
        places = [(int(step), widest, int(neuron))]
    return tuple(
        _trace(machine, model, sides, step, index, neuron, diverges=diverges) for step, index, neuron in sorted(places)
    )


def _trace(
    machine: IntegerMachine,
    model: Checkpoint | Network,
    sides: BothSides,
    step: int,
    index: int,
    neuron: int,
    *,
    diverges: bool,
) -> Trace:
    population, held = machine.integer.populations[index], not machine.absent[index][neuron]
    first, last = max(0, step - AROUND), min(len(sides.float_spikes[index]), step + AROUND + 1)
    window = slice(first, last)
    return Trace(
        layer=population.name,
        neuron=neuron,
        of=neuron_name(machine.netlist, model, index, neuron),
        step=step,
        held=held,
        first_step=first,
        theta=population.theta,
        chip_theta=float(population.threshold[neuron] / population.scale[neuron]) if held else population.theta,
        model=sides.float_membranes[index][window, neuron],
        chip=sides.chip_membranes[index][window, neuron],
        float_spikes=np.flatnonzero(sides.float_spikes[index][window, neuron]) + first,
        chip_spikes=np.flatnonzero(sides.chip_spikes[index][window, neuron]) + first,
        diverges=diverges,
    )


def neuron_name(netlist: Netlist, model: Checkpoint | Network, layer: int, neuron: int) -> str:
    """A neuron in the terms of its layer: taxel and feature in a graph convolution, its number elsewhere."""
    if layer or isinstance(model, Network) or model.system not in GRAPH_SYSTEMS:
        return f"neuron {neuron}"
    taxel, feature = divmod(neuron, model.hops.shape[1])
    if taxel >= netlist.taxels:
        return f"neuron {neuron}, a clock's"
    return f"taxel {taxel}, feature {feature}"
