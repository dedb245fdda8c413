"""The chip step of :mod:`loihi1.spec` for 64 compartments at once; :mod:`loihi1.blocks` prepares what it reads.

All of it stands in one file, since numba caches machine code by the stamp of the file that it was made from.

A *block* is 64 neurons of one layer; who spiked in it is one 64-bit word. Its synapses are rows of 64
weights, one for each source that reaches it. In each step the rows of the sources that are active are added
up in registers, and the 64 neurons integrate, compare and reset. A block runs through the whole recording
before the next one starts, so that its rows and membranes stay in cache: no layer receives from a later one.

*Sixteen bits.* :mod:`loihi1.blocks` proves that the positive and the negative weights of a step each add up to 32,767
at most (the accumulator's 21 bits hold them shifted left by six). A sum of some of both lies in between, in whatever
order they come.

*Decay in 32 bits.* It also proves that no membrane leaves its register and that none times its factor reaches 2**32; so
the magnitude is multiplied without a sign, and nothing saturates.

*Currents.* Most layers have none beyond a step. Where the current outlasts its step it is one more register of 32 bits;
a product of two wide factors is then taken in two parts, as :mod:`loihi1.kernel` does.

*Idle neurons.* A compartment has nothing to do in a step if its membrane, its current, its bias and the number of
synapses that reach it are all zero. Only those without a bias can be idle, the others are not looked at.

*Vectors.* They are written in LLVM's own terms, as numba leaves no other way to hold 16-bit sums in registers and to
turn 64 comparisons into one word. LLVM makes of them what the machine has.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached
from spikeloom.compiler.targets.loihi1.registers import DECAY_BITS
from spikeloom.compiler.types import AnyArray, IntArray

Function = Callable[..., Any]

LANES = 64
"""Compartments of a block."""

LISTED = 4
"""Bits of a word that are listed at a time."""

CHARGES = 8
"""Charges of a source are padded to a multiple of this."""

UNROLLED = 4
"""Rows that are added up without a look at how many are left."""

_BIT, _SUM, _STATE, _WORD = (ir.IntType(bits) for bits in (1, 16, 32, 64))
_SUMS, _STATES = ir.VectorType(_SUM, LANES), ir.VectorType(_STATE, LANES)


class Blocks(NamedTuple):
    """A netlist as the kernel reads it; nothing in here changes."""

    stage: IntArray  # (stages + 1,) int64; bounds of each stage, the layers of one depth, in the blocks
    # (stages,) bool; whether every block of a stage has a row for every source; then its sources are listed
    dense: AnyArray
    first: IntArray  # (blocks + 1,) int64; bounds of each block in the links
    # word, linked, row: (links,) int64, uint64, int64; A word of sources that reach a block, which of them
    # do, and the row of the first of these
    word: IntArray
    linked: AnyArray
    row: IntArray
    # (rows * 64,) int8 or int16; net weight of a source for each position of a block, shifted right by what
    # all weights of the block have in common
    weight: AnyArray
    shift: AnyArray  # (blocks,) uint32; from a sum of these to membrane units
    reached: AnyArray  # (rows,) uint64; positions that a source has a synapse to, whatever its weight
    restful: AnyArray  # (blocks,) uint64; positions without a bias
    held: AnyArray  # (blocks,) uint64; positions that hold a compartment
    # bias, threshold: (blocks * 64,) int32; in membrane units; a position without a compartment has a
    # threshold that nothing reaches
    bias: AnyArray
    threshold: AnyArray
    # keep, keep_u: (blocks,) uint32; what a membrane and a current keep in a step, in 1/4096
    keep: AnyArray
    keep_u: AnyArray
    # depth, layer: (blocks,) int64; depth and layer of each block
    depth: IntArray
    layer: IntArray
    compartment: IntArray  # (blocks * 64,) int64; compartment of each position, -1 for none
    # (blocks,) int64; compartment of the first position where those of the block are consecutive, else -1
    whole: IntArray


class Scratch(NamedTuple):
    """What a recording leaves behind, for the next to use again."""

    words: AnyArray  # (steps * words of the inputs,) uint64; channels with an event in each step
    # listed, bounds: as many int32 as bits can be set in a stage and LISTED more, and (steps + 1,) int64;
    # sources of a stage and the bounds of its steps
    listed: AnyArray
    bounds: IntArray
    # raster, idle: (steps * blocks,) uint64; who spiked and who was idle, stage after stage; within a stage
    # step after step
    raster: AnyArray
    idle: AnyArray
    spikes: AnyArray  # (blocks * 64,) int64; spikes of each position
    membrane: AnyArray  # (blocks * 64,) int32; last membranes
    before: AnyArray  # (blocks * 64,) int16; synaptic sums of the last step: what the current register still holds
    membranes: AnyArray  # (steps * blocks * 64,) int32, or empty; membranes before a reset, in the order of `raster`


class Lasting(NamedTuple):
    """Currents that outlast their step, in a recording."""

    keep_u: AnyArray  # (blocks,) uint32; as in :class:`Blocks`; 0 where there is no such current
    current: AnyArray  # (blocks * 64,) int32; last currents


def _intrinsic(function: Function) -> Function:
    """Let compiled functions call what `function` emits, without the typing context that it takes first."""
    return cast(Function, intrinsic(function))


def _number(value: int) -> Any:
    return ir.Constant(_WORD, value)


def _all(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * LANES)


def _arrays(context: Any, builder: Any, kind: Any, value: Any) -> dict[str, Any]:
    """Where the arrays of a named tuple begin."""
    return {
        name: context.make_array(part)(context, builder, builder.extract_value(value, i)).data
        for i, (name, part) in enumerate(zip(kind.fields, kind.types, strict=True))
    }


def _element(builder: Any, array: Any, index: Any) -> Any:
    return builder.load(builder.gep(array, [index]))


def _vector(builder: Any, array: Any, index: Any, kind: Any) -> tuple[Any, Any]:
    """Load 64 elements; also returns where they are, to store them again."""
    place = builder.bitcast(builder.gep(array, [index]), kind.as_pointer())
    return builder.load(place, align=kind.element.width // 8, typ=kind), place


def _row(builder: Any, tables: Any, row: Any) -> Any:
    """Weights of a row, 8 or 16 bits each, as 16 bits."""
    array = tables["weight"]
    kind = ir.VectorType(array.type.pointee, LANES)
    return builder.sext(_vector(builder, array, builder.mul(row, _number(LANES)), kind)[0], _SUMS)


def _store(builder: Any, vector: Any, place: Any) -> None:
    builder.store(vector, place, align=vector.type.element.width // 8)


def _lanes(builder: Any, value: Any) -> Any:
    """All lanes the same."""
    nothing = ir.Constant(_STATES, ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_STATE, 0))
    return builder.shuffle_vector(one, nothing, _all(_STATES, 0))


def _loop(builder: Any, values: Any, goes_on: Function, body: Function) -> Any:
    """Emit a loop: as long as it `goes_on` with the values, `body` makes the next ones of them; returns the last."""
    before = builder.block
    head, inside, done = map(builder.append_basic_block, ("head", "body", "done"))
    builder.branch(head)
    builder.position_at_end(head)
    phis = [builder.phi(value.type) for value in values]
    for phi, value in zip(phis, values, strict=True):
        phi.add_incoming(value, before)
    builder.cbranch(goes_on(phis), inside, done)
    builder.position_at_end(inside)
    for phi, value in zip(phis, body(phis), strict=True):
        phi.add_incoming(value, builder.block)
    builder.branch(head)
    builder.position_at_end(done)
    return phis


def _add_row(
    builder: Any, tables: Any, row: Any, total: Any, arrived: Any, *, marks: bool
) -> tuple[Any, Any]:
    """Add the weights of a row to the sums and, if wanted, mark who is reached."""
    total = builder.add(total, _row(builder, tables, row))
    return total, builder.or_(arrived, _element(builder, tables["reached"], row)) if marks else arrived


def _sum_rows(
    builder: Any, tables: Any, active: Any, at: Any, block: Any, *, marks: bool
) -> tuple[Any, Any]:
    """Emit the loop over a block's links and, within, over active sources; returns sums and who was reached."""
    begin, end = (_element(builder, tables["first"], builder.add(block, _number(i))) for i in (0, 1))

    def of_link(values: Any) -> Any:
        e, total, arrived = values
        linked = _element(builder, tables["linked"], e)
        word = _element(builder, active, builder.add(at, _element(builder, tables["word"], e)))
        first_row = _element(builder, tables["row"], e)

        def of_source(values: Any) -> Any:
            left, total, arrived = values
            lowest = builder.and_(left, builder.neg(left))
            rank = builder.ctpop(builder.and_(linked, builder.sub(lowest, _number(1))))
            row = builder.add(first_row, rank)
            return builder.xor(left, lowest), *_add_row(builder, tables, row, total, arrived, marks=marks)

        def any_left(values: Any) -> Any:
            return builder.icmp_unsigned("!=", values[0], _number(0))

        _, *sums = _loop(builder, (builder.and_(word, linked), total, arrived), any_left, of_source)
        return builder.add(e, _number(1)), *sums

    def within(values: Any) -> Any:
        return builder.icmp_signed("<", values[0], end)

    _, total, arrived = _loop(builder, (begin, _all(_SUMS, 0), _number(0)), within, of_link)
    return total, arrived


def _sum_listed(
    builder: Any, tables: Any, sources: Any, bounds: Any, block: Any, *, marks: bool
) -> tuple[Any, Any]:
    """Emit the same for a block that every source reaches: listed sources, four at a time, then one."""
    base = _element(builder, tables["row"], _element(builder, tables["first"], block))

    def add(stride: int, values: Any) -> Any:
        k, total, arrived = values
        for i in range(stride):
            source = builder.sext(_element(builder, sources, builder.add(k, _number(i))), _WORD)
            row = builder.add(base, source)
            total, arrived = _add_row(builder, tables, row, total, arrived, marks=marks)
        return builder.add(k, _number(stride)), total, arrived

    def within(stride: int, values: Any) -> Any:
        return builder.icmp_signed("<=", builder.add(values[0], _number(stride)), bounds[1])

    values = bounds[0], _all(_SUMS, 0), _number(0)
    for stride in (UNROLLED, 1):
        values = _loop(builder, values, partial(within, stride), partial(add, stride))
    _, total, arrived = values
    return total, arrived


def _decayed(builder: Any, old: Any, keep: Any, *, wide: bool) -> Any:
    """Emit the decay of 64 registers, rounding toward zero; `wide` where a product may leave 32 bits."""
    zero = _all(_STATES, 0)
    bits = _all(_STATES, DECAY_BITS)
    below = builder.icmp_signed("<", old, zero)
    magnitude = builder.select(below, builder.sub(zero, old), old)
    if wide:
        low = builder.and_(magnitude, _all(_STATES, 2**DECAY_BITS - 1))
        low = builder.lshr(builder.mul(low, keep), bits)
        magnitude = builder.add(builder.mul(builder.lshr(magnitude, bits), keep), low)
    else:
        magnitude = builder.lshr(builder.mul(magnitude, keep), bits)
    return builder.select(below, builder.sub(zero, magnitude), magnitude)


def _integrate(
    builder: Any, tables: Any, scratch: Any, sums: Any, block: Any, kept_at: Any, lasting: Any
) -> tuple[Any, Any, Any]:
    """Emit one step of the 64 neurons; returns their membranes and lasting currents before it, and who fired."""
    position = builder.mul(block, _number(LANES))
    zero = _all(_STATES, 0)

    # decay membrane
    old, place = _vector(builder, scratch["membrane"], position, _STATES)
    keep = _lanes(builder, _element(builder, tables["keep"], block))
    v = _decayed(builder, old, keep, wide=lasting is not None)
    # add input and bias
    arrived = builder.shl(
        builder.sext(sums, _STATES), _lanes(builder, _element(builder, tables["shift"], block))
    )
    before = None
    if lasting is not None:
        before, current_place = _vector(builder, lasting["current"], position, _STATES)
        keep_u = _lanes(builder, _element(builder, lasting["keep_u"], block))
        arrived = builder.add(_decayed(builder, before, keep_u, wide=True), arrived)
        _store(builder, arrived, current_place)
    v = builder.add(v, arrived)
    v = builder.add(v, _vector(builder, tables["bias"], position, _STATES)[0])
    # compare
    fired = builder.icmp_signed(">", v, _vector(builder, tables["threshold"], position, _STATES)[0])
    with builder.if_then(builder.icmp_signed(">=", kept_at, _number(0))):
        _store(builder, v, _vector(builder, scratch["membranes"], kept_at, _STATES)[1])
    # reset
    _store(builder, builder.select(fired, zero, v), place)
    return old, before, fired


def _block_step(*, listed: bool, rests: bool, lasts: bool) -> Function:
    """Make one step of one block."""

    @_intrinsic
    def step(
        typing: Any,
        tables: Any,
        active: Any,
        at: Any,
        end: Any,
        block: Any,
        scratch: Any,
        lasting: Any,
        place: Any,
        kept_at: Any,
    ) -> Any:
        signature = types.uint64(tables, active, *[types.int64] * 3, scratch, lasting, *[types.int64] * 2)

        def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            table = _arrays(context, builder, tables, values[0])
            own = _arrays(context, builder, scratch, values[5])
            currents = _arrays(context, builder, lasting, values[6]) if lasts else None
            sources = context.make_array(active)(context, builder, values[1]).data
            (at, end, block), (place, kept_at) = values[2:5], values[7:9]
            if listed:
                sums, arrived = _sum_listed(builder, table, sources, (at, end), block, marks=rests)
            else:
                sums, arrived = _sum_rows(builder, table, sources, at, block, marks=rests)
            old, last, fired = _integrate(builder, table, own, sums, block, kept_at, currents)
            if rests:
                if last is None:
                    last, last_at = _vector(
                        builder, own["before"], builder.mul(block, _number(LANES)), _SUMS
                    )
                    _store(builder, sums, last_at)
                silent = builder.and_(
                    builder.icmp_signed("==", old, _all(_STATES, 0)),
                    builder.icmp_signed("==", last, _all(last.type, 0)),
                )
                idle = builder.and_(builder.bitcast(silent, _WORD), builder.not_(arrived))
                idle = builder.and_(idle, _element(builder, table["restful"], block))
                builder.store(idle, builder.gep(own["idle"], [place]))
            return builder.bitcast(fired, _WORD)

        return signature, emit

    return step


@_intrinsic
def _lowest(typing: Any, word: Any) -> Any:
    """Index of the lowest bit of a word, 64 of zero."""

    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.cttz(values[0], ir.Constant(_BIT, 0))

    return types.int64(types.uint64), emit


@_intrinsic
def _gathered(typing: Any, flags: Any, at: Any) -> Any:
    """One word of 64 bytes of an array of any shape: which are not zero."""
    kind = ir.VectorType(ir.IntType(8), LANES)

    def emit(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        array = context.make_array(flags)(context, builder, values[0]).data
        found = builder.icmp_unsigned("!=", _vector(builder, array, values[1], kind)[0], _all(kind, 0))
        return builder.bitcast(found, _WORD)

    return types.uint64(flags, types.int64), emit


@_intrinsic
def _bits(typing: Any, word: Any) -> Any:
    """Bits of a word that are set."""

    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        return builder.ctpop(values[0])

    return types.int64(types.uint64), emit


def scratch_of(
    blocks: Blocks, channels: int, steps: int, *, membranes: bool
) -> tuple[Scratch, Lasting | None]:
    """What recordings of up to so many steps are run in; networks without lasting currents do without the code."""
    n_words = -(-channels // LANES)
    n_blocks = blocks.keep.size
    widest = max(n_words, int(np.diff(blocks.stage).max(initial=0)))
    positions = n_blocks * LANES
    scratch = Scratch(
        words=np.empty(steps * n_words, np.uint64),
        listed=np.empty(steps * widest * LANES + LISTED, np.int32),
        bounds=np.empty(steps + 1, np.int64),
        raster=np.empty(steps * n_blocks, np.uint64),
        idle=np.empty(steps * n_blocks, np.uint64),
        spikes=np.empty(positions, np.int64),
        membrane=np.empty(positions, np.int32),
        before=np.empty(positions, np.int16),
        membranes=np.empty(steps * positions if membranes else 0, np.int32),
    )
    return scratch, Lasting(blocks.keep_u, np.empty(positions, np.int32)) if blocks.keep_u.any() else None


@compiled
def _pack(events: AnyArray, steps: int, words: AnyArray) -> None:
    """Turn the events of a recording into words, channel after channel."""
    n_words = (events.shape[0] + LANES - 1) // LANES
    columns = events.shape[1]
    for at in range(steps * n_words):
        words[at] = 0
    for channel in range(events.shape[0]):
        place = channel >> 6
        bit = np.uint64(channel & 63)
        whole = steps - steps % LANES
        for begin in range(0, whole, LANES):
            left = _gathered(events, channel * columns + begin)
            while left:
                words[(begin + _lowest(left)) * n_words + place] |= np.uint64(1) << bit
                left &= left - np.uint64(1)
        for t in range(whole, steps):
            words[t * n_words + place] |= np.uint64(events[channel, t] != 0) << bit


@compiled
def _list(words: AnyArray, start: int, width: int, steps: int, scratch: Scratch, count: AnyArray) -> None:
    """List the bits that are set in each step, and count them."""
    listed = scratch.listed
    bounds = scratch.bounds
    n = 0
    for t in range(steps):
        bounds[t] = n
        for w in range(width):
            left = words[start + t * width + w]
            end = n + _bits(left)
            # some at a time, as if they were there: guessing how many bits a word has left costs more
            while n < end:
                for i in range(LISTED):
                    listed[n + i] = w * LANES + _lowest(left)
                    left &= left - np.uint64(1)
                n += LISTED
            n = end
    bounds[steps] = n
    for i in range(n):
        count[listed[i]] += 1


def _block_runner(*, lasts: bool) -> Function:
    """Make what runs a block of a stage through a recording, on its sources as words or listed."""
    restful, busy, restful_listed, busy_listed = (
        _block_step(listed=listed, rests=rests, lasts=lasts)
        for listed in (False, True)
        for rests in (True, False)
    )

    @compiled
    def run(
        blocks: Blocks,
        s: int,
        block: int,
        steps: int,
        words: AnyArray,
        start: int,
        width: int,
        scratch: Scratch,
        lasting: Lasting | None,
    ) -> None:
        listed = scratch.listed
        bounds = scratch.bounds
        begin = blocks.stage[s]
        end = blocks.stage[s + 1]
        rests = blocks.restful[block] != 0
        for t in range(steps):
            place = steps * begin + t * (end - begin) + block - begin
            kept = place * LANES if scratch.membranes.size else -1
            at = start + t * width
            last = bounds[t + 1]
            if not blocks.dense[s]:
                if rests:
                    fired = restful(blocks, words, at, 0, block, scratch, lasting, place, kept)
                else:
                    fired = busy(blocks, words, at, 0, block, scratch, lasting, place, kept)
            elif rests:
                fired = restful_listed(blocks, listed, bounds[t], last, block, scratch, lasting, place, kept)
            else:
                fired = busy_listed(blocks, listed, bounds[t], last, block, scratch, lasting, place, kept)
            scratch.raster[place] = fired

    return run


_run_block, _run_lasting_block = (_block_runner(lasts=lasts) for lasts in (False, True))


@compiled
def _run_stages(
    blocks: Blocks, inputs: IntArray, steps: int, scratch: Scratch, lasting: Lasting | None
) -> None:
    """Let all stages integrate, one after the other, and count spikes and events."""
    active = scratch.words
    start = np.int64(0)
    width = (inputs.size + LANES - 1) // LANES
    count = inputs
    for s in range(blocks.stage.size - 1):
        _list(active, start, width, steps, scratch, count)
        begin = blocks.stage[s]
        end = blocks.stage[s + 1]
        for block in range(begin, end):  # one after another: their rows and membranes stay in cache
            if lasting is not None and lasting.keep_u[block] != 0:
                _run_lasting_block(blocks, s, block, steps, active, start, width, scratch, lasting)
            else:
                _run_block(blocks, s, block, steps, active, start, width, scratch, None)
        active = scratch.raster
        start = steps * begin
        width = end - begin
        count = scratch.spikes[begin * LANES :]
    _list(active, start, width, steps, scratch, count)


@compiled
def _pack_compartments(blocks: Blocks, steps: int, words: AnyArray, out: AnyArray, inverse: Any) -> None:
    """Write bits into a (chip steps, words) array, compartment c at bit c % 64 of word c // 64."""
    for s in range(blocks.stage.size - 1):
        begin = blocks.stage[s]
        end = blocks.stage[s + 1]
        for t in range(steps):
            for block in range(begin, end):
                left = words[steps * begin + t * (end - begin) + block - begin]
                if inverse:
                    left = ~left & blocks.held[block]
                row = t + blocks.depth[block]
                if blocks.whole[block] >= 0:
                    to = blocks.whole[block] >> 6
                    by = np.uint64(blocks.whole[block] & 63)
                    out[row, to] |= left << by
                    rest = (
                        left >> np.uint64(1) >> (np.uint64(LANES - 1) - by)
                    )  # a shift by 64 is not defined
                    if rest:
                        out[row, to + 1] |= rest
                    continue
                while left:
                    compartment = blocks.compartment[block * LANES + _lowest(left)]
                    out[row, compartment >> 6] |= np.uint64(1) << np.uint64(compartment & 63)
                    left &= left - np.uint64(1)


@compiled
def _count_idle(blocks: Blocks, block: int, s: int, steps: int, idle: AnyArray) -> int:
    """Idle compartment-steps of a block of a stage."""
    begin = blocks.stage[s]
    width = blocks.stage[s + 1] - blocks.stage[s]
    total = 0
    for t in range(steps):
        total += _bits(idle[steps * begin + t * width + block - begin])
    return total


@compiled
def _copy_membranes(blocks: Blocks, steps: int, kept: AnyArray, out: AnyArray) -> None:
    """Write membranes into a (chip steps, compartments) array."""
    place = 0
    for s in range(blocks.stage.size - 1):
        for t in range(steps):
            for block in range(blocks.stage[s], blocks.stage[s + 1]):
                for position in range(block * LANES, (block + 1) * LANES):
                    if blocks.compartment[position] >= 0:
                        out[t + blocks.depth[block], blocks.compartment[position]] = kept[place]
                    place += 1


@compiled_and_cached
def run_recordings(
    blocks: Blocks,
    scratch: Scratch,
    lasting: Lasting | None,
    events: AnyArray,
    lengths: IntArray,
    inputs: IntArray,
    spikes: IntArray,
    updates: IntArray,
    fired: AnyArray,
    membranes: AnyArray,
    updated: AnyArray,
) -> None:
    """Run some recordings: `events` (recordings, channels, columns) uint8, not zero where there is one.

    Filled, from zeros, are the counts `inputs`, `spikes`, `updates`; `fired` and `updated` (recordings, chip
    steps, words) uint64 and `membranes` (recordings, chip steps, compartments) int32, or no recordings of
    what is not wanted. Arrays for its own use come from :func:`scratch_of`, as they cost no compilation
    there.
    """
    for r in range(events.shape[0]):
        steps = lengths[r]
        _pack(events[r], steps, scratch.words)
        for place in range(scratch.idle.size):
            scratch.idle[place] = 0
        for position in range(scratch.spikes.size):
            scratch.spikes[position], scratch.membrane[position], scratch.before[position] = 0, 0, 0
            if lasting is not None:
                lasting.current[position] = 0
        _run_stages(blocks, inputs[r], steps, scratch, lasting)
        for position in range(scratch.spikes.size):
            if blocks.compartment[position] >= 0:
                spikes[r, blocks.compartment[position]] = scratch.spikes[position]
        for s in range(blocks.stage.size - 1):
            for block in range(blocks.stage[s], blocks.stage[s + 1]):
                worked = steps * _bits(blocks.held[block])
                if blocks.restful[block]:
                    worked -= _count_idle(blocks, block, s, steps, scratch.idle)
                updates[r, blocks.layer[block]] += worked
        if fired.shape[0]:
            _pack_compartments(blocks, steps, scratch.raster, fired[r], np.bool_(False))
        if updated.shape[0]:
            _pack_compartments(blocks, steps, scratch.idle, updated[r], np.bool_(True))
        if membranes.shape[0]:
            _copy_membranes(blocks, steps, scratch.membranes, membranes[r])


@compiled
def _add_rows(rows: IntArray, words: AnyArray, totals: IntArray) -> None:
    """Add the rows whose bits are set."""
    for w in range(words.size):
        left = words[w]
        while left:
            row = w * LANES + _lowest(left)
            for part in range(0, totals.size, CHARGES):
                for i in range(CHARGES):  # a fixed number of them, which become vectors
                    totals[part + i] += rows[row, part + i]
            left &= left - np.uint64(1)


@compiled_and_cached
def add_charges(
    events: AnyArray,
    lengths: IntArray,
    fired: AnyArray,
    updated: AnyArray,
    sources: IntArray,
    kinds: IntArray,
    members: AnyArray,
    charged: IntArray,
    totals: IntArray,
) -> None:
    """Add what happened in some recordings to the sums of each chip step, `charged` (recordings, chip steps, sums).

    `events`, `fired` and `updated` are as in :func:`run_recordings`; `sources` those of
    :class:`trace.Charges`, padded. An update adds one of few `kinds` (kinds, sums); bits of `members`
    (kinds, words) are compartments of each. In `totals`, as long as a row of `sources`, a step is added up.
    """
    for r in range(events.shape[0]):
        for channel in range(events.shape[1]):
            for t in range(lengths[r]):
                if events[r, channel, t]:
                    for i in range(kinds.shape[1]):
                        charged[r, t, i] += sources[channel, i]
        for t in range(fired.shape[1]):
            for i in range(totals.size):
                totals[i] = 0
            _add_rows(sources[events.shape[1] :], fired[r, t], totals)
            for kind in range(kinds.shape[0]):
                count = 0
                for w in range(updated.shape[2]):
                    count += _bits(updated[r, t, w] & members[kind, w])
                for i in range(kinds.shape[1]):
                    totals[i] += count * kinds[kind, i]
            for i in range(kinds.shape[1]):
                charged[r, t, i] += totals[i]
