"""What is counted while a chip runs recordings, part by part: against its lowered model, and against a float model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.interpret import channels_last, cut
from spikeloom.compiler.ir import Network
from spikeloom.compiler.targets.compartments import MEMBRANE_SHIFT
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.equivalence.breakdowns import Breakdown, breakdowns
from spikeloom.runtime.equivalence.reference import (
    LADDER,
    membranes_of,
    reference_of,
    rungs,
    taxel_and_feature,
)
from spikeloom.runtime.equivalence.verdict import Divergence, LayerSpikes, ModelSpikes, Rung
from spikeloom.runtime.machines.base import Machine, Model, Run
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.votes import readout_counts

Layers = Sequence[BoolArray]
"""Spikes of each layer, (samples, steps, compared neurons)."""

Begin = Callable[[str, int], None]
"""Called with the name of a part of the work as it starts, and the number of recordings that are done."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Some recordings, the `rows` of all, and what the chip did on them."""

    rows: slice
    data: Recordings
    run: Run


class ModelTally:
    """Spikes in which chip and lowered model differ."""

    def __init__(self, machine: Machine, model: Model, begin: Begin) -> None:
        self._machine = machine
        self._model = model
        self._begin = begin
        self._spikes = dict.fromkeys(model.first, 0)
        self._different = dict.fromkeys(model.first, 0)

    def add(self, part: Part) -> None:
        """Count some recordings."""
        self._begin("lowered model", part.rows.start)
        expected = self._model.spikes(part.data.events)
        for name, first in self._model.first.items():
            spikes = expected[name]
            self._spikes[name] += int(cut(spikes, part.data.step_counts).sum())
            self._different[name] += self._machine.differing(
                part.run, name, spikes, first, part.data.step_counts
            )

    @property
    def layers(self) -> dict[str, ModelSpikes]:
        """What was counted."""
        return {
            name: ModelSpikes(spikes=spikes, different=self._different[name])
            for name, spikes in self._spikes.items()
        }


class FloatTally:
    """Votes of a float model; its spikes, too, where the layers of the chip are the model's."""

    def __init__(self, machine: Machine, network: Network, samples: int, begin: Begin) -> None:
        self._begin = begin
        self._readout = network.readout
        self._reference = reference_of(network)
        self.votes = np.zeros((samples, network.classes), np.int64)
        self.spikes = SpikeTally(machine, network, begin) if isinstance(machine, Comparable) else None

    def add(self, part: Part) -> None:
        """Run the model on some recordings."""
        self._begin("float32 reference", part.rows.start)
        reference = [cut(spikes, part.data.step_counts) for spikes in self._reference(part.data.events)]
        voting = reference[self._readout.population]
        self.votes[part.rows] = readout_counts(self._readout, self.votes.shape[1], voting)
        if self.spikes is not None:
            self.spikes.add(part, reference)


class SpikeTally:
    """Spikes in which chip and float model differ, and which deviation of the chip costs what."""

    def __init__(self, machine: Comparable, network: Network, begin: Begin) -> None:
        self._machine = machine
        self._network = network
        self._begin = begin
        self._names = machine.layers
        self._kept = machine.compared()
        self._ladder = rungs(network, machine.integer, windows=not machine.free_running)
        populations = machine.integer.populations
        self._neurons = [
            np.arange(each.size)[keep] for each, keep in zip(populations, self._kept, strict=True)
        ]
        self._fired = [
            np.zeros((2, len(each)), np.int64) for each in self._neurons
        ]  # Of float model and chip
        self._different = {stage: np.zeros(len(self._names), np.int64) for stage in LADDER}
        self.first_divergence: Divergence | None = None

    def add(self, part: Part, reference: Layers) -> None:
        """Count some recordings."""
        first = part.rows.start
        channels = channels_last(part.data.events, self._machine.netlist.clocks)
        wanted = self._compared(reference)
        chip = self._compared([part.run.spikes[name] for name in self._names])
        self._different[LADDER[-1]] += _differences(wanted, chip)
        for total, *sides in zip(self._fired, wanted, chip, strict=True):
            total += [side.sum(axis=(0, 1)) for side in sides]
        for stage, simulation in self._ladder.items():
            self._begin(f"ladder: {'proven' if simulation is None else stage}", first)
            lower = chip
            if simulation is not None:
                lower = self._compared(
                    [cut(spikes, part.data.step_counts) for spikes in simulation.run(channels).spikes]
                )
            self._different[stage] += _differences(wanted, lower)
            if stage == LADDER[0] and self.first_divergence is None:
                self._begin("first divergence", first)
                self.first_divergence = self._divergence(part, wanted, chip, lower)

    def _compared(self, layers: Layers) -> list[BoolArray]:
        """Spikes of those neurons that can be compared."""
        return [spikes[..., keep] for spikes, keep in zip(layers, self._kept, strict=True)]

    @property
    def layers(self) -> dict[str, LayerSpikes]:
        """What was counted, by layer."""
        ill_posed = self._different[LADDER[0]]
        different = self._different[LADDER[-1]]
        return {
            name: LayerSpikes(
                float=int(fired[0].sum()),
                chip=int(fired[1].sum()),
                different=int(different[index]),
                ill_posed=int(ill_posed[index]),
            )
            for index, (name, fired) in enumerate(zip(self._names, self._fired, strict=True))
        }

    @property
    def ladder(self) -> tuple[Rung, ...]:
        """What was counted, by deviation."""
        last = "free_running" if self._machine.free_running else LADDER[-1]
        return tuple(
            Rung(
                stage=last if stage == LADDER[-1] else stage,
                different=dict(zip(self._names, counts.tolist(), strict=True)),
            )
            for stage, counts in self._different.items()
        )

    @property
    def not_compared(self) -> dict[str, int]:
        """Neurons of each layer that the chip omits because their spikes reach no neuron."""
        unread = zip(self._names, self._machine.unread, strict=True)
        return {name: int(neurons.sum()) for name, neurons in unread if neurons.any()}

    def breakdowns(self, votes: tuple[IntArray, IntArray], files: Sequence[str]) -> tuple[Breakdown, ...]:
        """Known ways to fail; votes (samples, classes) are those of float model and chip."""
        ours = [fired[0] for fired in self._fired]
        theirs = [fired[1] for fired in self._fired]
        return breakdowns(self._names, ours, theirs, self._neurons, votes, files)

    def _divergence(self, part: Part, reference: Layers, chip: Layers, wide: Layers) -> Divergence | None:
        """First entry in which spikes of the float32 model and the chip differ; `wide` are those of float64."""
        place = _first_difference(reference, chip)
        if place is None:
            return None
        sample, step, index, entry = place
        machine = self._machine
        layer = machine.integer.populations[index]
        neuron = int(self._neurons[index][entry])
        recording = part.data.events[sample : sample + 1, ..., : step + 1]
        register = int(machine.run(recording, membranes=True).membranes[layer.name][0, step, neuron])
        scale = float(layer.scale[neuron])
        on_chip = not machine.absent[index][neuron]  # a neuron that the chip leaves out stays at zero
        taxel, feature = taxel_and_feature(self._network, index, neuron)
        return Divergence(
            file=part.data.files[sample],
            step=step,
            layer=layer.name,
            neuron=neuron,
            taxel=taxel,
            feature=feature,
            float_membrane=float(membranes_of(self._network, recording)[index][0, step, neuron]),
            chip_membrane=register / (scale * (1 << MEMBRANE_SHIFT)),
            chip_register=register,
            theta=layer.theta,
            chip_theta=int(layer.threshold[neuron]) / scale if on_chip else layer.theta,
            ill_posed=bool(wide[index][sample, step, entry] != reference[index][sample, step, entry]),
        )


def _differences(ours: Layers, theirs: Layers) -> IntArray:
    """Entries of each layer that differ."""
    return np.array([np.count_nonzero(a != b) for a, b in zip(ours, theirs, strict=True)], np.int64)


def _first_difference(ours: Layers, theirs: Layers) -> tuple[int, int, int, int] | None:
    """Recording, step, layer and entry of the first spike that differs."""
    differs = [a != b for a, b in zip(ours, theirs, strict=True)]
    samples = np.any([layer.any(axis=(1, 2)) for layer in differs], axis=0)
    if not samples.any():
        return None
    sample = int(np.argmax(samples))
    step, index, entry = min(
        (int(step), index, int(entry))
        for index, layer in enumerate(differs)
        for step, entry in np.argwhere(layer[sample])[:1]
    )
    return sample, step, index, entry
