"""What a simulation of crossbar cores hands back; shared by specification and engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import DataError
from spikeloom.compiler.targets.truenorth.netlist import CrossbarNetlist
from spikeloom.compiler.types import BoolArray, IntArray

MembraneArray = npt.NDArray[np.int32]
EventArray = npt.NDArray[np.uint8 | np.bool_]

MASK64 = (1 << 64) - 1
STEP_NEURON, STEP_TICK = 0x9E3779B97F4A7C15, 0xD1B54A32D192ED03
MIX_1, MIX_2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
"""Constants of the random numbers, see :func:`random_bits`."""


def random_bits(seed: int, neuron: int, tick: int, bits: int) -> int:
    """Random number of so many bits that a neuron draws in a tick, in plain integers.

    A finaliser of splitmix64 over seed, neuron and tick: the same whoever draws first. The chip's own generator is not
    public; no network that shall be exact should use it.

    Examples
    --------
    >>> random_bits(0, 5, 7, 0), random_bits(0, 5, 7, 8), random_bits(1, 5, 7, 8)
    (0, 211, 201)
    """
    if not bits:
        return 0
    x = (seed + (neuron + 1) * STEP_NEURON + (tick + 1) * STEP_TICK) & MASK64
    x = ((x ^ (x >> 30)) * MIX_1) & MASK64
    x = ((x ^ (x >> 27)) * MIX_2) & MASK64
    return (x ^ (x >> 31)) >> (64 - bits)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counts:
    """Events of whole runs; every array is int64, a batch adds one leading axis."""

    ticks: IntArray  # (…) int64; ticks that were run
    inputs: IntArray  # (…, n_inputs) int64; input events per channel
    spikes: IntArray  # (…, neurons) int64; spikes per neuron in all ticks
    # (…, neurons) int64; spikes per neuron in the ticks in which it votes; zero for neurons that do not
    votes: IntArray
    axons: IntArray  # (…, axons) int64; ticks in which an axon had a spike
    merged: IntArray  # (…) int64; spikes that reached an axon in a tick in which it had one already, and were lost
    # (…, neurons) int64; ticks in which the membrane left its register, or would have in some order of arrivals; it
    # saturates
    overflows: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Result of a simulation."""

    counts: Counts
    spikes: BoolArray | None  # (…, ticks, neurons) bool, or None; whether a neuron spiked in a tick; None unless wanted
    # (…, ticks, neurons) int32, or None; membranes at the end of each tick, after resets; None unless wanted. In a
    # batch a shorter recording is filled up with zeros after its last tick.
    membranes: MembraneArray | None


def differences(slow: Trace, fast: Trace) -> int:
    """Spikes, membranes, votes and spikes on axons that differ; `fast` is a batch of the one recording."""
    pairs = [(getattr(slow, name), getattr(fast, name)) for name in ("spikes", "membranes")]
    pairs += [(getattr(slow.counts, name), getattr(fast.counts, name)) for name in ("axons", "votes")]
    return sum(int(np.count_nonzero(one != batch[0])) for one, batch in pairs)


def check_channels(netlist: CrossbarNetlist, channels: int) -> None:
    """Raise DataError unless recordings of so many input channels fit the network."""
    if channels != netlist.n_inputs:
        raise DataError(
            f"recordings have {channels} input channels, the network has {netlist.n_inputs}; "
            "use recordings of its sensor"
        )
