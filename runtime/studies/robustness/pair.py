"""A float network and the netlist beside it on the same recordings, compared spike by spike.

What is counted is what spikes after `begin`, so that recordings may follow others without a reset.
"""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import numpy as np

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.interpret import Simulation, cut, float_simulation, vote
from spikeloom.compiler.ir import INPUT, Network
from spikeloom.compiler.targets.compartments import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines.backends import machine_of
from spikeloom.runtime.machines.capabilities import Damageable, Memory, Threaded
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

    def __getstate__(self) -> dict[str, object]:
        """Without what is prepared, which a worker prepares itself."""
        return {"netlist": self.netlist, "network": self.network}

    @cached_property
    def chip(self) -> Threaded:
        """The netlist, ready to run."""
        return Threaded.required(machine_of(self.netlist))

    @cached_property
    def memory(self) -> Memory | None:
        """What can be damaged of both; None where nothing is known of what the chip stores."""
        return self.chip.memory(self.network) if isinstance(self.chip, Damageable) else None

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
    entries = int(inputs.lengths.max()) * pair.netlist.n_compartments
    size = max(1, HELD // entries)
    parts: list[Outcome] = []
    for first in range(0, len(inputs.lengths), size):
        with _ALONE if entries > LONG else nullcontext():
            parts += _part(pair, inputs, slice(first, min(first + size, len(inputs.lengths))))
    return Outcome(
        votes={side: np.concatenate([part.votes[side] for part in parts]) for side in SIDES},
        spikes=np.sum([part.spikes for part in parts], axis=0),
        stopped=np.concatenate([part.stopped for part in parts]),
        saturated=np.concatenate([part.saturated for part in parts]),
    )


def _part(pair: Pair, inputs: Inputs, rows: slice) -> list[Outcome]:
    """Some recordings together, or one by one if the simulator stops."""
    netlist = pair.netlist
    readout = pair.network.readout
    events = inputs.channels(rows)
    lengths = inputs.lengths[rows]
    begin = inputs.begin[rows]
    stopped = np.zeros(len(events), np.bool_)
    first = int(begin.min())
    try:
        chip, saturated = pair.chip.on_a_thread(events, lengths, first)
    except NumericRangeError:
        if len(events) > 1:
            singly = (slice(row, row + 1) for row in range(rows.start, rows.stop))
            return [each for one in singly for each in _part(pair, inputs, one)]
        chip = [np.zeros((1, events.shape[2] - first, layer.neurons), np.bool_) for layer in netlist.layers]
        stopped[:] = True
        saturated = np.zeros(1, np.int64)
    spikes = np.zeros((len(netlist.layers), 3), np.int64)
    votes = {}
    compared = pair.chip.compared()
    step = np.arange(first, events.shape[2])
    counts = ((step >= begin[:, None]) & (step < lengths[:, None]))[:, :, None]
    for index, (fired, chip_fired) in enumerate(zip(float_layers(pair, events, lengths), chip, strict=True)):
        ours = fired[:, first:] & counts
        theirs = chip_fired & counts
        if index == readout.population:
            sides = zip(SIDES, (ours, theirs), strict=True)
            votes = {side: readout_counts(readout, netlist.classes, spiked) for side, spiked in sides}
        left = ours[..., compared[index]]
        right = theirs[..., compared[index]]
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
