"""A network of whole numbers that crossbar cores hold: what is trained for TrueNorth, and how it is placed.

A network is a chain of *stages*. A stage has blocks of neurons; all neurons of a block receive the same
inputs, each input reaches one block, and every stage but the first may receive the clocks, too. With levels
``k`` of a neuron for its inputs,

    ``m_t = c_{t-1} + UNIT * sum_i k_i x_i(t) + leak``,  ``s_t = m_t >= threshold``,
    ``c_t = 0`` after a spike, ``max(m_t, -floor)`` otherwise, from ``c = 0`` on:

nothing decays, so the membrane remembers; the leak is a drift, and with the floor a forgetting.

*Levels.* An input that is led to m axons of a core, one of each of the types 0 … m - 1, gives every neuron the sums of
the subsets of its m weights, by the crossing points that are set: with ``(-1, 1)`` three levels, with ``(-3, 1, 2)``
seven, with ``(-7, 1, 2, 4)`` fifteen, each times ``UNIT``, which makes threshold and leak finer than the weights.

*Places.* Each block of a stage gets cores of its own, as many as its neurons need. An input reaches m axons on each of
them; a neuron of the stage before has one target only, so there is one of it for each of these axons, all alike: the
same levels, and so the same spikes. That costs neurons and neither ticks nor relays. Channels of the sensor and clocks
come from outside and may reach any number of axons.

A stage at depth d runs d ticks behind the data: clocks reach it d ticks later, its votes count from tick d
on, and its membranes start where the leak of d ticks brings them to rest, see :func:`steepest_leak`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeloom.compiler.dynamics import NO_CLOCKS, Clocks
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.builder import Draft, Neuron, Place, crossing_points
from spikeloom.compiler.targets.truenorth.netlist import RESET_TO, CrossbarNetlist
from spikeloom.compiler.types import IntArray

SYSTEM = "tactilesgnet-truenorth"
"""What such a network is called among the systems."""

UNIT = 32
"""Weight of level 1; ``7 * UNIT`` is the largest weight, and fits 9 bits with sign."""

BASES = {2: (-1, 1), 3: (-3, 1, 2), 4: (-7, 1, 2, 4)}
"""Weights of the axon types by number of copies, in units."""

DEFAULT_COPIES = 3

LEAK_MOST = 255
"""Magnitude of a leak, 9 bits with sign."""

THRESHOLD_MOST = 1 << 17
"""Threshold and floor: a membrane between them, and whatever 256 axons add, stays within 20 bits."""


def highest_level(copies: int) -> int:
    """Levels are the whole numbers of at most this magnitude.

    >>> [highest_level(copies) for copies in (2, 3, 4)]
    [1, 3, 7]
    """
    return -BASES[copies][0]


def steepest_leak(threshold: IntArray, depth: int) -> IntArray:
    """Largest leak at a depth: one that reaches neither threshold nor floor in the ticks before the first data.

    A stage at depth d receives data from tick d on. Its membranes start at ``-d * leak``, and the leak alone
    brings them to rest by then, on a way that must touch no limit; the floor is no nearer than the
    threshold.
    """
    return np.minimum((threshold - 1) // max(1, depth - 1), LEAK_MOST)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stage:
    """Neurons of one layer; neuron ``block * size + n``.

    `inputs` (blocks, width) are the neurons of the stage before that each block receives, channels of the
    sensor in the first stage; `level` (blocks, width + clocks, size) is for each of these, for each clock as
    far as the stage receives them, and for each neuron; `threshold`, `floor` and `leak` are (blocks *
    size,); all int64.
    """

    name: str
    inputs: IntArray
    level: IntArray
    threshold: IntArray
    floor: IntArray
    leak: IntArray

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.level)

    @property
    def size(self) -> int:
        """Neurons of a block."""
        return int(self.level.shape[2])

    @property
    def neurons(self) -> int:
        """Neurons of the stage."""
        return self.blocks * self.size

    @property
    def clocks(self) -> int:
        """Clocks that the stage receives."""
        return int(self.level.shape[1] - self.inputs.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NativeNetwork:
    """Stages over a sensor: neuron n of the last votes for class ``n % classes``.

    An input is led to `copies` axons, 2 to 4; the `clocks` are channels after those of the sensor.
    """

    taxels: int
    polarities: int
    classes: int
    copies: int
    stages: tuple[Stage, ...]
    clocks: Clocks = NO_CLOCKS


def faults(network: NativeNetwork) -> list[str]:
    """What in a network contradicts itself or the rules above; empty if it can be placed."""
    if network.copies not in BASES:
        return [f"{network.copies} copies of an input, allowed are {', '.join(map(str, BASES))}"]
    wrong = []
    fan_in = network.taxels * network.polarities
    for depth, stage in enumerate(network.stages):
        wrong += [f"{stage.name}: {fault}" for fault in _stage_faults(network, stage, depth, fan_in)]
        fan_in = stage.neurons
    if not network.stages or fan_in % network.classes:
        wrong.append(f"{fan_in} voting neurons for {network.classes} classes")
    return wrong


def _stage_faults(network: NativeNetwork, stage: Stage, depth: int, fan_in: int) -> Iterator[str]:
    if stage.clocks not in ({0} if not depth else {0, network.clocks.channels}):
        yield f"receives {stage.clocks} clocks of {network.clocks.channels}"
    inputs = stage.inputs.reshape(-1)
    whole = np.array_equal(np.sort(inputs), np.arange(fan_in))
    if stage.inputs.shape[0] != stage.blocks or not whole:
        yield f"{stage.blocks} blocks do not share {fan_in} inputs among them"
    for name in ("threshold", "floor", "leak"):
        if getattr(stage, name).shape != (stage.neurons,):
            yield f"{len(getattr(stage, name))} values of {name} for {stage.neurons} neurons"
            return
    if np.abs(stage.level).max(initial=0) > highest_level(network.copies):
        yield f"levels beyond {highest_level(network.copies)}, the most of {network.copies} copies"
    if (
        np.any(stage.threshold < 1)
        or np.any(stage.floor < stage.threshold)
        or np.any(stage.floor > THRESHOLD_MOST)
    ):
        yield f"thresholds and floors outside 1 <= threshold <= floor <= {THRESHOLD_MOST}"
    elif np.any(np.abs(stage.leak) > steepest_leak(stage.threshold, depth)):
        yield "leaks that the ticks before the first data cannot undo"


def lower(
    network: NativeNetwork, chip: Target, *, provenance: Mapping[str, Any] | None = None
) -> CrossbarNetlist:
    """Place a network without faults; CapacityError if there are more cores than on the chip."""
    draft = Draft()
    ends = None
    for depth in range(len(network.stages) - 1, -1, -1):
        ends = _place(draft, network, depth, ends, chip.limit("core.neurons"))
    remedy = "train with fewer features or copies"
    return draft.placed(network, chip, remedy, clocks=network.clocks, provenance=provenance)


def _place(
    draft: Draft, network: NativeNetwork, depth: int, ends: list[list[Place]] | None, most: int
) -> list[list[Place]]:
    """Add the cores of a stage whose neurons reach the axons `ends`; returns those that each of its inputs reaches."""
    stage = network.stages[depth]
    copies = network.copies
    first_clock = network.taxels * network.polarities
    width = stage.inputs.shape[1]
    reached: list[list[Place]] = [[] for _ in range(stage.inputs.size)]
    for block in range(stage.blocks):
        points = crossing_points(stage.level[block], BASES[copies])
        offset = block * stage.size
        aims = [
            (n, end) for n in range(stage.size) for end in ([None] if ends is None else ends[offset + n])
        ]
        for first in range(0, len(aims), most):
            core = draft.core()
            part = aims[first : first + most]
            for n, end in part:
                made = _neuron(stage, offset + n, depth, copies)
                number = draft.neuron(core, made, layer=stage.name, number=offset + n)
                if end is None:
                    draft.vote((core, number), (offset + n) % network.classes, first=depth)
                else:
                    draft.wire((core, number), *end)
            on_core = [n for n, _ in part]
            # an axon that joins nothing still keeps its neuron in the network; from outside there need be
            # none
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
