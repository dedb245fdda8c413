"""What TrueNorth must do, spike by spike: the networks that are lowered to it, run in whole numbers."""

from collections.abc import Iterable, Mapping

import numpy as np

from spikeloom.compiler.counters import Counters
from spikeloom.compiler.passes.expand import Factored, expand
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.codebook import in_levels, run_levels
from spikeloom.compiler.targets.truenorth.counting import planned, run_counters
from spikeloom.compiler.targets.truenorth.in_time import first_spikes
from spikeloom.compiler.targets.truenorth.native import NativeNetwork
from spikeloom.compiler.targets.truenorth.passes import Source
from spikeloom.compiler.types import BoolArray, EventArray
from spikeloom.runtime.machines.base import Model


def model_of(source: Source, target: Target, in_time: int | None) -> Model:
    """Of a trained or counting network, or of a history-free one whose inputs have `in_time` axons."""
    if isinstance(source, NativeNetwork):
        from spikeloom.models.truenorth.network import run_network  # torch, so only here

        first = {stage.name: index for index, stage in enumerate(source.stages)}
        return Model(first=first, spikes=lambda events: run_network(source, events))
    if isinstance(source, Counters):
        plan = planned(source, target)
        return Model(first=plan.first, spikes=lambda events: _stacked(run_counters(plan, each) for each in events))
    assert in_time is not None, "floats have levels only if their sums travel in time"
    network = expand(source.checkpoint, source.propagation) if isinstance(source, Factored) else source
    levels = in_levels(network, in_time, target)

    def spikes(events: EventArray) -> Mapping[str, BoolArray]:
        flat = events.reshape(len(events), -1, events.shape[-1])
        return _stacked(run_levels(levels, each)[0] for each in flat)

    return Model(first=first_spikes(levels), spikes=spikes)


def _stacked(recordings: Iterable[Mapping[str, BoolArray]]) -> dict[str, BoolArray]:
    """Spikes by layer (samples, steps, neurons) of recordings one by one."""
    parts = list(recordings)
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}
