"""Crossbar cores against their definition and their model: every spike of every copy of every neuron."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.interpret import vote
from spikeloom.compiler.targets.truenorth.codebook import PartialSums
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import BoolArray
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.machines.truenorth.machine import machine_of
from spikeloom.runtime.machines.votes import class_counts
from spikeloom.runtime.report.console import progress
from spikeloom.runtime.report.encode import OPTIONAL, key
from spikeloom.runtime.report.numbers import wilson
from spikeloom.runtime.report.sections import Section, Table, Text


@dataclass(frozen=True, slots=True)
class AgainstSpec:
    """Recordings on which both ran; spikes, membranes and counts that differ."""

    samples: int
    differences: int


@dataclass(frozen=True, slots=True)
class LayerSpikes:
    """Spikes of the model, and those of neurons on the chip, copies included, that differ."""

    name: str
    spikes: int
    differences: int


@dataclass(frozen=True, slots=True)
class AgainstModel:
    """Spikes that differ, by layer."""

    layers: tuple[LayerSpikes, ...]
    json_properties = ("differences",)

    @property
    def differences(self) -> int:
        """Of all layers."""
        return sum(layer.differences for layer in self.layers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Chip against definition (E0) and model (E1); `spec_steps` confines the former to the first data steps of each."""

    target: str
    samples: int
    spec: AgainstSpec = field(metadata=key("E0"))
    model: AgainstModel = field(metadata=key("E1"))
    membranes_saturated: int
    correct: int
    spec_steps: int | None = field(default=None, metadata=OPTIONAL)
    sums: tuple[PartialSums, ...] | None = field(default=None, metadata=OPTIONAL)
    json_properties = ("exact",)

    @property
    def exact(self) -> bool:
        """Whether nothing differs, and no membrane left its register."""
        return not (self.model.differences or self.spec.differences or self.membranes_saturated)


def compare(
    netlist: CrossbarNetlist,
    model: Callable[[Any], Mapping[str, BoolArray]],
    first: Mapping[str, int],
    data: Recordings,
    *,
    spec_samples: int,
    spec_steps: int | None = None,
) -> Verdict:
    """Run the chip and the model on recordings, and count every spike that differs.

    The `model` gives the spikes (steps, neurons) of each layer for events (taxels, polarities, steps); `first` is the
    tick in which a layer spikes for the first data step. The specification runs on the first recordings, too, and
    there on the first steps, where `spec_steps` says so.
    """
    machine, layers = machine_of(netlist), list(netlist.layers)
    spikes, differences = dict.fromkeys(first, 0), dict.fromkeys(first, 0)
    votes, overflows, wrong = np.zeros((len(data), netlist.classes), np.int64), 0, 0
    for index in range(len(data)):
        progress(f"comparing: {index} of {len(data)}")
        events = data.events[index : index + 1, ..., : data.steps_of(index)]
        trace = machine.simulate(events, spikes=True)
        assert trace.spikes is not None, "spikes are kept"
        expected = model(events[0])
        steps = events.shape[-1]
        for name, late in first.items():
            chosen = np.flatnonzero(netlist.layer == layers.index(name))
            on_chip = trace.spikes[0, late : late + steps * netlist.bin_ticks][:, chosen]
            due = np.zeros_like(on_chip)
            due[:: netlist.bin_ticks] = expected[name][:, netlist.neuron[chosen]]
            spikes[name] += int(expected[name].sum())
            differences[name] += int(np.count_nonzero(on_chip != due))
        overflows += int(trace.counts.overflows.sum())
        votes[index] = class_counts(netlist, trace.counts.votes)[0]
        if index < spec_samples:
            wrong += machine.check(events[..., :spec_steps])
    return Verdict(
        target=netlist.target,
        samples=len(data),
        spec=AgainstSpec(min(spec_samples, len(data)), wrong),
        model=AgainstModel(tuple(LayerSpikes(name, spikes[name], differences[name]) for name in first)),
        membranes_saturated=overflows,
        correct=int(np.count_nonzero(vote(votes) == data.labels)),
        spec_steps=spec_steps,
    )


def sections(found: Verdict) -> list[Section]:
    """The same for people."""
    part = "" if found.spec_steps is None else f" (the first {found.spec_steps} steps of each)"
    spec = _differences(found.spec.differences, found.spec.samples)
    model = _differences(found.model.differences, found.samples)
    rows = [[layer.name, f"{layer.spikes:,}", f"{layer.differences:,}"] for layer in found.model.layers]
    accuracy = f"accuracy of the chip: {found.correct} of {found.samples}, {100 * found.correct / found.samples:.2f} %"
    if found.exact:
        low, high = wilson(found.correct, found.samples)
        accuracy += f" (95 %: {100 * low:.1f} … {100 * high:.1f}); the model's is the same, vote for vote"
    blocks: list[Text | Table] = [
        Text(f"E0 specification = engine: {spec}{part}, membranes and counts too"),
        Text(f"E1 model = chip: {model}, every copy of every neuron"),
        Table(["layer", "spikes of the model", "different"], rows),
        Text(f"membranes that left their register: {found.membranes_saturated:,}"),
    ]
    if found.sums:
        shares = [f"{each.saturated:,} ({100 * each.saturated / max(each.partial, 1):.2g} %)" for each in found.sums]
        each_sum = zip(found.sums, shares, strict=True)
        sums = [[each.layer, f"{each.partial:,}", share, str(each.largest)] for each, share in each_sum]
        blocks.append(Table(["layer", "partial sums", "saturated", "largest"], sums))
    return [Section("Verdict", [*blocks, Text(accuracy)])]


def _differences(differences: int, samples: int) -> str:
    on = f"on {samples} recording{'s' * (samples != 1)}"
    return f"{differences:,} differences {on}" if differences else f"equal in every spike {on}"
