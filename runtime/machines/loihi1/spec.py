"""The definition: one chip step after another, all neurons in 64-bit integers, written to be read.

:mod:`loihi1.engine` is the fast twin and must agree with this module on every spike, membrane and count. So must
what calls :func:`layer_kernel.decayed` (fine-tuning, changed runs, the network before it is placed), and the exported
ONNX graph.

Time
----
A recording of ``T`` data steps takes ``T + max_depth`` chip steps. In chip step ``t`` an axon is active if its input
channel has an event in data step ``t``, or if its source compartment spiked in chip step ``t - 1``. A compartment of
a layer of depth ``d`` integrates in chip steps ``d … d + T - 1``: the steps in which the data that it sees is real.
Outside this window current and membrane are zero and it is silent; what arrives then is dropped. So no bias
integrates before data arrives and nothing leaks into the next recording. On silicon the management core does this
between two steps: it resets a layer when its window begins and again when it ends.

Nobody resets a free-running chip. All its layers always integrate, ``blank`` steps without input follow the
``T`` of a recording, and as many come before the first one. Votes are counted until the last data step has
come through, in chip steps ``0 … T + max_depth - 1``. So this module takes several recordings in a row,
blank steps between them, as one.

Registers
---------
A membrane counts 1/64 of a weight unit: weights and thresholds are shifted left by six, biases are not. Positive and
negative weights of a step are summed apart, for the order in which spikes arrive is not defined and neither is what
the silicon does when its accumulator overflows: a network whose sums would leave the register in *some* order is
stopped. The same goes for the current register. The membrane register saturates.

References
----------
.. [1] M. Davies et al., "Loihi: A Neuromorphic Manycore Processor with On-Chip Learning", IEEE Micro 38(1), 2018.
.. [2] lava, ``proc/lif/models.py``; nengo-loihi, ``emulator/interface.py``: the same integer rule in two emulators.
"""

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    DECAY_BITS,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
)
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.machines.base import require_channels
from spikeloom.runtime.machines.loihi1.trace import Counts, Trace, range_error

DECAY_ONE: int = 2**DECAY_BITS  # decay registers count in 1/4096
UNIT: int = 2**MEMBRANE_SHIFT  # a weight or a threshold of one, in membrane units


def decayed(value: IntArray, lost: IntArray | int) -> IntArray:
    """Keep ``(4096 - lost) / 4096`` of registers, rounding toward zero.

    >>> decayed(np.array([6, -6, -5]), 3277).tolist()
    [1, -1, 0]
    """
    kept = np.abs(value) * (DECAY_ONE - lost) // DECAY_ONE
    signed: IntArray = (np.sign(value) * kept).astype(np.int64)
    return signed


def read_synapses(netlist: Netlist) -> list[tuple[IntArray, IntArray]]:
    """Targets and effective weights, ``mantissa * 2**exponent``, of the axons of each source, planes one by one."""
    of_source: list[list[tuple[IntArray, IntArray]]] = [
        [] for _ in range(netlist.n_inputs + netlist.n_compartments)
    ]
    core_of_axon = netlist.core_of_axon()
    for axon, (source, form) in enumerate(zip(netlist.axon_source, netlist.axon_format, strict=True)):
        first_on_core = netlist.core_compartments[core_of_axon[axon]]
        exponent = int(netlist.format_exponent[form])
        stored = slice(netlist.axon_synapses[axon], netlist.axon_synapses[axon + 1])
        mantissa = netlist.synapse_weight[stored].astype(np.int64)
        # at exponent -1 mantissas are even, so halving is exact
        weight: IntArray = mantissa // 2 if exponent == -1 else mantissa << exponent
        of_source[source].append((first_on_core + netlist.synapse_target[stored].astype(np.int64), weight))
    return [_joined(axons) for axons in of_source]


def _joined(lists: list[tuple[IntArray, IntArray]]) -> tuple[IntArray, IntArray]:
    """One after another; none is allowed."""
    none = np.zeros(0, np.int64)
    target, weight = zip((none, none), *lists, strict=True)
    return np.concatenate(target), np.concatenate(weight)


def simulate(netlist: Netlist, events: npt.NDArray[np.uint8 | np.bool_]) -> Trace:
    """Run one recording (n_inputs, T) through the chip; the trace has spikes, membranes and updates, no leading axis.

    Raises DataError if the recording has another number of input channels than the network, and
    NumericRangeError at the first register that would overflow: the lowest chip step, then the lowest
    compartment id, the synaptic sum before the current.
    """
    require_channels(netlist, events.shape[0])
    n_inputs, length = events.shape
    neurons = netlist.n_compartments
    chip_steps = length + netlist.drain
    synapses = read_synapses(netlist)
    begin = netlist.begins[netlist.layer]
    end = begin + length if not netlist.blank else chip_steps
    threshold = UNIT * netlist.threshold
    bias = netlist.bias_mantissa * 2**netlist.bias_exponent

    spikes, updated = np.zeros((2, chip_steps, neurons), np.bool_)
    membranes = np.zeros((chip_steps, neurons), np.int32)
    saturated = np.zeros((chip_steps, neurons), np.bool_)
    current, membrane = np.zeros((2, neurons), np.int64)
    fired: list[int] = []
    for t in range(-netlist.blank, chip_steps):  # what is kept of steps before 0 the last ones overwrite
        # active sources: channels with an event now, compartments that spiked one step ago
        channels = np.flatnonzero(events[:, t]).tolist() if 0 <= t < length else []

        # gather input: positive and negative weights apart
        target, weight = _joined([synapses[source] for source in (*channels, *fired)])
        positive, negative = np.zeros((2, neurons), np.int64)
        np.add.at(positive, target, np.maximum(weight, 0))
        np.add.at(negative, target, np.maximum(-weight, 0))

        # only neurons whose window is open integrate
        window = (begin <= t) & (t < end)
        worked = (membrane != 0) | (current != 0) | (bias != 0)
        worked[target] = True

        # decay current: the chip loses (decay_u + 1) / 4096, so 4095 means no memory at all; add input
        current = decayed(current, netlist.decay_u + 1) + UNIT * (positive - negative)
        _require_range(netlist, t, window, positive, negative, current)

        # decay membrane: no offset here; add current and bias; saturate
        wanted = decayed(membrane, netlist.decay_v) + current + bias
        membrane = np.clip(wanted, -MEMBRANE_MAX, MEMBRANE_MAX)
        current[~window] = membrane[~window] = 0

        # compare: strictly above
        spikes[t] = window & (membrane > threshold)
        membranes[t] = membrane
        updated[t] = window & worked
        saturated[t] = window & (membrane != wanted)

        # reset: the membrane only
        membrane[spikes[t]] = 0
        fired = (n_inputs + np.flatnonzero(spikes[t])).tolist()

    counts = _counts(netlist, events, spikes, updated, saturated)
    return Trace(counts=counts, spikes=spikes, membranes=membranes, updated=updated)


def _counts(
    netlist: Netlist,
    events: npt.NDArray[np.uint8 | np.bool_],
    spikes: BoolArray,
    updated: BoolArray,
    saturated: BoolArray,
) -> Counts:
    """How often everything happened in a recording."""
    layers = len(netlist.layers)
    window = events.shape[1] + netlist.max_depth
    return Counts(
        inputs=np.count_nonzero(events, axis=1),
        spikes=np.count_nonzero(spikes, axis=0),
        votes=np.count_nonzero(spikes[:window], axis=0),
        updates=np.bincount(netlist.layer, np.count_nonzero(updated, axis=0), layers).astype(np.int64),
        saturations=np.bincount(netlist.layer, np.count_nonzero(saturated, axis=0), layers).astype(np.int64),
    )


def _require_range(
    netlist: Netlist, t: int, window: BoolArray, positive: IntArray, negative: IntArray, current: IntArray
) -> None:
    """Refuse registers that may not overflow."""
    sums = np.where(UNIT * positive > ACCUMULATOR_MAX, positive, -negative) * UNIT
    for over in np.flatnonzero(
        window & ((np.abs(sums) > ACCUMULATOR_MAX) | (np.abs(current) > CURRENT_MAX))
    )[:1]:
        if abs(sums[over]) > ACCUMULATOR_MAX:
            raise range_error(netlist, "synaptic sum", over, t, sums[over])
        raise range_error(netlist, "current", over, t, current[over])
