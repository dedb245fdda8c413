"""One recording for the page: spikes of float model and chip, and membranes where they part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.targets.compartments import MEMBRANE_SHIFT
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.reference import membranes_of, reference_of, taxel_and_feature
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.votes import readout_counts
from spikeloom.runtime.report.encode import key

Floats = npt.NDArray[np.floating]

AROUND = 25
"""Steps of membrane that are shown on either side of a divergence."""

FIRES = {(True, True): "both", (True, False): "float only", (False, True): "chip only", (False, False): ""}
"""Who fires, by whether float model and chip do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LayerRaster:
    """Spikes of a layer in one recording, as pairs of step and neuron: where both fire, and where one side does."""

    name: str
    neurons: int
    both: IntArray
    float_only: IntArray
    chip_only: IntArray

    json_properties = ("active", "float_spikes", "chip_spikes", "different")

    @property
    def active(self) -> IntArray:
        """Neurons that fire on either side."""
        return np.unique(np.concatenate([self.both, self.float_only, self.chip_only])[:, 1])

    @property
    def float_spikes(self) -> int:
        """Of the float model."""
        return len(self.both) + len(self.float_only)

    @property
    def chip_spikes(self) -> int:
        """Of the chip."""
        return len(self.both) + len(self.chip_only)

    @property
    def different(self) -> int:
        """Of one side only."""
        return len(self.float_only) + len(self.chip_only)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Membranes of a neuron, called `of`, in the float model's units around a step.

    There its spikes differ or, if it does not diverge, its membranes lie furthest apart. Without it on the
    chip it is not held.
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
        absent = "" if self.held else " (not on the chip)"
        return f"first spike of {self.layer} that differs: {where}{absent}"

    def fires(self, step: int) -> str:
        """Who fires in a step."""
        return FIRES[step in self.float_spikes, step in self.chip_spikes]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """One recording on both sides, ``float`` and ``chip``; `input` holds pairs of step and channel."""

    file: str
    index: int
    steps: int
    label: int
    decision: Mapping[str, int]
    votes: Mapping[str, IntArray]
    input: IntArray
    layers: tuple[LayerRaster, ...]
    membranes: tuple[Trace, ...]


def recording(machine: Comparable, loaded: LoadedNetwork, data: Recordings, index: int) -> Recording:
    """Everything that the page shows of one recording.

    Neurons whose spikes reach no neuron are silent on both sides.
    """
    events = data.events[index : index + 1, ..., : data.steps_of(index)]
    run = machine.run(events, spikes=True, membranes=True)
    sent = reference_of(loaded.network)(events)
    ours = [spikes[0] & ~unread for spikes, unread in zip(sent, machine.unread, strict=True)]
    chip = [spikes[0] & ~unread for spikes, unread in zip(run.spikes.values(), machine.unread, strict=True)]
    readout = loaded.network.readout
    votes = readout_counts(readout, machine.netlist.classes, ours[readout.population][None])[0]
    return Recording(
        file=data.files[index],
        index=index,
        steps=data.steps_of(index),
        label=int(data.labels[index]),
        decision={"float": int(votes.argmax()), "chip": int(run.decisions[0])},
        votes={"float": votes, "chip": run.votes[0]},
        input=np.argwhere(with_clocks(events, machine.netlist.clocks)[0].T),
        layers=tuple(
            LayerRaster(
                name=name,
                neurons=a.shape[1],
                both=np.argwhere(a & b),
                float_only=np.argwhere(a & ~b),
                chip_only=np.argwhere(b & ~a),
            )
            for name, a, b in zip(machine.layers, ours, chip, strict=True)
        ),
        membranes=_traces(
            machine,
            loaded,
            (ours, chip),
            [membranes[0] for membranes in membranes_of(loaded.network, events)],
            [
                registers[0] / (population.scale * (1 << MEMBRANE_SHIFT))
                for population, registers in zip(
                    machine.integer.populations, run.membranes.values(), strict=True
                )
            ],
        ),
    )


def _traces(
    machine: Comparable,
    loaded: LoadedNetwork,
    spikes: tuple[Sequence[BoolArray], Sequence[BoolArray]],
    ours: Sequence[Floats],
    chip: Sequence[FloatArray],
) -> tuple[Trace, ...]:
    """Membranes around the first divergence of each layer, the first of all first."""
    places = [
        (int(step), layer, int(neuron))
        for layer, (a, b) in enumerate(zip(*spikes, strict=True))
        for step, neuron in np.argwhere(a != b)[:1]
    ]
    diverges = bool(places)
    if not diverges:
        gaps = [abs(a - b) * ~absent for a, b, absent in zip(ours, chip, machine.absent, strict=True)]
        widest = int(np.argmax([gap.max(initial=0.0) for gap in gaps]))
        most = np.unravel_index(int(gaps[widest].argmax()), gaps[widest].shape)
        places = [(int(most[0]), widest, int(most[1]))]
    traces = []
    for step, layer, neuron in sorted(places):
        population = machine.integer.populations[layer]
        on_chip = not machine.absent[layer][neuron]
        threshold = float(population.threshold[neuron] / population.scale[neuron])
        first = max(0, step - AROUND)
        window = slice(first, step + AROUND + 1), neuron
        taxel, feature = taxel_and_feature(loaded.network, layer, neuron)
        traces.append(
            Trace(
                layer=population.name,
                neuron=neuron,
                of=f"neuron {neuron}" if taxel is None else f"taxel {taxel}, feature {feature}",
                step=step,
                held=on_chip,
                first_step=first,
                theta=population.theta,
                chip_theta=threshold if on_chip else population.theta,
                model=ours[layer][window],
                chip=chip[layer][window],
                float_spikes=np.flatnonzero(spikes[0][layer][window]) + first,
                chip_spikes=np.flatnonzero(spikes[1][layer][window]) + first,
                diverges=diverges,
            )
        )
    return tuple(traces)
