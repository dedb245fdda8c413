"""Lay a netlist out for :mod:`runtime.block_kernel`, where that is proven to compute what the chip does."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from compiler.fixedpoint import DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT, IntArray
from compiler.netlist import Netlist, one_step_bounds
from runtime.block_kernel import LANES, Blocks
from runtime.trace import BoolArray

SUM_MAX = 2**15 - 1
"""Largest sum that the kernel holds."""

NO_MEMORY = 2**DECAY_BITS - 1
"""`decay_u` of a current that forgets everything in one step."""

SPARE = 2**23
"""Bytes that rows may take in any case; beyond that they may take ``BYTES_A_SYNAPSE``."""

BYTES_A_SYNAPSE = 32

DENSE = 0.5
"""Share of all pairs of block and source from which on every pair gets a row."""

NEVER = 2**31 - 1
"""Threshold of a position without a compartment."""


def _in_range(netlist: Netlist) -> bool:
    """Whether no input whatever brings a sum, a membrane or a product that the kernel cannot hold."""
    positive, negative = one_step_bounds(netlist)
    if max(int(positive.max(initial=0)), int(negative.max(initial=0))) > SUM_MAX:
        return False
    bias = netlist.bias_mantissa << netlist.bias_exponent
    keep = 2**DECAY_BITS - netlist.decay_v
    # a membrane is left at the threshold at most; below zero it loses as much as it can gain at the far end
    above = np.maximum(netlist.threshold << MEMBRANE_SHIFT, 0)
    gained = (negative << MEMBRANE_SHIFT) + np.maximum(-bias, 0)
    if np.any((keep == 2**DECAY_BITS) & (gained > 0)):
        return False
    below = (gained << DECAY_BITS) // np.maximum(2**DECAY_BITS - keep, 1) + 1
    highest = (above * keep >> DECAY_BITS) + (positive << MEMBRANE_SHIFT) + np.maximum(bias, 0)
    stored = np.maximum(above, below)
    return bool(np.all(highest <= MEMBRANE_MAX) and np.all(stored <= MEMBRANE_MAX) and np.all(stored * keep < 2**32))


def _is_pipeline(netlist: Netlist, source: IntArray, target: IntArray) -> bool:
    """Whether every layer hears the layers of the depth before it only, so that none has to wait for another."""
    depth = np.array([layer.depth for layer in netlist.layers])[netlist.layer]
    heard = np.append(np.full(netlist.n_inputs, -1), depth)[source]
    return bool(np.all(heard == depth[target] - 1))


def lay_out(netlist: Netlist) -> Blocks | None:
    """Make blocks of a netlist.

    Returns
    -------
    Blocks or None
        None where currents have a memory, a register could overflow or saturate, a layer hears others than the one
        before it, or synapses are so scattered that rows of 64 would waste memory.
    """
    axon = netlist.axon_of_synapse()
    source, target = netlist.axon_source[axon], netlist.synapse_compartment()
    if np.any(netlist.decay_u != NO_MEMORY) or not _is_pipeline(netlist, source, target) or not _in_range(netlist):
        return None

    # positions: by depth, layer and neuron; each layer begins a block, and so does another decay within
    depth = np.array([layer.depth for layer in netlist.layers])
    keep = 2**DECAY_BITS - netlist.decay_v
    order = np.lexsort((netlist.neuron, keep, netlist.layer, depth[netlist.layer]))
    groups = np.stack([netlist.layer, keep])[:, order]
    begins = np.flatnonzero(np.append(True, np.any(np.diff(groups) != 0, axis=0))) if len(order) else np.zeros(0, int)
    sizes = np.diff(np.append(begins, len(order)))
    blocks_of = -(-sizes // LANES)
    group = np.repeat(np.arange(len(sizes)), sizes)
    position = np.empty(len(order), np.int64)
    position[order] = (np.cumsum(blocks_of) - blocks_of)[group] * LANES + np.arange(len(order)) - begins[group]
    n_blocks = int(blocks_of.sum())
    layer = np.repeat(groups[0, begins], blocks_of)
    stage = np.searchsorted(depth[layer], np.arange(netlist.max_depth + 2))

    # rows: one for each block and each source that reaches it
    first_source = np.append(0, netlist.n_inputs + stage[:-1] * LANES)  # by depth
    number = np.append(np.arange(netlist.n_inputs), netlist.n_inputs + position)
    local = number[source] - first_source[depth[netlist.layer[target]]]
    block, lane = np.divmod(position[target], LANES)
    width = LANES * max(_words(netlist.n_inputs), n_blocks)
    pairs = block * width + local
    known = np.unique(pairs)
    rows_of = np.searchsorted(known, stage * width)
    heard = np.append(netlist.n_inputs, np.bincount(depth[netlist.layer], minlength=len(stage) - 1)[:-1])
    sources_of = np.append(netlist.n_inputs, np.diff(stage)[:-1] * LANES)
    dense = np.diff(rows_of) >= DENSE * np.diff(stage) * heard
    filled = [
        (np.arange(first, last)[:, None] * width + np.arange(sources)).ravel()
        for first, last, sources, full in zip(stage[:-1], stage[1:], sources_of, dense, strict=True)
        if full
    ]
    known = np.unique(np.concatenate([known, *filled]))
    row = np.searchsorted(known, pairs)
    if len(known) * LANES * 2 > SPARE + BYTES_A_SYNAPSE * netlist.n_synapses:
        return None
    weight = np.zeros(len(known) * LANES, np.int16)
    np.add.at(weight, row * LANES + lane, netlist.effective_weight().astype(np.int16))
    shift, narrow = _narrowed(weight, known // width, n_blocks)
    reached = np.zeros(len(known), np.uint64)
    np.bitwise_or.at(reached, row, _bit(lane))

    # links: the rows of a block by words of sources
    row_block, row_source = np.divmod(known, width)
    words = width // LANES
    links, first_row, link = np.unique(row_block * words + row_source // LANES, return_index=True, return_inverse=True)
    linked = np.zeros(len(links), np.uint64)
    np.bitwise_or.at(linked, link, _bit(row_source % LANES))

    bias, threshold = np.zeros(n_blocks * LANES, np.int32), np.full(n_blocks * LANES, NEVER, np.int32)
    bias[position] = netlist.bias_mantissa << netlist.bias_exponent
    threshold[position] = netlist.threshold << MEMBRANE_SHIFT
    compartment = np.full(n_blocks * LANES, -1)
    compartment[position] = np.arange(len(position))
    return Blocks(
        stage=stage,
        dense=dense,
        first=np.searchsorted(links // words, np.arange(n_blocks + 1)),
        word=links % words,
        linked=linked,
        row=first_row,
        weight=narrow,
        shift=shift + np.uint32(MEMBRANE_SHIFT),
        reached=reached,
        restful=_word((compartment >= 0) & (bias == 0)),
        held=_word(compartment >= 0),
        bias=bias,
        threshold=threshold,
        keep=np.repeat(groups[1, begins], blocks_of).astype(np.uint32),
        depth=depth[layer],
        layer=layer,
        compartment=compartment,
    )


def _narrowed(
    weight: npt.NDArray[np.int16], row_block: IntArray, n_blocks: int
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.int8 | np.int16]]:
    """Shift out the zeros that all weights of a block end with; eight bits for each if that is enough for all."""
    used = np.zeros(n_blocks, np.int64)
    np.bitwise_or.at(used, row_block, np.bitwise_or.reduce(weight.reshape(-1, LANES), axis=1))
    lowest = used & -used
    shift = np.where(used == 0, 0, np.log2(np.maximum(lowest, 1))).astype(np.uint32)
    shifted = weight.reshape(-1, LANES) >> shift[row_block][:, None].astype(np.int16)
    narrow = shifted.astype(np.int8)
    return shift, (narrow if np.array_equal(narrow, shifted) else shifted).reshape(-1)


def _words(bits: int) -> int:
    return -(-bits // LANES)


def _bit(lane: IntArray) -> npt.NDArray[np.uint64]:
    """Words with one bit set."""
    return np.left_shift(np.uint64(1), lane.astype(np.uint64))


def _word(flags: BoolArray) -> npt.NDArray[np.uint64]:
    """Words of 64 flags each."""
    return np.packbits(flags, bitorder="little").view("<u8").astype(np.uint64)
