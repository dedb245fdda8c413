"""What a chip that nobody resets still knows after blank steps: bounds on its registers, without input.

At first nothing is known but what no register exceeds. Each compartment has a least and a largest current
and membrane; a spike is sure, impossible or open, and open spikes widen the sums that they reach. Decay is
monotone, so bounds stay bounds, and from step to step they only narrow. Where they meet, the state is the
same whatever came before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.loihi1.netlist import MOST_BLANK, Netlist
from spikeloom.compiler.targets.loihi1.registers import CURRENT_MAX, DECAY_ONE, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.types import IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Forgotten:
    """Blank steps after which nothing more is forgotten, and what depends on the past even then.

    `restless` compartments may fire without input, and when they do is left; it moves those that they reach.
    Registers of `unsettled` others may differ, by up to the share `residue` of their threshold.
    """

    steps: int
    restless: int
    unsettled: int
    residue: float

    @property
    def text(self) -> str:
        """Steps and what they leave, in a line."""
        left = [f"{self.restless:,} neurons may fire without input"] * (self.restless > 0)
        left += [f"{self.unsettled:,} others keep up to {self.residue:.2%} of θ"] * (self.unsettled > 0)
        return f"{self.steps} blank steps after each recording clear {'all but: ' + '; '.join(left) if left else 'it'}"


def forgotten(netlist: Netlist) -> Forgotten:
    """Bound a netlist's registers step by step; OptionError if some never decay, or take too long."""
    from spikeloom.compiler.targets.loihi1.bounds import reach

    n = netlist.n_compartments
    sent = netlist.axon_source[netlist.axon_of_synapse()] - netlist.n_inputs
    inner = sent >= 0
    weight = netlist.effective_weight() << MEMBRANE_SHIFT
    pairs = netlist.synapse_compartment()[inner], sent[inner]
    less, more = (
        sparse.csr_array((part(weight[inner], 0), pairs), shape=(n, n)) for part in (np.minimum, np.maximum)
    )
    reached = reach(netlist)
    threshold = netlist.threshold << MEMBRANE_SHIFT
    most = np.minimum(reached.current, CURRENT_MAX)
    bias = netlist.bias
    current = np.stack([-most, most])
    ends = np.minimum(reached.stored, MEMBRANE_MAX)
    membrane = np.stack([-ends, threshold])
    spikes = np.repeat([[False], [True]], n, axis=1)
    for step in range(MOST_BLANK + 1):
        before = current, membrane, spikes
        sure, may = spikes.astype(np.int64)
        sums = np.stack([more @ sure + less @ may, less @ sure + more @ may])
        current = np.clip(_kept(current, netlist.decay_u + 1) + sums, -most, most)
        membrane = np.clip(_kept(membrane, netlist.decay_v) + current + bias, -MEMBRANE_MAX, MEMBRANE_MAX)
        spikes = membrane > threshold
        reset = np.stack(
            [np.minimum(membrane[0], 0), threshold]
        )  # what it may have left where its spike is open
        membrane = np.where(spikes[0], 0, np.where(spikes[1], reset, membrane))
        if step == MOST_BLANK or all(map(np.array_equal, before, (current, membrane, spikes))):
            break
    if step == MOST_BLANK or not netlist.decay_v.all():
        raise OptionError(
            f"--free-running: some membranes do not decay, or not in {MOST_BLANK} blank steps; omit it"
        )
    restless = spikes[0] != spikes[1]
    stirred = restless | ((more - less) @ restless.astype(np.int64) > 0)
    apart = np.ptp(membrane, axis=0) + np.ptp(_kept(current, netlist.decay_u + 1), axis=0)
    left = np.where(stirred, 0, apart / np.maximum(threshold, 1))
    return Forgotten(
        steps=max(step, netlist.max_depth, 1),
        restless=int(restless.sum()),
        unsettled=int(np.count_nonzero(left)),
        residue=float(left.max()),
    )


def _kept(value: IntArray, lost: IntArray) -> IntArray:
    """Registers (2, compartments) after a step's decay, rounded toward zero."""
    from spikeloom.compiler.layer_kernel import decay

    after = value.copy()
    decay(after, DECAY_ONE - lost)
    return after
