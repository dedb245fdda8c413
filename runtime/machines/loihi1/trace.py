"""What a simulation hands back: spikes, membranes, counts. Shared by both simulators; nobody else counts.

Chip steps run from 0 to ``T + netlist.drain - 1`` for a recording of ``T`` data steps. Compartments are in
the order of the netlist's ids. A batch of recordings adds one leading axis to every array.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import ACCUMULATOR_MAX, CURRENT_MAX
from spikeloom.compiler.types import AnyArray, BoolArray, IntArray
from spikeloom.runtime.machines import base

MembraneArray = npt.NDArray[np.int32]

REGISTER_LIMITS = {"synaptic sum": ACCUMULATOR_MAX, "current": CURRENT_MAX}
"""Registers that may not overflow, in the order in which a step fills them, and their largest magnitude."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Counts(base.Counts):
    """Events of a whole run; votes are spikes that count where a compartment votes: not those of blank steps."""

    inputs: IntArray  # (…, n_inputs) int64; input events per channel
    # (…, layers) int64; neuron updates: compartment-steps inside the layer's window in which the compartment
    # had work to do, that is its membrane or its current was not zero before the step, or an active axon
    # held a synapse to it (whatever the weight), or its bias is not zero
    updates: IntArray
    saturations: IntArray  # (…, layers) int64; compartment-steps whose membrane was clipped to its register


@dataclass(frozen=True, kw_only=True, eq=False)
class Charges:
    """What events add to some sums of each chip step: times, energies, anything that is linear in them."""

    sources: IntArray  # (n_inputs + compartments, sums) int64; by an event of each channel, a spike of each compartment
    updates: IntArray  # (compartments, sums) int64; by an update of each compartment

    @cached_property  # a recording takes a fraction of this
    def kinds(self) -> tuple[IntArray, npt.NDArray[np.uint64]]:
        """What an update may add (kinds, sums), each once, and the compartments of each kind at a bit each."""
        kinds, kind = np.unique(self.updates, axis=0, return_inverse=True)
        return kinds, pack(kind.reshape(-1) == np.arange(len(kinds))[:, None])


def side_by_side(parts: Sequence[Charges]) -> Charges:
    """Several charges as one: the sums of each after those before it."""
    sources, updates = ([getattr(part, name) for part in parts] for name in ("sources", "updates"))
    return Charges(sources=np.concatenate(sources, axis=1), updates=np.concatenate(updates, axis=1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace(base.Trace):
    """Result of a simulation.

    Membranes are what was compared with the threshold, before a spike resets it, in 1/64 of a weight unit;
    zero outside the window.
    """

    counts: Counts
    # the others are None unless wanted
    # (…, chip steps, compartments) bool; whether a compartment had work to do, as ``Counts.updates`` counts it
    updated: BoolArray | None = None
    charged: IntArray | None = None  # (…, chip steps, sums) int64; what events add up to under some charges
    # (…, chip steps, ceil(compartments / 64)) uint64; spike of compartment c at bit ``c % 64`` of word ``c
    # // 64``
    packed: npt.NDArray[np.uint64] | None = None


def pack(spikes: BoolArray) -> npt.NDArray[np.uint64]:
    """Spikes (…, compartments) at a bit each; the layout of ``Trace.packed``."""
    bits = np.zeros((*spikes.shape[:-1], -(-spikes.shape[-1] // 64) * 8), np.uint8)
    bits[..., : -(-spikes.shape[-1] // 8)] = np.packbits(spikes, axis=-1, bitorder="little")
    return bits.view("<u8").astype(np.uint64)


def unpack(packed: npt.NDArray[np.uint64], compartments: int) -> BoolArray:
    """Spikes (…, compartments) of ``Trace.packed``.

    >>> unpack(np.array([[5]], np.uint64), 4).tolist()
    [[True, False, True, False]]
    """
    flags = packed.astype("<u8").view(np.uint8)
    return np.unpackbits(flags, axis=-1, count=compartments, bitorder="little").view(np.bool_)


def aligned(netlist: Netlist, array: AnyArray, layer: int) -> AnyArray:
    """Cut one layer out of a trace and shift it back by its depth, as the float model counts time.

    `array` (…, chip steps, compartments) becomes (…, T, neurons), ordered by neuron; zero for those that the
    chip does not hold.
    """
    depth = netlist.layers[layer].depth
    length = array.shape[-2] - netlist.drain
    neurons = netlist.layers[layer].neurons
    ids = netlist.compartments_of(layer)
    place = np.zeros(neurons, np.int64)
    place[netlist.neuron[ids]] = ids
    part = np.empty((*array.shape[:-2], length, neurons), array.dtype)
    recordings = array.reshape(-1, *array.shape[-2:]), part.reshape(-1, length, neurons)
    for whole, cut in zip(*recordings, strict=True):
        # clipping changes no index here; without it numpy writes to a copy of `cut` first
        np.take(whole[depth : depth + length], place, axis=1, out=cut, mode="clip")
    part[..., np.setdiff1d(np.arange(neurons), netlist.neuron[ids])] = 0
    return part


def range_error(
    netlist: Netlist, register: str, compartment: int, chip_step: int, value: int
) -> NumericRangeError:
    """Error of a register that would overflow; `register` is a key of `REGISTER_LIMITS`."""
    layer = netlist.layers[netlist.layer[compartment]].name
    neuron = netlist.neuron[compartment]
    core = int(np.searchsorted(netlist.core_compartments, compartment, side="right")) - 1
    return NumericRangeError(
        f"{layer} neuron {neuron} on core {core}, chip step {chip_step}: {register} {value} found, "
        f"magnitudes up to {REGISTER_LIMITS[register]} allowed; compile with a smaller scale for {layer}"
    )
