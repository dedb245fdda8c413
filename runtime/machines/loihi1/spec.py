"""The definition: one chip step in plain Python integers, one neuron at a time, written to be read.

:mod:`loihi1.engine` is the fast twin and must agree with this module on every spike, membrane and count.

Time
----
A recording of ``T`` data steps takes ``T + max_depth`` chip steps. In chip step ``t`` an axon is active if its input
channel has an event in data step ``t``, or if its source compartment spiked in chip step ``t - 1``. A compartment of
a layer of depth ``d`` integrates in chip steps ``d … d + T - 1``: the steps in which the data that it sees is real.
Outside this window current and membrane are zero and it is silent; what arrives then is dropped. So no bias
integrates before data arrives and nothing leaks into the next recording. On silicon the management core does this
between two steps: it resets a layer when its window begins and again when it ends.

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

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.runtime.machines.loihi1.trace import Counts, Trace, check_channels, range_error

DECAY_ONE: int = 2**DECAY_BITS  # decay registers count in 1/4096
UNIT: int = 2**MEMBRANE_SHIFT  # a weight or a threshold of one, in membrane units


@dataclass(slots=True)
class Compartment:
    """Parameters and state of one neuron; `current` and `membrane` change from step to step."""

    layer: int
    depth: int
    decay_u: int
    decay_v: int
    threshold: int
    bias: int
    current: int = 0
    membrane: int = 0


class RegisterOverflowError(Exception):
    """A register that may not overflow would have to hold `value`."""

    def __init__(self, register: str, value: int) -> None:
        self.register = register
        self.value = value
        super().__init__(f"{register} {value}")


def decayed(value: int, lost: int) -> int:
    """Keep ``(4096 - lost) / 4096`` of a register, rounding toward zero.

    Examples
    --------
    >>> decayed(6, 3277), decayed(-6, 3277), decayed(-5, 3277)
    (1, -1, 0)
    """
    magnitude = abs(value) * (DECAY_ONE - lost) // DECAY_ONE
    return magnitude if value >= 0 else -magnitude


def compartment_step(neuron: Compartment, positive: int, negative: int) -> tuple[int, bool, bool]:
    """Let one neuron integrate for one chip step; its current and membrane are replaced.

    `positive` and `negative` are sums of the effective weights that arrived, as magnitudes. Returns the membrane before
    a reset, whether it crossed the threshold, and whether the register clipped it. Raises RegisterOverflowError if the
    synaptic sum or the current leaves its register.
    """
    # gather input
    if UNIT * positive > ACCUMULATOR_MAX:
        raise RegisterOverflowError("synaptic sum", UNIT * positive)
    if UNIT * negative > ACCUMULATOR_MAX:
        raise RegisterOverflowError("synaptic sum", -UNIT * negative)
    arrived = positive - negative

    # decay current: the chip loses (decay_u + 1) / 4096, so 4095 means no memory at all
    current = decayed(neuron.current, neuron.decay_u + 1)

    # add
    current += UNIT * arrived
    if abs(current) > CURRENT_MAX:
        raise RegisterOverflowError("current", current)

    # decay membrane: no offset here
    membrane = decayed(neuron.membrane, neuron.decay_v)

    # add bias
    membrane += current + neuron.bias

    # saturate
    compared = max(-MEMBRANE_MAX, min(MEMBRANE_MAX, membrane))
    saturated = compared != membrane

    # compare: strictly above
    spiked = compared > UNIT * neuron.threshold

    # reset: the membrane only
    neuron.current = current
    neuron.membrane = 0 if spiked else compared
    return compared, spiked, saturated


def read_compartments(netlist: Netlist) -> list[Compartment]:
    """Compartments of a netlist in the order of their ids, at rest."""
    return [
        Compartment(
            layer=layer,
            depth=netlist.layers[layer].depth,
            decay_u=int(netlist.decay_u[c]),
            decay_v=int(netlist.decay_v[c]),
            threshold=int(netlist.threshold[c]),
            bias=int(netlist.bias_mantissa[c]) * 2 ** int(netlist.bias_exponent[c]),
        )
        for c, layer in enumerate(netlist.layer.tolist())
    ]


def read_synapses(netlist: Netlist) -> list[list[tuple[int, int]]]:
    """Synapses of each axon as pairs of target compartment and effective weight, ``mantissa * 2**exponent``."""
    lists = []
    core_of_axon = netlist.core_of_axon().tolist()
    for axon, form in enumerate(netlist.axon_format.tolist()):
        first_on_core = int(netlist.core_compartments[core_of_axon[axon]])
        exponent = int(netlist.format_exponent[form])
        stored = slice(int(netlist.axon_synapses[axon]), int(netlist.axon_synapses[axon + 1]))
        targets = netlist.synapse_target[stored].tolist()
        mantissas = netlist.synapse_weight[stored].tolist()
        # at exponent -1 mantissas are even, so halving is exact
        weights = [mantissa // 2 if exponent == -1 else mantissa * 2**exponent for mantissa in mantissas]
        lists.append([(first_on_core + target, weight) for target, weight in zip(targets, weights, strict=True)])
    return lists


def simulate(netlist: Netlist, events: npt.NDArray[np.uint8 | np.bool_]) -> Trace:
    """Run one recording (n_inputs, T) through the chip; the trace has spikes, membranes and updates, no leading axis.

    Raises DataError if the recording has another number of input channels than the network, and NumericRangeError at
    the first register that would overflow: the lowest chip step, then the lowest compartment id, the synaptic sum
    before the current.
    """
    check_channels(netlist, events.shape[0])
    n_inputs, length = events.shape
    compartments = read_compartments(netlist)
    synapses = read_synapses(netlist)
    axons_of: list[list[int]] = [[] for _ in range(n_inputs + netlist.n_compartments)]
    for axon, source in enumerate(netlist.axon_source.tolist()):
        axons_of[source].append(axon)

    chip_steps = length + netlist.max_depth
    spikes = np.zeros((chip_steps, len(compartments)), np.bool_)
    membranes = np.zeros((chip_steps, len(compartments)), np.int32)
    updated = np.zeros((chip_steps, len(compartments)), np.bool_)
    inputs = [0] * n_inputs
    spike_counts = [0] * len(compartments)
    updates = [0] * len(netlist.layers)
    saturations = [0] * len(netlist.layers)

    spiked_before: list[int] = []
    for t in range(chip_steps):
        # active sources: channels with an event now, compartments that spiked one step ago
        channels = np.flatnonzero(events[:, t]).tolist() if t < length else []
        for channel in channels:
            inputs[channel] += 1
        sources = channels + [n_inputs + c for c in spiked_before]

        # deliver their synapses
        positive = [0] * len(compartments)
        negative = [0] * len(compartments)
        reached = [False] * len(compartments)
        for source in sources:
            for axon in axons_of[source]:
                for c, weight in synapses[axon]:
                    reached[c] = True
                    if weight > 0:
                        positive[c] += weight
                    else:
                        negative[c] -= weight

        # let every neuron whose window is open integrate
        spiked_now = []
        for c, neuron in enumerate(compartments):
            if not neuron.depth <= t < neuron.depth + length:
                neuron.current = neuron.membrane = 0
                continue
            worked = neuron.membrane != 0 or neuron.current != 0 or reached[c] or neuron.bias != 0
            try:
                compared, spiked, saturated = compartment_step(neuron, positive[c], negative[c])
            except RegisterOverflowError as overflow:
                raise range_error(netlist, overflow.register, c, t, overflow.value) from None

            # count
            membranes[t, c] = compared
            if spiked:
                spikes[t, c] = True
                spike_counts[c] += 1
                spiked_now.append(c)
            updated[t, c] = worked
            updates[neuron.layer] += worked
            saturations[neuron.layer] += saturated
        spiked_before = spiked_now

    counts = Counts(
        inputs=np.array(inputs, np.int64),
        spikes=np.array(spike_counts, np.int64),
        updates=np.array(updates, np.int64),
        saturations=np.array(saturations, np.int64),
    )
    return Trace(counts=counts, spikes=spikes, membranes=membranes, updated=updated)
