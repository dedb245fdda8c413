"""A float network and the netlist beside it on the same recordings, compared spike by spike; and what perturbs them.

What is counted is what spikes after `begin`, so that recordings may follow others without a reset.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np

from spikeloom.compiler import Netlist
from spikeloom.compiler.errors import NumericRangeError, OptionError
from spikeloom.compiler.interpret import Simulation, cut, float_simulation, vote
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.types import BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.capabilities import Threaded, require_threaded
from spikeloom.runtime.machines.votes import readout_counts

Events = EventArray

SIDES = ("float", "chip")

STOPPED = -1
"""Decision where a register of the chip overflows and the simulator stops."""

HELD = 1 << 23
"""Entries (recording, step, neuron) that run together."""

LONG = 1 << 25
"""Entries of a recording that runs alone: its spikes may take some hundred megabytes."""

_ALONE = Lock()


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """A netlist and the float network beside it, of the same populations; prepared when it first runs."""

    netlist: Netlist
    network: Network

    @cached_property
    def chip(self) -> Threaded:
        """The netlist, ready to run."""
        return require_threaded(machine_of(self.netlist))

    @cached_property
    def model(self) -> Simulation:
        """The float network, likewise; in float32."""
        return float_simulation(self.network, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inputs:
    """What recordings become: steps of each and the first that counts, (recordings,); and their channels.

    `channels` makes those of some recordings, (recordings, channels, T) uint8, when these run.
    """

    channels: Callable[[slice], Events]
    lengths: IntArray
    begin: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """What both sides did."""

    votes: dict[str, IntArray]  # By side
    spikes: IntArray  # (layers, 3) int64; of the float network, of the chip, and those in which they differ
    stopped: BoolArray  # (recordings,) bool; where a register of the chip would overflow
    saturated: IntArray  # (recordings,) int64; membranes that were clipped

    def decisions(self, side: str) -> IntArray:
        """Class of each recording."""
        decided = vote(self.votes[side])
        return np.where(self.stopped, STOPPED, decided) if side == "chip" else decided


def evaluate(pair: Pair, inputs: Inputs) -> Outcome:
    """Run both sides from rest, so many recordings at a time that memory does not grow with their number."""
    held = int(inputs.lengths.max()) * pair.netlist.n_compartments
    size, parts = max(1, HELD // held), []
    for first in range(0, len(inputs.lengths), size):
        with _ALONE if held > LONG else nullcontext():
            parts += _part(pair, inputs, slice(first, min(first + size, len(inputs.lengths))))
    return Outcome(
        votes={side: np.concatenate([part.votes[side] for part in parts]) for side in SIDES},
        spikes=np.sum([part.spikes for part in parts], axis=0),
        stopped=np.concatenate([part.stopped for part in parts]),
        saturated=np.concatenate([part.saturated for part in parts]),
    )


def _part(pair: Pair, inputs: Inputs, rows: slice) -> list[Outcome]:
    """Some recordings together, or one by one if the simulator stops."""
    netlist, readout, events = pair.netlist, pair.network.readout, inputs.channels(rows)
    lengths, begin = inputs.lengths[rows], inputs.begin[rows]
    stopped, first = np.zeros(len(events), np.bool_), int(begin.min())
    try:
        chip, saturated = pair.chip.on_a_thread(events, lengths, first)
    except NumericRangeError:
        if len(events) > 1:
            return [each for i in range(rows.start, rows.stop) for each in _part(pair, inputs, slice(i, i + 1))]
        chip = [np.zeros((1, events.shape[2] - first, layer.neurons), np.bool_) for layer in netlist.layers]
        stopped[:], saturated = True, np.zeros(1, np.int64)
    spikes, votes, compared = np.zeros((len(netlist.layers), 3), np.int64), {}, pair.chip.compared()
    step = np.arange(first, events.shape[2])
    counts = ((step >= begin[:, None]) & (step < lengths[:, None]))[:, :, None]
    for index, (fired, chip_fired) in enumerate(zip(float_layers(pair, events, lengths), chip, strict=True)):
        ours, theirs = fired[:, first:] & counts, chip_fired & counts
        if index == readout.population:
            sides = zip(SIDES, (ours, theirs), strict=True)
            votes = {side: readout_counts(readout, netlist.classes, spiked) for side, spiked in sides}
        left, right = ours[..., compared[index]], theirs[..., compared[index]]
        spikes[index] = np.count_nonzero(left), np.count_nonzero(right), np.count_nonzero(left != right)
    return [Outcome(votes=votes, spikes=spikes, stopped=stopped, saturated=saturated)]


def float_layers(pair: Pair, events: Events, lengths: IntArray) -> Iterator[BoolArray]:
    """Spikes of the float network, layer by layer, (recordings, T, neurons)."""
    ends = None if (lengths == events.shape[2]).all() else lengths
    depth = {INPUT: -1} | {index: layer.depth for index, layer in enumerate(pair.netlist.layers)}
    sent = {INPUT: cut(events.transpose(0, 2, 1) != 0, ends)}
    for index, layer in enumerate(pair.model.layers):
        # a window that opens later than it has to misses the first steps
        sources = [_from(sent[pre], depth[index] - depth[pre] - 1) for pre in layer.pres]
        sent[index] = cut(layer.run(sources)[0], ends)
        yield sent[index]


def _from(spikes: BoolArray, step: int) -> BoolArray:
    """Spikes (recordings, T, neurons) without the first steps, silence at the end."""
    if not step:
        return spikes
    moved = np.zeros_like(spikes)
    moved[:, :-step] = spikes[:, step:]
    return moved


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

    def levels_of(self, taxels: int, also: Sequence[Level] = ()) -> tuple[Level, ...]:
        """Levels to measure on a sensor of so many taxels, further ones among them."""
        levels = [level for level in self.levels if self.unit != TAXELS or level <= taxels]
        return tuple(sorted({*levels, *also}, reverse=self.levels[0] > self.levels[-1]))


def perturbation(
    unit: str, levels: tuple[Level, ...], *, least: float = 0, most: float = 1, unless: Obstacle | None = None
) -> Callable[[Callable[..., Any]], Perturbation]:
    """Make a function a perturbation; the first line of its documentation is what people read of it.

    Levels are counted in `unit` and lie between `least` and `most`; `unless` says why it makes no sense for a network.
    """
    return partial(Perturbation, unit=unit, levels=levels, least=least, most=most, obstacle=unless)
