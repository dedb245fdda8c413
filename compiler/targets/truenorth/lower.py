"""Place a network of whole numbers on crossbar cores; every rule of the chip is kept by construction.

Each block of a stage gets cores of its own, as many as its neurons need. An input reaches m axons on each of them; a
neuron of the stage before has one target only, so there is one of it for each of these axons, all alike: the same
levels, and so the same spikes. That costs neurons and neither ticks nor relays. Channels of the sensor and clocks come
from outside and may reach any number of axons.

A stage at depth d runs d ticks behind the data: clocks reach it d ticks later, its votes count from tick d on, and its
membranes start where the leak of d ticks brings them to rest, see :func:`native.steepest_leak`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, crossing_points
from spikeloom.compiler.targets.truenorth.native import BASES, UNIT, NativeNetwork, Stage, Tower, faults
from spikeloom.compiler.targets.truenorth.netlist import RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

Place = tuple[int, int]
"""Core, and neuron or line on it."""


def lower(network: NativeNetwork, chip: Target, *, provenance: Mapping[str, Any] | None = None) -> CrossbarNetlist:
    """Place a network without faults; `provenance` are JSON values to store.

    Raises
    ------
    CapacityError
        If a block has more inputs than a core has axons, or there are more cores than on the chip.
    """
    assert not faults(network), "networks are checked where they are read or made"
    _require_axons(network, chip)
    placing = _Placing(network=network, chip=chip)
    for tower in network.towers:
        placing.tower(tower)
    remedy = "join fewer towers, or train with fewer features or copies"
    place_cores(placing.draft, placing.wires, chip, remedy)
    return placing.draft.netlist(
        taxels=network.taxels,
        polarities=network.polarities,
        classes=network.classes,
        clocks=network.clocks,
        target=chip.name,
        provenance=provenance,
    )


def exceeded(chip: Target, owner: str, rule: str, used: int, remedy: str) -> Violation:
    """A limit of the chip that is exceeded, by its rule."""
    return Violation(owner=owner, rule=f"{chip.name}.{rule}", used=used, allowed=chip.limit(rule), remedy=remedy)


def _require_axons(network: NativeNetwork, chip: Target) -> None:
    """Refuse blocks with more inputs than a core has axons."""
    copies, broken = network.copies, []
    for number, tower in enumerate(network.towers):
        for stage in tower:
            inputs = stage.level.shape[1]
            if inputs * copies > chip.limit("core.axons"):
                words = f"{inputs} inputs and clocks with {copies} copies each; "
                words += "train it with more groups, or fewer clocks or copies"
                broken.append(exceeded(chip, f"tower {number}, {stage.name}", "core.axons", inputs * copies, words))
    if broken:
        raise CapacityError(tuple(broken))


@dataclass(slots=True, kw_only=True)
class _Placing:
    """Cores as they are made.

    `numbers` are the neurons of each layer so far; `wires` from neurons to axons are drawn when all cores have places.
    """

    network: NativeNetwork
    chip: Target
    draft: Draft = field(default_factory=Draft)
    numbers: dict[str, int] = field(default_factory=dict)
    wires: list[tuple[Place, Place]] = field(default_factory=list)

    def tower(self, tower: Tower) -> None:
        """Add the cores of a tower, last stage first: a neuron is made as often as there are axons that it reaches."""
        ends: list[list[Place]] | None = None
        for depth in range(len(tower) - 1, -1, -1):
            before: list[list[Place]] = [[] for _ in range(tower[depth - 1].neurons if depth else 0)]
            for block in range(tower[depth].blocks):
                self.block(tower[depth], block, depth, ends, before)
            self.numbers[tower[depth].name] = self.numbers.get(tower[depth].name, 0) + tower[depth].neurons
            ends = before

    def block(
        self, stage: Stage, block: int, depth: int, ends: list[list[Place]] | None, before: list[list[Place]]
    ) -> None:
        """Add the cores of a block; `ends` are the axons that its neurons reach, `before` takes those of its inputs."""
        own = range(block * stage.size, (block + 1) * stage.size)
        copies = [(n, end) for n in own for end in ([None] if ends is None else ends[n])]
        most, offset = self.chip.limit("core.neurons"), self.numbers.get(stage.name, 0)
        points = crossing_points(stage.level[block], BASES[self.network.copies])
        for first in range(0, len(copies), most):
            core = self.draft.core(0, 0)
            part = copies[first : first + most]
            for n, end in part:
                number = self.draft.neuron(core, self.neuron(stage, n, depth), layer=stage.name, number=offset + n)
                if end is None:
                    self.draft.vote((core, number), n % self.network.classes, first=depth)
                else:
                    self.wires.append(((core, number), end))
            on_core = np.array([n for n, _ in part]) - own[0]
            self.axons(stage.inputs[block], points[:, on_core], depth, core, before)

    def axons(self, inputs: IntArray, points: IntArray, depth: int, core: int, before: list[list[Place]]) -> None:
        """Add the axons of a core: copies of each input and clock; from outside only those that join something."""
        first_clock = self.network.taxels * self.network.polarities
        for row in range(len(points)):
            clock = row >= len(inputs)
            source = first_clock + row - len(inputs) if clock else int(inputs[row])
            for copy in range(self.network.copies):
                joined = np.flatnonzero(points[row, :, copy]).tolist()
                outside = clock or not depth
                if outside and not joined:
                    continue
                line = self.draft.axon(core, copy)
                self.draft.connect(core, line, joined)
                if outside:
                    self.draft.feed(source, core, line, tick=depth)
                else:
                    before[source].append((core, line))

    def neuron(self, stage: Stage, n: int, depth: int) -> Neuron:
        """A neuron of a stage, as the chip has it."""
        leak = int(stage.leak[n])
        return Neuron(
            weights=tuple(UNIT * base for base in BASES[self.network.copies]),
            leak=leak,
            threshold=int(stage.threshold[n]),
            reset_mode=RESET_TO,
            negative_threshold=int(stage.floor[n]),
            negative_saturates=True,
            initial=-depth * leak,
        )


def place_cores(draft: Draft, wires: Sequence[tuple[Place, tuple[int, ...]]], chip: Target, remedy: str) -> None:
    """Give cores their places, line by line in a square as they were made, and draw wires to (core, line, delay).

    CapacityError with the `remedy` if there are more cores than on the chip.
    """
    count = len(draft.cores)
    if count > chip.limit("chip.cores"):
        raise CapacityError((exceeded(chip, "chip", "chip.cores", count, remedy),))
    side = max(int(np.ceil(np.sqrt(count))), -(-count // chip.limit("mesh.height")))
    for number, core in enumerate(draft.cores):
        core.y, core.x = divmod(number, side)
    for source, end in wires:
        draft.wire(source, *end)
