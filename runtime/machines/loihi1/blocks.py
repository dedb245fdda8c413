"""Lay a netlist out for :mod:`loihi1.block_kernel`, where that is proven to compute what the chip does."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.targets.loihi1.bounds import reach
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.targets.loihi1.registers import CURRENT_MAX, DECAY_BITS, MEMBRANE_MAX, MEMBRANE_SHIFT
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.machines.loihi1.block_kernel import LANES, Blocks

SUM_MAX = 2**15 - 1
"""Largest sum that the kernel holds."""

SPARE = 2**23
"""Bytes that rows may take in any case; beyond that they may take ``BYTES_A_SYNAPSE``."""

BYTES_A_SYNAPSE = 32

DENSE = 0.5
"""Share of all pairs of block and source from which on every pair gets a row."""

NEVER = 2**31 - 1
"""Threshold of a position without a compartment."""


def _in_range(netlist: Netlist) -> bool:
    """Whether no input whatever brings a sum, a membrane or a product that the kernel cannot hold."""
    reached = reach(netlist)
    lasts = netlist.decay_u + 1 != 2**DECAY_BITS
    product = reached.stored * netlist.keep_v
    return bool(
        np.all(reached.sums <= SUM_MAX << MEMBRANE_SHIFT)
        and np.all(reached.current <= CURRENT_MAX)
        and np.all(np.maximum(reached.highest, reached.stored) <= MEMBRANE_MAX)
        and np.all((product < 2**32) | lasts)  # beside a lasting current products are taken in two parts
    )


def _refusal(netlist: Netlist) -> str | None:
    """Why a netlist has no blocks."""
    if netlist.blank:
        return "no layer has a window"
    depth = np.array([layer.depth for layer in netlist.layers])[netlist.layer]
    sent = np.append(np.full(netlist.n_inputs, -1), depth)
    for source, compartment, _ in map(netlist.synapses_of, range(netlist.n_cores)):
        if np.any(sent[source] != depth[compartment] - 1):  # else no layer has to wait for another
            return "a layer is recurrent or receives from others than the one before it"
    if not _in_range(netlist):
        return "a sum may leave 16 bits, or a membrane or current its register"
    return None


def _consecutive(compartment: IntArray) -> IntArray:
    """Compartment of the first position of each block whose compartments are consecutive, else -1."""
    seated = compartment.reshape(-1, LANES)
    rises = np.all((seated == seated[:, :1] + np.arange(LANES)) | (seated < 0), axis=1)
    return np.where(rises, seated[:, 0], -1)


def lay_out_blocks(netlist: Netlist) -> Blocks | str:
    """Make blocks of a netlist, or say why there are none."""
    if (refusal := _refusal(netlist)) is not None:
        return refusal
    seats = _seats(netlist)

    # rows: one for each block and each source that reaches it
    first_source = np.append(0, netlist.n_inputs + seats.stage[:-1] * LANES)  # by depth
    number = np.append(np.arange(netlist.n_inputs), netlist.n_inputs + seats.position)
    width = LANES * max(-(-netlist.n_inputs // LANES), len(seats.layer))

    def places(core: int) -> tuple[IntArray, IntArray, IntArray]:
        """Row, by its pair, lane and weight of each synapse of a core: of all they would take most memory."""
        source, compartment, weight = netlist.synapses_of(core)
        block, lane = np.divmod(seats.position[compartment], LANES)
        local = number[source] - first_source[seats.depth[netlist.layer[compartment]]]
        return block * width + local, lane, weight

    cores = range(netlist.n_cores)
    rows, dense = _rows(netlist, seats, [np.unique(places(core)[0]) for core in cores], width)
    if len(rows) * LANES * 2 > SPARE + BYTES_A_SYNAPSE * netlist.n_synapses:
        return "synapses too scattered for rows of 64"
    row_block, row_source = np.divmod(rows, width)
    net, reached = _filled(rows, map(places, cores))
    shift, weight = _narrowed(net, row_block, len(seats.layer))

    # links: the rows of a block by words of sources
    words = width // LANES
    word = row_block * words + row_source // LANES
    links, first_row, link = np.unique(word, return_index=True, return_inverse=True)
    linked = np.zeros(len(links), np.uint64)
    np.bitwise_or.at(linked, link, _bit(row_source % LANES))
    size = len(seats.layer) * LANES
    bias = np.zeros(size, np.int32)
    threshold = np.full(size, NEVER, np.int32)
    compartment = np.full(size, -1)
    bias[seats.position] = netlist.bias
    threshold[seats.position] = netlist.threshold << MEMBRANE_SHIFT
    compartment[seats.position] = np.arange(netlist.n_compartments)
    return Blocks(
        stage=seats.stage,
        dense=dense,
        first=np.searchsorted(links // words, np.arange(len(seats.layer) + 1)),
        word=links % words,
        linked=linked,
        row=first_row,
        weight=weight,
        shift=shift + np.uint32(MEMBRANE_SHIFT),
        reached=reached,
        restful=_word((compartment >= 0) & (bias == 0)),
        held=_word(compartment >= 0),
        bias=bias,
        threshold=threshold,
        keep=seats.keep.astype(np.uint32),
        keep_u=seats.keep_u.astype(np.uint32),
        depth=seats.depth[seats.layer],
        layer=seats.layer,
        compartment=compartment,
        whole=_consecutive(compartment),
    )


class _Seats(NamedTuple):
    """Where compartments sit."""

    position: IntArray  # (compartments,) int64; block and lane of each
    # layer, keep, keep_u: (blocks,) int64; layer of each block, and what its membranes and currents keep, in
    # 1/4096
    layer: IntArray
    keep: IntArray
    keep_u: IntArray
    stage: IntArray  # (stages + 1,) int64; bounds of the stages in the blocks
    depth: IntArray  # (layers,) int64; depth of each layer, the number of its stage


def _seats(netlist: Netlist) -> _Seats:
    """Seat compartments by depth, layer and neuron; a layer begins a block, and so does another decay within it."""
    depth = np.array([layer.depth for layer in netlist.layers])
    decays = netlist.keep_v, netlist.keep_u
    order = np.lexsort((netlist.neuron, *reversed(decays), netlist.layer, depth[netlist.layer]))
    groups = np.stack([netlist.layer, *decays])[:, order]
    begins = np.flatnonzero(np.append(True, np.any(np.diff(groups) != 0, axis=0))[: len(order)])
    sizes = np.diff(np.append(begins, len(order)))
    blocks = -(-sizes // LANES)
    first = np.repeat((np.cumsum(blocks) - blocks) * LANES - begins, sizes)
    position = np.empty(len(order), np.int64)
    position[order] = first + np.arange(len(order))
    layer, keep_of_block, keep_u_of_block = np.repeat(groups[:, begins], blocks, axis=1)
    stage = np.searchsorted(depth[layer], np.arange(netlist.max_depth + 2))
    return _Seats(
        position=position, layer=layer, keep=keep_of_block, keep_u=keep_u_of_block, stage=stage, depth=depth
    )


def _rows(
    netlist: Netlist, seats: _Seats, of_cores: list[IntArray], width: int
) -> tuple[IntArray, BoolArray]:
    """Pairs of block and source that get a row, sorted, and whether those of a stage are all that there can be."""
    pairs = np.unique(np.concatenate(of_cores))
    blocks = np.diff(seats.stage)
    channels = np.append(
        netlist.n_inputs, np.bincount(seats.depth[netlist.layer], minlength=len(blocks))[:-1]
    )
    places = np.append(netlist.n_inputs, blocks[:-1] * LANES)
    dense = np.diff(np.searchsorted(pairs, seats.stage * width)) >= DENSE * blocks * channels
    filled = [
        (np.arange(seats.stage[s], seats.stage[s + 1])[:, None] * width + np.arange(places[s])).ravel()
        for s in np.flatnonzero(dense)
    ]
    return np.unique(np.concatenate([pairs, *filled])), dense


def _filled(
    rows: IntArray, synapses: Iterable[tuple[IntArray, IntArray, IntArray]]
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint64]]:
    """Weights of rows, and the lanes that they reach, from pairs, lanes and weights of synapses."""
    net = np.zeros(len(rows) * LANES, np.int16)
    reached = np.zeros(len(rows), np.uint64)
    for pair, lane, units in synapses:
        row = np.searchsorted(rows, pair)
        # of several synapses of one entry, what leaves 16 bits on the way comes back into them
        np.add.at(net, row * LANES + lane, units.astype(np.int16))
        np.bitwise_or.at(reached, row, _bit(lane))
    return net, reached


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


def _bit(lane: IntArray) -> npt.NDArray[np.uint64]:
    """Words with one bit set."""
    return np.left_shift(np.uint64(1), lane.astype(np.uint64))


def _word(flags: BoolArray) -> npt.NDArray[np.uint64]:
    """Words of 64 flags each."""
    return np.packbits(flags, bitorder="little").view("<u8").astype(np.uint64)
