"""Place a history-free network of full fan-in on crossbar cores: sums that travel in time, one data step in 20 ticks.

A network in levels (:mod:`truenorth.codebook`) has nothing that a crossbar core has not, but fan-in: partial
sums leave a core as spikes only. So they leave it as *numbers of spikes*. In tick ``t`` of a data step, inputs in 0:

========  ==============================================================================================================
``0``     the inputs of a group arrive; one neuron holds their sum, another the sum of opposite sign, zero at the least
``0…18``  each of these spikes as long as it holds one or more, and gives one away (linear reset): at most 19
``1…19``  the gated neuron adds these spikes up, those for negative sums with weight -1
``19``    a clock lifts it by as much as its threshold lies above all sums: it spikes where the sum is large enough;
          another clock empties what the neurons of partial sums still hold
``20``    a third clock pulls it below its negative threshold, which resets it to zero
========  ==============================================================================================================

That is exact where every partial sum lies within 19, and saturates otherwise, as the network in levels does, spike for
spike. A layer whose inputs fit a core is added up in one tick instead. Spikes of a split layer are led on by relays,
those of the others by copies of the neurons.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.errors import CapacityError
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.builder import RELAY, Draft, Neuron, Place, crossing_points, history_free
from spikeloom.compiler.targets.truenorth.codebook import BIN_TICKS, EMPTYING, MOST, WEIGHTS, Layer, LevelNetwork
from spikeloom.compiler.targets.truenorth.netlist import AXON_TYPES, RESET_LINEAR, RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

LIFT, PULL = 255, -256
"""Weights of the clocks of gated neurons."""

CLOCK = AXON_TYPES - 1
"""Type of axons that clocks reach on cores that add up inputs."""

RELAYED = 2
"""Ticks that a spike of a split layer takes to the next one, by a relay or without."""


def lower_in_time(
    network: LevelNetwork, chip: Target, *, provenance: Mapping[str, Any] | None = None
) -> CrossbarNetlist:
    """Place a network in levels; CapacityError if a layer has more groups than a core holds, or too many cores."""
    placing = _Placing(network=network, chip=chip, starts=_starts(network))
    ends: list[list[Place]] | None = None
    for depth, layer in reversed(list(enumerate(network.layers))):
        inputs: list[list[Place]] = [[] for _ in range(layer.level.shape[1])]
        (placing.split if layer.is_split else placing.whole)(depth, layer, ends, inputs)
        ends = inputs
    for channel, places in enumerate(ends or []):
        for core, line in places:
            placing.draft.feed(channel, core, line)
    remedy = "use fewer axons an input, or train with fewer features"
    return placing.draft.placed(network, chip, remedy, bin_ticks=BIN_TICKS, provenance=provenance)


def _starts(network: LevelNetwork) -> list[int]:
    """Tick in which the inputs of the first data step reach each layer."""
    starts = [0]
    for layer in network.layers[:-1]:
        starts.append(starts[-1] + (MOST + RELAYED if layer.is_split else 1))
    return starts


def _first_types(layer: Layer) -> tuple[int, ...]:
    """Weights of the axon types of inputs, without that of clocks."""
    return (*WEIGHTS[layer.copies], 0)[:CLOCK]


def first_spikes(network: LevelNetwork) -> dict[str, int]:
    """Tick in which each layer spikes for the first data step."""
    starts = _starts(network)
    return {layer.name: start + layer.is_split * MOST for layer, start in zip(network.layers, starts, strict=True)}


@dataclass(slots=True, kw_only=True)
class _Placing:
    """Cores as they are made, last layer first; `starts` are those of the layers."""

    network: LevelNetwork
    chip: Target
    starts: list[int]
    draft: Draft = field(default_factory=Draft)
    relay_core: int | None = None

    def whole(self, depth: int, layer: Layer, ends: list[list[Place]] | None, inputs: list[list[Place]]) -> None:
        """A layer whose inputs fit a core: a neuron for each axon that it reaches, all in one tick."""
        aims = [(n, end) for n in range(len(layer.level)) for end in ([None] if ends is None else ends[n])]
        weights = WEIGHTS[layer.copies]
        for part in self._packed(layer, aims):
            core = self.draft.core()
            for n, end in part:
                threshold = int(layer.threshold[n])
                made = history_free(weights, threshold)
                if threshold <= 0:  # it would spike without inputs and has to wait for a clock: its leak must not do
                    made = history_free((*_first_types(layer), 1 - threshold), 1)
                self._add(core, made, layer, n, None if end is None else [end], depth, 1)
            chosen = np.array([n for n, _ in part])
            self._inputs(core, layer, layer.level[chosen].T, range(layer.level.shape[1]), inputs)
            waiting = np.flatnonzero(layer.threshold[chosen] <= 0).tolist()
            if waiting:
                self._clock(core, CLOCK, waiting, self.starts[depth])

    def split(self, depth: int, layer: Layer, ends: list[list[Place]] | None, inputs: list[list[Place]]) -> None:
        """A layer whose partial sums travel in time."""
        groups, start = layer.groups, self.starts[depth]
        sums = self._gated(depth, layer, len(groups), ends)
        most = self.chip.limit("core.neurons")
        for number, group in enumerate(groups):
            aims = [(n, sign) for n in range(len(layer.level)) for sign in (1, -1)]
            for first in range(0, len(aims), most):
                core, part = self.draft.core(), aims[first : first + most]
                for n, sign in part:
                    made = Neuron(
                        weights=(*(sign * weight for weight in _first_types(layer)), PULL),
                        reset_mode=RESET_LINEAR,
                        negative_saturates=True,
                    )
                    own_number = 2 * (number * len(layer.level) + n) + (sign < 0)
                    added = self.draft.neuron(core, made, layer=f"{layer.name} sums", number=own_number)
                    self.draft.wire((core, added), *sums[n][2 * number + (sign < 0)])
                chosen = np.array([n for n, _ in part])
                self._inputs(core, layer, layer.level[chosen][:, group].T, range(group.start, group.stop), inputs)
                for _ in range(EMPTYING):
                    self._clock(core, CLOCK, range(len(part)), start + MOST)

    def _gated(self, depth: int, layer: Layer, groups: int, ends: list[list[Place]] | None) -> list[list[Place]]:
        """Neurons that add up partial sums; returns for each the lines of its groups, above zero and below in turn."""
        reach = MOST * groups
        # axons of the clocks that lift a neuron to its threshold from below all sums, and that pull it down again
        lifts = (reach - int(layer.threshold.min())) // LIFT + 1
        pulls = (2 * reach + LIFT * lifts) // -PULL + 2
        a_core = min((self.chip.limit("core.axons") - lifts - pulls) // (2 * groups), self.chip.limit("core.neurons"))
        if a_core < 1:
            remedy = f"partial sums of {groups} groups and the clocks beside; use fewer inputs or copies"
            used = 2 * groups + lifts + pulls
            raise CapacityError((self.chip.exceeded(f"{layer.name}, a neuron", "core.axons", used, remedy),))
        start, found = self.starts[depth], list[list[Place]]()
        for first in range(0, len(layer.level), a_core):
            core, numbers = self.draft.core(), range(first, min(first + a_core, len(layer.level)))
            for n in numbers:
                made = Neuron(
                    weights=(1, -1, LIFT, PULL),
                    threshold=int(layer.threshold[n]) + LIFT * lifts,
                    reset_mode=RESET_TO,
                    negative_threshold=reach,
                )
                self._add(core, made, layer, n, None if ends is None else ends[n], depth, RELAYED)
                found += [[(core, self.draft.axon(core, sign, [n - first])) for _ in range(groups) for sign in (0, 1)]]
            for _ in range(lifts):
                self._clock(core, 2, range(len(numbers)), start + MOST)
            for _ in range(pulls):
                self._clock(core, 3, range(len(numbers)), start + BIN_TICKS)
        return found

    def _add(
        self, core: int, made: Neuron, layer: Layer, n: int, ends: Sequence[Place] | None, depth: int, delay: int
    ) -> None:
        """Add a neuron and what leads its spikes on: a vote, a wire to its only target, or relays to several."""
        number = self.draft.neuron(core, made, layer=layer.name, number=n)
        if ends is None:
            self.draft.vote((core, number), int(self.network.label[n]), first=self.starts[depth])
        elif len(ends) == 1:
            self.draft.wire((core, number), *ends[0], delay)
        elif ends:
            self.draft.wire((core, number), *self._relays(ends))

    def _relays(self, aims: Sequence[Place]) -> Place:
        """An axon, and a relay for each target on its core; the last core of relays is used as long as it has room."""
        most, lines = self.chip.limit("core.neurons"), self.chip.limit("core.axons")
        core = self.relay_core
        full = core is None or len(self.draft.cores[core].neurons) + len(aims) > most
        if core is None or full or len(self.draft.cores[core].axons) == lines:
            core = self.relay_core = self.draft.core()
        relays = [self.draft.neuron(core, RELAY) for _ in aims]
        for relay, aim in zip(relays, aims, strict=True):
            self.draft.wire((core, relay), *aim)
        return core, self.draft.axon(core, 0, relays)

    def _packed(self, layer: Layer, aims: list[tuple[int, Place | None]]) -> Iterator[list[tuple[int, Place | None]]]:
        """Neurons in their order, as many to a core as their inputs leave room for, with an axon for a clock."""
        neurons, axons = self.chip.limit("core.neurons"), self.chip.limit("core.axons")
        part, used = list[tuple[int, Place | None]](), np.zeros(layer.level.shape[1], np.bool_)
        for n, end in aims:
            more = used | (layer.level[n] != 0)
            if part and (len(part) == neurons or np.count_nonzero(more) * layer.copies >= axons):
                yield part
                part, more = [], layer.level[n] != 0
            part.append((n, end))
            used = more
        if part:
            yield part

    def _inputs(self, core: int, layer: Layer, levels: IntArray, sources: range, inputs: list[list[Place]]) -> None:
        """Add the axons of inputs (inputs, neurons of the core)."""
        for row, line in self.draft.inputs(core, crossing_points(levels, WEIGHTS[layer.copies])):
            inputs[sources[row]].append((core, line))

    def _clock(self, core: int, kind: int, neurons: Sequence[int], phase: int) -> None:
        self.draft.clock(core, self.draft.axon(core, kind, neurons), period=BIN_TICKS, phase=phase)
