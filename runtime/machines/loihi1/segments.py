"""Lay a netlist out for :mod:`loihi1.kernel`, the kernel of steps.

Compartments are renumbered by layer and neuron ("positions"), so that a layer is one contiguous range whatever its
cores. Where :func:`netlist.one_step_bounds` proves that neither accumulator nor current can overflow, nothing
is checked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import ACCUMULATOR_MAX, CURRENT_MAX, DECAY_BITS, MEMBRANE_SHIFT
from spikeloom.compiler.targets.loihi1.netlist import Netlist, one_step_bounds
from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.loihi1.kernel import Tables

BLOCK = 32
"""Segments of a row start and end at multiples of this many positions."""

MERGED_GAP = 1
"""Blocks without synapses that a segment spans rather than ends at."""


def padded(size: int) -> int:
    """Next multiple of a block."""
    return -(-size // BLOCK) * BLOCK


def _registers_hold(netlist: Netlist) -> bool:
    """Whether no input whatever can make an accumulator or a current overflow."""
    positive, negative = one_step_bounds(netlist)
    worst = np.maximum(positive, negative) << MEMBRANE_SHIFT
    # a current that loses lost/4096 a step and gains `worst` cannot climb beyond worst * 4096 / lost
    highest = (worst << DECAY_BITS) // (netlist.decay_u + 1)
    return bool(np.all(worst <= ACCUMULATOR_MAX) and np.all(highest <= CURRENT_MAX))


def _segments(source: IntArray, target: IntArray, n_sources: int) -> tuple[dict[str, IntArray], IntArray, int]:
    """Cut each source's targets into segments; geometry of the tables, entry of each synapse, entries in all."""
    blocks = int(target.max(initial=0)) // BLOCK + 1
    used = np.unique(source * blocks + target // BLOCK)
    of_source, block = np.divmod(used, blocks)
    begins = np.ones(len(used), np.bool_)
    begins[1:] = (np.diff(of_source) != 0) | (np.diff(block) > MERGED_GAP + 1)
    ends = np.append(begins[1:], True)[: len(used)]
    of_source, start, stop = of_source[begins], block[begins] * BLOCK, (block[ends] + 1) * BLOCK
    bounds = np.append(0, np.cumsum(stop - start))
    segment = np.searchsorted(of_source * blocks * BLOCK + start, source * blocks * BLOCK + target, side="right") - 1
    entry = bounds[segment] + target - start[segment]

    rows = np.searchsorted(of_source, np.arange(n_sources + 1))
    shapes: dict[bytes, int] = {}
    shape, first, members = np.zeros(n_sources, np.int64), [0], []
    for s, (begin, end) in enumerate(zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True)):
        known = len(shapes)
        shape[s] = shapes.setdefault(start[begin:end].tobytes() + stop[begin:end].tobytes(), known)
        if shape[s] == known:
            members.append(np.arange(begin, end))
            first.append(first[-1] + end - begin)
    member = np.concatenate(members)
    base = bounds[rows[:-1]]
    geometry = {
        "shape": shape,
        "base": base,
        "first": np.array(first),
        "start": start[member],
        "stop": stop[member],
        "offset": bounds[member] - base[of_source[member]],
    }
    return geometry, entry, int(bounds[-1])


def lay_out_segments(netlist: Netlist, *, checked: bool, gated: bool) -> tuple[Tables, npt.NDArray[Any] | None]:
    """Lay a netlist out for the kernel of steps."""
    n_inputs = netlist.n_inputs
    compartment = np.lexsort((netlist.neuron, netlist.layer))
    position = np.empty_like(compartment)
    position[compartment] = np.arange(len(compartment))

    source_id = np.append(np.arange(n_inputs), n_inputs + position)
    source = source_id[netlist.axon_source][netlist.axon_of_synapse()]
    target = position[netlist.synapse_compartment()]
    weight = netlist.effective_weight()
    geometry, entry, size = _segments(source, target, len(source_id))

    shift = int(np.bincount(target).max(initial=0)).bit_length()
    largest = int(np.maximum(*one_step_bounds(netlist)).max(initial=0))
    narrow = (largest + 1) << shift < 2**31
    checked = checked or not narrow or not _registers_hold(netlist)
    packed = np.zeros(size, np.int32 if narrow else np.int64)
    negative = np.zeros(size, packed.dtype) if checked else None
    if negative is None:
        np.add.at(packed, entry, (weight << shift) + 1)
    else:
        np.add.at(packed, entry, np.where(weight >= 0, (weight << shift) + 1, 0))
        np.add.at(negative, entry, np.where(weight < 0, (-weight << shift) + 1, 0))

    shared = np.stack([netlist.layer, netlist.decay_u, netlist.decay_v])[:, compartment]
    begins = np.append(True, np.any(np.diff(shared) != 0, axis=0))
    layer, decay_u, decay_v = np.ascontiguousarray(shared[:, begins])
    bias, threshold = np.zeros((2, padded(len(compartment))), np.int32)
    threshold[: len(compartment)] = (netlist.threshold << MEMBRANE_SHIFT)[compartment]
    bias[: len(compartment)] = (netlist.bias_mantissa << netlist.bias_exponent)[compartment]
    tables = Tables(
        **geometry,
        weight=packed,
        shift=np.int32(shift),
        run_start=np.append(np.flatnonzero(begins), len(compartment)),
        run_layer=layer,
        run_depth=np.array([part.depth if gated else 0 for part in netlist.layers])[layer],
        keep_u=(2**DECAY_BITS - 1 - decay_u).astype(np.int32),
        keep_v=(2**DECAY_BITS - decay_v).astype(np.int32),
        threshold=threshold,
        bias=bias,
        compartment=compartment,
    )
    return tables, negative
