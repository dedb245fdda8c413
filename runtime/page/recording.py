"""One recording for the page: spikes of float model and chip, membranes where they part, energy and time by step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.checkpoint import Checkpoint
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.fixedpoint import MEMBRANE_SHIFT, FloatArray, IntArray
from spikeloom.compiler.interpret import BoolArray
from spikeloom.compiler.ir import Network
from spikeloom.compiler.systems import GRAPH_SYSTEMS
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.loihi1.layout.chips import chip_count
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.reference import membranes_of, spikes_of
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.loihi1 import engine
from spikeloom.runtime.machines.loihi1 import trace as machine_trace
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.estimate import Estimate, estimate
from spikeloom.runtime.machines.loihi1.costs.result import cost_report
from spikeloom.runtime.machines.loihi1.timing import DetailedTimes, SimpleTimes
from spikeloom.runtime.machines.loihi1.trace import Counts, aligned, comparable
from spikeloom.runtime.machines.votes import class_counts, predictions, readout_counts
from spikeloom.runtime.page.results import BySteps, Decided, LayerSpikes, Recording, Sides, Trace

AROUND = 25
"""Steps of membrane that are shown on either side of a divergence."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BothSides:
    """What float32 model and chip do on one recording, layer by layer and aligned with the data."""

    # float_spikes, chip_spikes: Silent where neurons are left out because no neuron receives them
    float_spikes: tuple[BoolArray, ...]
    chip_spikes: tuple[BoolArray, ...]
    float_membranes: tuple[npt.NDArray[np.floating], ...]  # Before the comparison
    trace: machine_trace.Trace  # Of the chip, one recording: spikes, membranes and updates


def run_both(netlist: Netlist, loaded: LoadedNetwork, events: npt.NDArray[np.uint8]) -> BothSides:
    """Run one recording, (taxels, polarities, steps), on both sides."""
    one = events[None]
    inputs = with_clocks(one, netlist.clocks)
    trace = engine.simulate(engine.prepare(netlist), inputs, spikes=True, membranes=True, updated=True)
    assert trace.spikes is not None, "spikes were asked for"
    layers = range(len(netlist.layers))
    return BothSides(
        float_spikes=tuple(
            _received(netlist, i, spikes[0])
            for i, spikes in enumerate(spikes_of(loaded.model, loaded.adjacency, one, "float32"))
        ),
        chip_spikes=tuple(_received(netlist, i, aligned(netlist, trace.spikes, i)[0]) for i in layers),
        float_membranes=tuple(found[0] for found in membranes_of(loaded.model, loaded.adjacency, one)),
        trace=trace,
    )


def _received(netlist: Netlist, layer: int, spikes: BoolArray) -> BoolArray:
    kept = np.zeros_like(spikes)
    keep = comparable(netlist, layer)
    kept[:, keep] = spikes[:, keep]
    return kept


def recording(
    netlist: Netlist,
    target: Target,
    loaded: LoadedNetwork,
    data: Recordings,
    index: int,
    costs: Estimate,
    *,
    bin_s: float,
) -> Recording:
    """Everything that the page shows of one recording; `costs` are of all, `bin_s` is the seconds of a data step."""
    steps = data.steps_of(index)
    events = data.events[index, ..., :steps]
    channels = with_clocks(events[None], netlist.clocks)
    sides = run_both(netlist, loaded, events)
    readout = loaded.network.readout
    float_votes = readout_counts(readout, netlist.classes, sides.float_spikes[readout.population][None])[0]
    chip_spikes = sides.trace.counts.spikes
    timed = "cycle" if chip_count(netlist.core_tile, target) == 1 else "counts"
    _, one = estimate(netlist, target, channels, detail=timed)
    return Recording(
        file=data.files[index],
        index=index,
        steps=steps,
        label=int(data.labels[index]),
        decision=Decided(model=int(float_votes.argmax()), chip=int(predictions(netlist, chip_spikes)[0])),
        votes=Sides(model=float_votes, chip=class_counts(netlist, chip_spikes)[0]),
        input=np.argwhere(channels[0].T),
        layers=tuple(
            _layer(netlist, i, a, b) for i, (a, b) in enumerate(zip(sides.float_spikes, sides.chip_spikes, strict=True))
        ),
        membranes=_traces(netlist, loaded.model, sides),
        costs=cost_report(netlist, target, one, bin_s=bin_s),
        by_step=_by_step(netlist, target, channels[0], sides.trace, one, costs),
    )


def _layer(netlist: Netlist, index: int, ours: BoolArray, chip: BoolArray) -> LayerSpikes:
    layer = netlist.layers[index]
    return LayerSpikes(
        name=layer.name,
        neurons=layer.neurons,
        active=np.flatnonzero((ours | chip).any(axis=0)),
        float_spikes=int(ours.sum()),
        chip_spikes=int(chip.sum()),
        different=int((ours != chip).sum()),
        both=np.argwhere(ours & chip),
        float_only=np.argwhere(ours & ~chip),
        chip_only=np.argwhere(chip & ~ours),
    )


# -- membranes ---------------------------------------------------------------------------------------------------------


def _traces(netlist: Netlist, model: Checkpoint | Network, sides: BothSides) -> tuple[Trace, ...]:
    """Membranes around the first divergence of each layer, the first of all first.

    Where no spike differs, those of the neuron whose membranes lie furthest apart.
    """
    places: list[tuple[int, int, int]] = []
    for index, (ours, chip) in enumerate(zip(sides.float_spikes, sides.chip_spikes, strict=True)):
        places += [(int(step), index, int(neuron)) for step, neuron in np.argwhere(ours != chip)[:1]]
    diverges = bool(places)
    if not diverges:
        gaps = [_gaps(netlist, sides, index) for index in range(len(netlist.layers))]
        widest = int(np.argmax([gap.max(initial=0.0) for gap in gaps]))
        step, neuron = np.unravel_index(int(gaps[widest].argmax()), gaps[widest].shape)
        places = [(int(step), widest, int(neuron))]
    return tuple(
        _trace(netlist, model, sides, step, index, neuron, diverges=diverges) for step, index, neuron in sorted(places)
    )


def _gaps(netlist: Netlist, sides: BothSides, index: int) -> FloatArray:
    """Distance of both membranes in a layer, (steps, neurons); zero where the chip holds no neuron."""
    held = np.isin(np.arange(netlist.layers[index].neurons), netlist.neuron[netlist.layer == index])
    distance: FloatArray = abs(sides.float_membranes[index] - _chip_membranes(netlist, sides, index)) * held
    return distance


def _chip_membranes(netlist: Netlist, sides: BothSides, index: int) -> FloatArray:
    """Membranes of a layer on the chip in the float model's units, (steps, neurons); zero where it holds none."""
    assert sides.trace.membranes is not None, "membranes were asked for"
    ids, scale = netlist.compartments_of(index), np.ones(netlist.layers[index].neurons)
    scale[netlist.neuron[ids]] = netlist.scale[ids]
    found: FloatArray = aligned(netlist, sides.trace.membranes, index)[0] / (scale * (1 << MEMBRANE_SHIFT))
    return found


def _trace(
    netlist: Netlist,
    model: Checkpoint | Network,
    sides: BothSides,
    step: int,
    index: int,
    neuron: int,
    *,
    diverges: bool,
) -> Trace:
    layer, ids = netlist.layers[index], netlist.compartments_of(index)
    own = ids[netlist.neuron[ids] == neuron]
    first, last = max(0, step - AROUND), min(len(sides.float_spikes[index]), step + AROUND + 1)
    window = slice(first, last)
    return Trace(
        layer=layer.name,
        neuron=neuron,
        of=neuron_name(netlist, model, index, neuron),
        step=step,
        held=bool(len(own)),
        first_step=first,
        theta=layer.theta,
        chip_theta=float(netlist.threshold[own[0]] / netlist.scale[own[0]]) if len(own) else layer.theta,
        model=sides.float_membranes[index][window, neuron],
        chip=_chip_membranes(netlist, sides, index)[window, neuron],
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


# -- energy and time by step -------------------------------------------------------------------------------------------


def energy_by_step(
    netlist: Netlist, target: Target, events: npt.NDArray[np.uint8], trace: machine_trace.Trace
) -> dict[str, FloatArray]:
    """Joules of each chip step of one recording by table; they add up to what :func:`cost.estimate` says.

    Parameters
    ----------
    netlist, target : Netlist, Target
        What ran, on which chip.
    events : (channels, steps) uint8
        The recording, with the network's clocks.
    trace : Trace
        Of a batch of this one recording, with spikes and updates.
    """
    assert trace.spikes is not None, "spikes were asked for"
    assert trace.updated is not None, "updates were asked for"
    spikes: IntArray = trace.spikes[0].astype(np.int64)
    inputs = np.zeros((len(spikes), netlist.n_inputs), np.int64)
    inputs[: events.shape[1]] = events.T
    of_layer = np.eye(len(netlist.layers), dtype=np.int64)[netlist.layer]
    updates = trace.updated[0].astype(np.int64) @ of_layer
    counts = Counts(inputs=inputs, spikes=spikes, updates=updates, saturations=np.zeros_like(updates))
    # each chip step is priced as a run of its own: one that ends after `max_depth + (1 - max_depth)` steps
    costs = cost.estimate(cost.prepare(netlist, target), counts, 1 - netlist.max_depth)
    return {name: each.sum(axis=1) for name, each in costs.energy.items()}


def _by_step(
    netlist: Netlist,
    target: Target,
    events: npt.NDArray[np.uint8],
    trace: machine_trace.Trace,
    one: Estimate,
    costs: Estimate,
) -> BySteps:
    """Energy and time of each chip step of this recording, and the mean time over all recordings that still run."""
    models: dict[str, Mapping[str, SimpleTimes | DetailedTimes]] = {"simple": one.simple, "detailed": one.detailed}
    mean = {
        name: np.where(times.critical_core >= 0, times.duration_ns, 0).sum(axis=0)
        / np.maximum((times.critical_core >= 0).sum(axis=0), 1)
        for name, times in costs.simple.items()
    }
    return BySteps(
        energy_j=energy_by_step(netlist, target, events, trace),
        time_s={
            f"{name}, {model} model": times.duration_ns[0] * 1e-9
            for model, each in models.items()
            for name, times in each.items()
        },
        mean_time_s={f"{name}, simple model": each * 1e-9 for name, each in mean.items()},
    )
