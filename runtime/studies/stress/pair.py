"""A float network and the netlist beside it on the same recordings, compared spike by spike.

What is counted is what spikes after `begin`, so that recordings may follow others without a reset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from spikeloom.compiler import Netlist
from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.interpret import vote
from spikeloom.compiler.ir import Network
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.equivalence import float_engine
from spikeloom.runtime.machines.integer import IntegerMachine, integer_machine_of

Words = npt.NDArray[np.uint64]

SIDES = ("float", "chip")

STOPPED = -1
"""Decision where a register of the chip overflows and the simulator stops."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """A netlist and the float network beside it, of the same populations."""

    netlist: Netlist
    network: Network


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ready:
    """A pair, prepared to run; `masks` (layers, words) uint64 has the bits of a layer's compartments."""

    chip: IntegerMachine
    model: float_engine.FloatEngine
    masks: Words


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
    stopped: npt.NDArray[np.bool_]  # (recordings,) bool; where a register of the chip would overflow
    saturated: IntArray  # (recordings,) int64; membranes that were clipped

    def decisions(self, side: str) -> IntArray:
        """Class of each recording."""
        decided = vote(self.votes[side])
        return np.where(self.stopped, STOPPED, decided) if side == "chip" else decided


def ready(pair: Pair) -> Ready:
    """Prepare a pair for runs."""
    netlist = pair.netlist
    masks = np.zeros((len(netlist.layers), -(-netlist.n_compartments // 64)), np.uint64)
    ids = np.arange(netlist.n_compartments)
    np.bitwise_or.at(masks, (netlist.layer, ids // 64), np.left_shift(np.uint64(1), (ids % 64).astype(np.uint64)))
    return Ready(chip=integer_machine_of(netlist), model=float_engine.prepare(pair.network, netlist), masks=masks)


def evaluate(prepared: Ready, inputs: Inputs) -> Outcome:
    """Run both sides from rest."""
    netlist = prepared.chip.netlist
    model = float_engine.run(prepared.model, inputs.events, lengths=inputs.lengths, begin=inputs.begin)
    packed, stopped, saturated = _chip(prepared.chip, inputs)
    spikes = np.zeros((len(inputs.events), len(netlist.layers), 3), np.int64)
    votes = np.zeros((len(inputs.events), netlist.classes), np.int64)
    depth = np.array([layer.depth for layer in netlist.layers])
    voters = np.flatnonzero(netlist.readout_class >= 0)
    voting = voters, depth[netlist.layer[voters]], netlist.readout_class[voters]
    _tally(packed, model.packed, prepared.masks, depth, inputs.begin, inputs.lengths, *voting, spikes, votes)
    spikes[:, :, 0] = model.spikes
    spikes[:, :, 2] += model.elsewhere
    return Outcome(votes={"float": model.votes, "chip": votes}, spikes=spikes, stopped=stopped, saturated=saturated)


def _chip(machine: IntegerMachine, inputs: Inputs) -> tuple[Words, npt.NDArray[np.bool_], IntArray]:
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


@numba.njit(cache=True, nogil=True)
def _ones(word: Any) -> Any:
    """Bits of a word that are set."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@numba.njit(cache=True, nogil=True)
def _tally(
    chip: Any,
    model: Any,
    masks: Any,
    depth: Any,
    begin: Any,
    end: Any,
    voters: Any,
    lag: Any,
    label: Any,
    spikes: Any,
    votes: Any,
) -> None:
    """Count spikes of the chip and those that differ, (recordings, layers, 3), and its votes, where steps count."""
    for i in range(len(chip)):
        for layer in range(len(masks)):
            for word in range(masks.shape[1]):
                mask = masks[layer, word]
                if mask:
                    for t in range(begin[i] + depth[layer], end[i] + depth[layer]):
                        spikes[i, layer, 1] += _ones(chip[i, t, word] & mask)
                        spikes[i, layer, 2] += _ones((chip[i, t, word] ^ model[i, t, word]) & mask)
        for v in range(len(voters)):
            word, bit = voters[v] >> 6, np.uint64(voters[v] & 63)
            for t in range(begin[i] + lag[v], end[i] + lag[v]):
                votes[i, label[v]] += np.int64((chip[i, t, word] >> bit) & np.uint64(1))
