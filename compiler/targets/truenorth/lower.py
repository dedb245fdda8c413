"""Place a network of whole numbers on crossbar cores.

Each block of a stage gets cores of its own, as many as its neurons need. An input reaches m axons on each of them; a
neuron of the stage before has one target only, so there is one of it for each of these axons, all alike: the same
levels, and so the same spikes. That costs neurons and neither ticks nor relays. Channels of the sensor and clocks come
from outside and may reach any number of axons.

A stage at depth d runs d ticks behind the data: clocks reach it d ticks later, its votes count from tick d on, and its
membranes start where the leak of d ticks brings them to rest, see :func:`native.steepest_leak`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from spikeloom.compiler.errors import CapacityError, Violation
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, Place, crossing_points
from spikeloom.compiler.targets.truenorth.native import BASES, UNIT, NativeNetwork, Stage, faults
from spikeloom.compiler.targets.truenorth.netlist import RESET_TO, CrossbarNetlist


def lower(network: NativeNetwork, chip: Target, *, provenance: Mapping[str, Any] | None = None) -> CrossbarNetlist:
    """Place a network without faults; CapacityError if there are more cores than on the chip."""
    assert not faults(network), "networks are checked where they are read or made"
    draft, ends = Draft(), None
    for depth in range(len(network.stages) - 1, -1, -1):
        ends = _place(draft, network, depth, ends, chip.limit("core.neurons"))
    place_cores(draft, chip, "train with fewer features or copies")
    return draft.netlist(
        taxels=network.taxels,
        polarities=network.polarities,
        classes=network.classes,
        clocks=network.clocks,
        target=chip.name,
        provenance=provenance,
    )


def _place(
    draft: Draft, network: NativeNetwork, depth: int, ends: list[list[Place]] | None, most: int
) -> list[list[Place]]:
    """Add the cores of a stage whose neurons reach the axons `ends`; returns the axons that each of its inputs reaches.

    The last stage, which has no `ends`, votes.
    """
    stage, copies = network.stages[depth], network.copies
    first_clock, width = network.taxels * network.polarities, stage.inputs.shape[1]
    reached: list[list[Place]] = [[] for _ in range(stage.inputs.size)]
    for block in range(stage.blocks):
        points, offset = crossing_points(stage.level[block], BASES[copies]), block * stage.size
        aims = [(n, end) for n in range(stage.size) for end in ([None] if ends is None else ends[offset + n])]
        for first in range(0, len(aims), most):
            core, part = draft.core(), aims[first : first + most]
            for n, end in part:
                made = _neuron(stage, offset + n, depth, copies)
                number = draft.neuron(core, made, layer=stage.name, number=offset + n)
                if end is None:
                    draft.vote((core, number), (offset + n) % network.classes, first=depth)
                else:
                    draft.wire((core, number), *end)
            on_core = [n for n, _ in part]
            # an axon that joins nothing still keeps its neuron in the network; from outside there need be none
            for row, line in draft.inputs(core, points[:, on_core], kept=width if depth else 0):
                if row >= width:
                    draft.feed(first_clock + row - width, core, line, tick=depth)
                elif depth:
                    reached[stage.inputs[block, row]].append((core, line))
                else:
                    draft.feed(int(stage.inputs[block, row]), core, line)
    return reached


def _neuron(stage: Stage, n: int, depth: int, copies: int) -> Neuron:
    leak = int(stage.leak[n])
    return Neuron(
        weights=tuple(UNIT * base for base in BASES[copies]),
        leak=leak,
        threshold=int(stage.threshold[n]),
        reset_mode=RESET_TO,
        negative_threshold=int(stage.floor[n]),
        negative_saturates=True,
        initial=-depth * leak,
    )


def place_cores(draft: Draft, chip: Target, remedy: str) -> None:
    """Give cores their places, line by line in a square as they were made; CapacityError if there are too many."""
    count = len(draft.cores)
    if count > chip.limit("chip.cores"):
        raise CapacityError((exceeded(chip, "chip", "chip.cores", count, remedy),))
    side = max(int(np.ceil(np.sqrt(count))), -(-count // chip.limit("mesh.height")))
    for number, core in enumerate(draft.cores):
        core.y, core.x = divmod(number, side)


def exceeded(chip: Target, owner: str, rule: str, used: int, remedy: str) -> Violation:
    """A limit of the chip that is exceeded, by its rule."""
    return Violation(owner=owner, rule=f"{chip.name}.{rule}", used=used, allowed=chip.limit(rule), remedy=remedy)
