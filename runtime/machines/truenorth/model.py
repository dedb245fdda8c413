"""What TrueNorth must do, spike by spike: the networks that are lowered to it, run in whole numbers."""

from collections.abc import Iterable, Mapping
from functools import partial

import numpy as np

from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.counting import planned, run_counters
from spikeloom.compiler.targets.truenorth.native import NativeNetwork
from spikeloom.compiler.targets.truenorth.passes import Source
from spikeloom.compiler.types import BoolArray, EventArray
from spikeloom.runtime.machines.base import Model


def model_of(source: Source, target: Target) -> Model:
    """Of a network that was trained for the chip, or of a counting one."""
    if isinstance(source, NativeNetwork):
        first = {stage.name: index for index, stage in enumerate(source.stages)}
        return Model(first=first, spikes=partial(_run_trained, source))
    plan = planned(source, target)
    return Model(
        first=plan.first, spikes=lambda events: _stacked(run_counters(plan, each) for each in events)
    )


def _run_trained(network: NativeNetwork, events: EventArray) -> Mapping[str, BoolArray]:
    """The model that was trained."""
    from spikeloom.models.truenorth.network import run_network  # torch, so only here

    return run_network(network, events)


def _stacked(recordings: Iterable[Mapping[str, BoolArray]]) -> dict[str, BoolArray]:
    """Spikes by layer (samples, steps, neurons) of recordings one by one."""
    parts = list(recordings)
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}
