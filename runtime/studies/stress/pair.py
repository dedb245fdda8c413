"""A float network and the netlist beside it on the same recordings, compared spike by spike; and what perturbs them.

What is counted is what spikes after `begin`, so that recordings may follow others without a reset.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist
from spikeloom.compiler.errors import NumericRangeError, OptionError
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.equivalence import float_engine
from spikeloom.runtime.machines.integer import IntegerMachine, integer_machine_of

Words = npt.NDArray[np.uint64]

SIDES = ("float", "chip")

STOPPED = -1
"""Decision where a register of the chip overflows and the simulator stops."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """A netlist and the float network beside it, of the same populations; prepared when it first runs."""

    netlist: Netlist
    network: Network

    @cached_property
    def chip(self) -> IntegerMachine:
        """The netlist, ready to run."""
        return integer_machine_of(self.netlist)

    @cached_property
    def model(self) -> float_engine.FloatEngine:
        """The float network, likewise."""
        return float_engine.prepare(self.network, self.netlist)

    def masks(self) -> Words:
        """Bits of each layer's compartments in packed spikes; (layers, words) uint64."""
        netlist = self.netlist
        masks = np.zeros((len(netlist.layers), -(-netlist.n_compartments // 64)), np.uint64)
        ids = np.arange(netlist.n_compartments)
        np.bitwise_or.at(masks, (netlist.layer, ids // 64), np.left_shift(np.uint64(1), (ids % 64).astype(np.uint64)))
        return masks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inputs:
    """Channels (recordings, channels, T) uint8; steps of each recording, and the first that counts, (recordings,)."""

    events: npt.NDArray[np.uint8]
    lengths: IntArray
    begin: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """What both sides did."""

    votes: dict[str, IntArray]  # By side
    spikes: IntArray  # (recordings, layers, 3) int64; of the float network, of the chip, and those in which they differ
    stopped: BoolArray  # (recordings,) bool; where a register of the chip would overflow
    saturated: IntArray  # (recordings,) int64; membranes that were clipped

    def decisions(self, side: str) -> IntArray:
        """Class of each recording."""
        decided = vote(self.votes[side])
        return np.where(self.stopped, STOPPED, decided) if side == "chip" else decided


def evaluate(pair: Pair, inputs: Inputs) -> Outcome:
    """Run both sides from rest."""
    netlist = pair.netlist
    model = float_engine.run(pair.model, inputs.events, lengths=inputs.lengths, begin=inputs.begin)
    packed, stopped, saturated = _chip(pair.chip, inputs)
    depth = np.array([layer.depth for layer in netlist.layers])
    spikes = np.zeros((len(inputs.events), len(netlist.layers), 3), np.int64)
    spikes[:, :, 0] = model.spikes
    spikes[:, :, 1:] = _tally(packed, model.packed, pair.masks(), depth, inputs)
    spikes[:, :, 2] += model.elsewhere
    votes = _votes(netlist, packed, depth, inputs)
    return Outcome(votes={"float": model.votes, "chip": votes}, spikes=spikes, stopped=stopped, saturated=saturated)


def _chip(machine: IntegerMachine, inputs: Inputs) -> tuple[Words, BoolArray, IntArray]:
    """Packed spikes, which recordings stopped the simulator, and clipped membranes."""
    stopped = np.zeros(len(inputs.events), np.bool_)
    try:
        packed, saturated = machine.packed(inputs.events, inputs.lengths)
    except NumericRangeError:  # by one recording at least: run them one by one
        netlist = machine.netlist
        steps = inputs.events.shape[2] + netlist.max_depth
        packed = np.zeros((len(inputs.events), steps, -(-netlist.n_compartments // 64)), np.uint64)
        saturated = np.zeros(len(inputs.events), np.int64)
        for index in range(len(inputs.events)):
            one = slice(index, index + 1)
            try:
                packed[one], saturated[one] = machine.packed(inputs.events[one], inputs.lengths[one])
            except NumericRangeError:
                stopped[index] = True
    return packed, stopped, saturated


def _tally(packed: Words, model: Words, masks: Words, depth: IntArray, inputs: Inputs) -> IntArray:
    """Spikes of the chip and those in which the float network differs, where steps count; (recordings, layers, 2)."""
    spikes = np.zeros((len(packed), len(masks), 2), np.int64)
    for layer, mask in enumerate(masks):
        words = np.flatnonzero(mask)
        chip = packed[..., words] & mask[words]
        differ = chip ^ (model[..., words] & mask[words])
        counts = _counts(inputs, packed.shape[1], depth[layer])
        for column, bits in enumerate((chip, differ)):
            ones = np.bitwise_count(bits).sum(axis=2, dtype=np.int64)
            spikes[:, layer, column] = np.where(counts, ones, 0).sum(axis=1)
    return spikes


def _votes(netlist: Netlist, packed: Words, depth: IntArray, inputs: Inputs) -> IntArray:
    """Votes of the chip where steps count; (recordings, classes)."""
    votes = np.zeros((len(packed), netlist.classes), np.int64)
    for voter in np.flatnonzero(netlist.readout_class >= 0).tolist():
        fires = (packed[..., voter // 64] >> np.uint64(voter % 64)) & np.uint64(1)
        counts = _counts(inputs, packed.shape[1], depth[netlist.layer[voter]])
        votes[:, netlist.readout_class[voter]] += np.where(counts, fires, 0).sum(axis=1).astype(np.int64)
    return votes


def _counts(inputs: Inputs, steps: int, lag: int) -> BoolArray:
    """Which chip steps of each recording count for a layer that lags so much; (recordings, steps)."""
    step = np.arange(steps)
    counts: BoolArray = (step >= inputs.begin[:, None] + lag) & (step < inputs.lengths[:, None] + lag)
    return counts


# -- perturbations -----------------------------------------------------------------------------------------------------

Events = npt.NDArray[np.uint8]

Level = int | float

TAXELS = "taxels"
"""Unit of levels of which a sensor has only so many."""

Obstacle = Callable[[Pair], str | None]


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One kind of trouble, its levels from mild to harsh, and which others make sense.

    Its function takes what it is done to, first: `events`, a `pair`, or a `bench` of which recordings follow each other
    in another way; then the level; then, if it needs them, `distance` between taxels, (taxels, taxels), and `rng`, a
    source of chance.
    """

    act: Callable[..., Any]
    unit: str
    levels: tuple[Level, ...]
    least: float
    most: float
    obstacle: Obstacle | None

    @property
    def name(self) -> str:
        """That of the function."""
        return self.act.__name__

    @property
    def what(self) -> str:
        """A line for people."""
        line = str(inspect.getdoc(self.act)).partition("\n")[0].removesuffix(".")
        return line[0].lower() + line[1:]

    @property
    def seeded(self) -> bool:
        """Whether chance has a part in it."""
        return "rng" in self._takes

    @property
    def to(self) -> str:
        """What it is done to: ``events``, ``pair`` or ``bench``."""
        return self._takes[0]

    @property
    def _takes(self) -> list[str]:
        return list(inspect.signature(self.act).parameters)

    def __call__(self, *arguments: Any) -> Any:
        """The function itself."""
        return self.act(*arguments)

    def done(self, to: Any, level: Any, distance: FloatArray, rng: np.random.Generator) -> Any:
        """What becomes of events, a pair or a bench."""
        known = {"distance": distance, "rng": rng}
        return self.act(to, level, *(known[name] for name in self._takes[2:]))

    def why_not(self, pair: Pair) -> str | None:
        """Why it makes no sense for a network, or None where it does."""
        return None if self.obstacle is None else self.obstacle(pair)

    def level_of(self, words: str) -> Level:
        """Read a level; refused if it is none that makes sense."""
        try:
            level = float(words)
        except ValueError:
            level = float("nan")
        whole = all(isinstance(each, int) for each in self.levels)
        if not self.least <= level <= self.most or (whole and level != int(level)):
            kind = "a whole number" if whole else "a number"
            limits = f"from {self.least:g}" + ("" if self.most == np.inf else f" to {self.most:g}")
            raise OptionError(f"{self.name}:{words}: {words!r} is no level of it; give {kind} {limits} ({self.unit})")
        return int(level) if level == int(level) else level

    def levels_of(self, taxels: int, *, full: bool, also: Sequence[Level] = ()) -> tuple[Level, ...]:
        """Levels to measure on a sensor of so many taxels, further ones among them; with `full` those between, too."""
        levels = list(self.levels)
        if full:
            between = [float(f"{(a + b) / 2:.2g}") for a, b in pairwise(levels)]
            levels += [int(level) for level in between] if isinstance(levels[0], int) else between
        if self.unit == TAXELS:
            levels = [level for level in levels if level <= taxels]
        return tuple(sorted({*levels, *also}, reverse=self.levels[0] > self.levels[-1]))


def perturbation(
    unit: str, levels: tuple[Level, ...], *, least: float = 0, most: float = 1, unless: Obstacle | None = None
) -> Callable[[Callable[..., Any]], Perturbation]:
    """Make a function a perturbation; the first line of its documentation is what people read of it.

    Levels are counted in `unit` and lie between `least` and `most`; `unless` says why it makes no sense for a network.
    """
    return partial(Perturbation, unit=unit, levels=levels, least=least, most=most, obstacle=unless)
