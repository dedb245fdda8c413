"""Place a counting network on crossbar cores: the integers of its file, a tick to a data step.

What a core cannot hold are sums over hundreds of counters, so these are made in two steps, by numbers of
spikes:

============  ==========================================================================================================
``gates``     where a recording has several parts: spike when their channel and the clock of their part do
``counters``  add up events; a spike sets them to ``-BLOCK``, the one synapse onto itself that other chips need
``sums``      two of each class for some of the counters, for weights above zero and for those below; a counter is led
              to axons of the types 1, 2, 4 and 8. They spike as long as they hold one or more, and give one
              away
``votes``     add these spikes up, those for weights below zero with -1; the leak is the ramp. They are not reset
============  ==========================================================================================================

A neuron has one target, so there is a counter for each axon that it reaches, all alike. Cores are filled
with sums and votes first; counters and gates go where neurons and axons are left.

Sums spike later than they would on other chips, at most as many ticks as the largest can hold: so many ticks
later the votes count, and the ramp starts so much lower. The votes are those of other chips, spike for
spike, unless a sum crosses the threshold before the data end, or counters spike a second time shortly
before.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import floor
from typing import Any

import numpy as np

from spikeloom.compiler.counters import BLOCK, Counters
from spikeloom.compiler.dynamics import with_clocks
from spikeloom.compiler.errors import ModelError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, Place, history_free
from spikeloom.compiler.targets.truenorth.netlist import (
    AXON_TYPES,
    RESET_LINEAR,
    RESET_NONE,
    CrossbarNetlist,
)
from spikeloom.compiler.types import BoolArray, EventArray, IntArray

MAGNITUDES = tuple(1 << kind for kind in range(AXON_TYPES))
"""Weights of the axon types of a core of sums."""

LARGEST = sum(MAGNITUDES)

MOST = 2**31
"""No register holds a larger number."""

Wanted = tuple[Neuron, int, Place, tuple[int, ...]]
"""A neuron, its number in the layer, the axon that it reaches, and its sources."""

CHANNELS = 32
"""Axons that a core of sums leaves to channels, so that counters can use its other neurons."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """How the sums of a counting network are divided among cores."""

    counters: Counters
    groups: tuple[slice, ...]  # Counters whose sums are made together
    # (groups, 2 * classes, counters) int64; of each class the weights above zero, and the magnitudes of
    # those below
    magnitude: IntArray

    @property
    def first(self) -> dict[str, int]:
        """Tick in which each layer spikes for the first data step."""
        gated = int(self.counters.parts > 1)
        most = int(self.magnitude.sum(axis=2).max(initial=1))
        first = {"gates": 0} if gated else {}
        return first | {"counters": gated, "sums": gated + 1, "votes": gated + 1 + max(most, 1)}


def planned(counters: Counters, chip: Target) -> Plan:
    """Divide the counters of a network into groups whose sums fit a core; ModelError if the chip cannot hold it."""
    most = int(np.abs(counters.weight).max())
    if most > LARGEST:
        bits = LARGEST.bit_length() + 1
        raise ModelError(
            f"weights of up to {most}, {LARGEST} allowed; train it with --weight-bits {bits} or fewer"
        )
    if max(counters.threshold, counters.slope) > MOST:
        raise ModelError(f"a threshold or ramp beyond {MOST:,}, which no register holds; train it again")
    if counters.slope != int(counters.slope):
        raise ModelError(f"a ramp of {counters.slope:g} a step, whole numbers are allowed; train it again")
    signed = np.stack([counters.weight, -counters.weight], axis=1).clip(min=0)
    signed = signed.reshape(2 * counters.classes, -1)
    axons = (signed[None] & np.array(MAGNITUDES)[:, None, None]).any(axis=1).sum(axis=0)
    room = chip.limit("core.axons") - CHANNELS
    bounds = [0]
    for end in range(1, len(axons) + 1):
        if axons[bounds[-1] : end].sum() > room:
            bounds.append(end - 1)
    groups = tuple(slice(*each) for each in zip(bounds, [*bounds[1:], len(axons)], strict=True))
    magnitude = np.zeros((len(groups), *signed.shape), np.int64)
    for number, group in enumerate(groups):
        magnitude[number, :, group] = signed[:, group]
    return Plan(counters=counters, groups=groups, magnitude=magnitude)


def lower_counters(
    counters: Counters, chip: Target, *, provenance: Mapping[str, Any] | None = None
) -> CrossbarNetlist:
    """Place a counting network; ModelError if its weights are beyond the chip, CapacityError if its cores are."""
    plan = planned(counters, chip)
    draft = Draft()
    reached = _sums(draft, plan, _votes(draft, plan, chip))
    channels = counters.taxels * counters.polarities
    source = _sources(counters)
    wanted = list[Wanted]()
    for n in np.argsort(source, kind="stable").tolist():
        made = Neuron(threshold=int(counters.counter[n, 2]), reset=-BLOCK, negative_threshold=BLOCK)
        wanted += [(made, n, end, (int(source[n]),)) for end in reached[n]]
    fed = _filled(draft, chip, "counters", wanted)
    if counters.parts > 1:
        gated = [(*divmod(gate, channels), gate, end) for gate, end in fed]
        gate = history_free((1,), 2)
        wanted = [(gate, number, end, (channel, channels + part)) for part, channel, number, end in gated]
        fed = _filled(draft, chip, "gates", wanted)
    for channel, end in fed:
        draft.feed(channel, *end)
    remedy = "train it with fewer thresholds, or --weight-bits"
    facts = {"bins": counters.bins, "clocks": counters.clocks, "provenance": provenance}
    return draft.placed(counters, chip, remedy, **facts)


def _sources(counters: Counters) -> IntArray:
    """Channel that each counter receives, or its gate; (counters,)."""
    channel, part, _ = counters.counter.T
    return np.asarray(part * (counters.taxels * counters.polarities) + channel)


def _least(counters: Counters) -> int:
    """Membrane at which a vote spikes: the first whole number above the threshold."""
    return floor(counters.threshold) + 1


def _votes(draft: Draft, plan: Plan, chip: Target) -> dict[Place, Place]:
    """Add the votes; returns the axon that each sum reaches, by its group and its place in the group."""
    counters = plan.counters
    ends = dict[Place, Place]()
    used = plan.magnitude.sum(axis=2) > 0
    first = plan.first["votes"]
    slope = int(counters.slope)
    core = draft.core()
    lowest = (1 << chip.limit("neuron.threshold_bits")) - 1
    for label in range(counters.classes):
        lines = np.argwhere(used[:, 2 * label : 2 * label + 2]).tolist()
        if len(draft.cores[core].axons) + len(lines) > chip.limit("core.axons"):
            core = draft.core()
        vote = Neuron(
            weights=(1, -1),
            leak=slope,
            threshold=_least(counters),
            reset_mode=RESET_NONE,
            negative_threshold=lowest,
            negative_saturates=True,
            initial=-slope * first,
        )
        number = draft.neuron(core, vote, layer="votes", number=label)
        draft.vote((core, number), label, first=first)
        for group, sign in lines:
            ends[group, 2 * label + sign] = core, draft.axon(core, sign, [number])
    return ends


def _sums(draft: Draft, plan: Plan, ends: Mapping[Place, Place]) -> list[list[Place]]:
    """Add the sums, which reach the axons `ends`; returns the axons that each counter reaches."""
    reached = [list[Place]() for _ in plan.counters.counter]
    for number, group in enumerate(plan.groups):
        core = draft.core()
        rows = sorted(row for each, row in ends if each == number)
        for row in rows:
            adder = Neuron(weights=MAGNITUDES, reset_mode=RESET_LINEAR)
            added = draft.neuron(core, adder, layer="sums", number=number * plan.magnitude.shape[1] + row)
            draft.wire((core, added), *ends[number, row])
        points = plan.magnitude[number, rows, group].T[:, :, None] & np.array(MAGNITUDES)
        for n, line in draft.inputs(core, points):
            reached[group.start + n].append((core, line))
    return reached


def _filled(draft: Draft, chip: Target, layer: str, wanted: Iterable[Wanted]) -> list[tuple[int, Place]]:
    """Add neurons; gives each source and an axon that waits for it."""
    neurons = chip.limit("core.neurons")
    axons = chip.limit("core.axons")
    awaited = defaultdict[int, dict[int, list[int]]](
        dict
    )  # neurons of each core by the source that they wait for
    for made, number, end, sources in wanted:
        for core, held in enumerate(draft.cores):
            if (
                len(held.neurons) < neurons
                and len(held.axons) + len(awaited[core].keys() | set(sources)) <= axons
            ):
                break
        else:
            core = draft.core()
        added = draft.neuron(core, made, layer=layer, number=number)
        draft.wire((core, added), *end)
        for source in sources:
            awaited[core].setdefault(source, []).append(added)
    return [
        (source, (core, draft.axon(core, 0, joined)))
        for core in range(len(draft.cores))
        for source, joined in awaited[core].items()
    ]


def run_counters(plan: Plan, events: EventArray) -> dict[str, BoolArray]:
    """Spikes (steps, neurons) of each layer for one recording (taxels, polarities, steps), in whole numbers.

    Step s of a layer is the tick ``s`` after its first, see :attr:`Plan.first`.
    """
    counters = plan.counters
    first = plan.first
    steps = events.shape[-1]
    active = with_clocks(events[None], counters.clocks)[0].T > 0
    channels = counters.taxels * counters.polarities
    spikes = dict[str, BoolArray]()
    source = active[:, :channels]
    if counters.parts > 1:
        source = (active[:, channels:, None] & source[:, None]).reshape(steps, -1)
        spikes["gates"] = source
    seen = source[:, _sources(counters)]
    count = counters.counter[:, 2]
    over = np.cumsum(seen, axis=0) - count
    spikes["counters"] = seen & (over >= 0) & (over % (count + BLOCK) == 0)

    late = first["votes"] - first["sums"]
    arriving = np.zeros((steps + late, plan.magnitude.shape[0] * plan.magnitude.shape[1]), np.int64)
    arriving[:steps] = spikes["counters"].astype(np.int64) @ plan.magnitude.reshape(arriving.shape[1], -1).T
    sent = np.zeros(arriving.shape, np.bool_)
    membrane = np.zeros(arriving.shape[1], np.int64)
    for tick, more in enumerate(arriving):
        membrane += more
        sent[tick] = membrane > 0
        membrane -= sent[tick]
    spikes["sums"] = sent[:steps]
    above, below = np.moveaxis(sent.reshape(steps + late, -1, counters.classes, 2).sum(axis=1), -1, 0)
    sums = np.cumsum(above - below, axis=0)[late - 1 : -1]
    ramp = int(counters.slope) * np.arange(1, steps + 1)[:, None]
    spikes["votes"] = sums + ramp >= _least(counters)
    return spikes
