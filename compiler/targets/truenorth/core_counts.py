"""How many crossbar cores a layer takes, in each of the ways in which it could be laid out.

A neuron whose weights shall have ``2**m`` levels needs each of its inputs on ``m`` axons of different types: its
weights for them, added up over any subset, are its levels. So ``256 / m`` inputs fit a core.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.ir import Sparse
from spikeloom.compiler.targets.base import Target
from spikeloom.compiler.targets.truenorth.codebook import EMPTYING, gate_axons


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """A layer whose inputs are cut in groups, and whose partial sums travel as numbers of spikes within a data step.

    Parameters
    ----------
    groups : int
        Groups of inputs.
    inputs : int
        Of a group, at most.
    partial_cores : int
        Of the neurons that add up a group, two for each neuron of the layer: for sums above zero and below.
    sum_cores : int
        Of the neurons that add up what those send, with an axon for each of them, and clocks, see
        :mod:`truenorth.in_time`.
    """

    groups: int
    inputs: int
    partial_cores: int
    sum_cores: int

    @property
    def cores(self) -> int:
        """All of them."""
        return self.partial_cores + self.sum_cores


def packed(weight: Sparse, copies: int, chip: Target) -> int | None:
    """Cores of a layer whose neurons hear all inputs on their own core, filled one after the other in their order.

    Parameters
    ----------
    weight : csr_array (neurons, inputs)
        Its stored entries are the synapses.
    copies : int
        Axons of each input.
    chip : Target

    Returns
    -------
    int or None
        None if a neuron has more inputs than fit a core.
    """
    axons, neurons = chip.limit("core.axons"), chip.limit("core.neurons")
    if int(np.diff(weight.indptr).max(initial=0)) * copies > axons:
        return None
    cores, held, heard = 1, 0, np.zeros(weight.shape[1], np.bool_)
    for row in range(weight.shape[0]):
        own = weight.indices[weight.indptr[row] : weight.indptr[row + 1]]
        more = np.count_nonzero(~heard[own])
        if held == neurons or (np.count_nonzero(heard) + more) * copies > axons:
            cores, held, heard = cores + 1, 0, np.zeros(weight.shape[1], np.bool_)
        heard[own] = True
        held += 1
    return cores


def split(inputs: int, neurons: int, copies: int, chip: Target) -> Split | None:
    """Cores of a layer of `neurons` that hear so many inputs, more than fit a core; None if the groups do not either.

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import CROSSBARS, load_target
    >>> split(2496, 128, 2, load_target("truenorth", CROSSBARS))
    Split(groups=20, inputs=126, partial_cores=20, sum_cores=22)
    """
    axons, held = chip.limit("core.axons"), chip.limit("core.neurons")
    most = (axons - EMPTYING) // copies
    groups = -(-inputs // most)
    a_core = min((axons - sum(gate_axons(groups))) // (2 * groups), held)
    if a_core < 1:
        return None
    return Split(
        groups=groups, inputs=most, partial_cores=groups * -(-2 * neurons // held), sum_cores=-(-neurons // a_core)
    )


def relays(neurons: int, targets: int, chip: Target) -> int | None:
    """Cores of relays that lead the spikes of each of so many neurons to so many axons.

    Examples
    --------
    >>> from spikeloom.compiler.targets.base import CROSSBARS, load_target
    >>> relays(2496, 2, load_target("truenorth", CROSSBARS))
    20
    """
    a_core = chip.limit("core.neurons") // targets
    return -(-neurons // a_core) if a_core else None
