"""A netlist as changed runs read it, and the known run of a recording beside which they are held."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from spikeloom.compiler.layer_kernel import Synapses, by_source
from spikeloom.compiler.targets.loihi1.bounds import reach
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import (
    ACCUMULATOR_MAX,
    CURRENT_MAX,
    MEMBRANE_MAX,
    MEMBRANE_SHIFT,
)
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.bounds.arithmetic import LANES

AnyArray = npt.NDArray[Any]

NEVER = 2**31 - 1
"""Threshold of a place without a compartment."""


class Chip(NamedTuple):
    """A netlist as the kernel reads it: places of compartments by layer and neuron, in blocks; none is at some."""

    synapses: Synapses  # Of the input channels, then of each place
    layer: IntArray  # (blocks,) int64
    depth: IntArray  # (blocks,) int64
    outer: AnyArray  # (blocks,) bool; whose spikes come from channels alone
    ordered: bool  # Whether every spike reaches a later layer
    # keep_u, keep_v, threshold, bias, lowest: (places,) int32; decays in 1/4096, then membrane units; no
    # membrane is below the lowest
    keep_u: AnyArray
    keep_v: AnyArray
    threshold: AnyArray
    bias: AnyArray
    lowest: AnyArray
    label: AnyArray  # (places,) int32; class that a spike votes for, -1 for none


class Known(NamedTuple):
    """A run; of `steps` chip steps."""

    events: AnyArray  # (channels, T) uint8, 0 or 1
    sums: AnyArray  # (steps, places) int32; net synaptic sums
    # current, membrane: (steps + 1, places) int32; registers before each step, and after the last
    current: AnyArray
    membrane: AnyArray
    fired: AnyArray  # (steps, places) uint8


def overflows(netlist: Netlist) -> bool:
    """Whether some input could bring a sum or a current that its register does not hold."""
    reached = reach(netlist)
    return bool(np.any(reached.sums > ACCUMULATOR_MAX) or np.any(reached.current > CURRENT_MAX))


def chip_of(netlist: Netlist) -> Chip:
    """Lay a netlist out."""
    order = np.lexsort((netlist.neuron, netlist.layer))
    sizes = np.bincount(netlist.layer, minlength=len(netlist.layers))
    blocks = -(-sizes // LANES)
    shift = LANES * (np.cumsum(blocks) - blocks) - (np.cumsum(sizes) - sizes)
    place = order.argsort() + shift[netlist.layer]
    places = LANES * int(blocks.sum())
    source = np.append(np.arange(netlist.n_inputs), netlist.n_inputs + place)[netlist.axon_source]
    pairs = place[netlist.synapse_compartment()], source[netlist.axon_of_synapse()]
    weight = sparse.csr_array((netlist.effective_weight(), pairs), shape=(places, netlist.n_inputs + places))
    columns = {
        "keep_u": (netlist.keep_u, 0),
        "keep_v": (netlist.keep_v, 0),
        "threshold": (netlist.threshold << MEMBRANE_SHIFT, NEVER),
        "bias": (netlist.bias, 0),
        "lowest": (-np.minimum(reach(netlist).stored, MEMBRANE_MAX), 0),
        "label": (netlist.readout_class, -1),
    }
    laid = {name: np.full(places, missing, np.int32) for name, (_, missing) in columns.items()}
    for name, (values, _) in columns.items():
        laid[name][place] = values
    layer = np.repeat(np.arange(len(blocks)), blocks)
    depth = np.array([each.depth for each in netlist.layers])[layer]
    inner = netlist.axon_source[netlist.axon_of_synapse()] - netlist.n_inputs
    before = np.where(inner < 0, -1, netlist.layer[np.maximum(inner, 0)])
    after = netlist.layer[netlist.synapse_compartment()]
    ordered = bool(np.all(before < after))
    outer = ~np.isin(layer, after[before >= 0])
    return Chip(by_source([weight], np.int32), layer, depth, outer, ordered, **laid)
