"""The fast twin of :mod:`loihi1.spec`: the same spikes, membranes and counts, bit for bit.

There are two kernels. A network of layers that each receive from the one before, in which no register can
overflow or saturate, is run layer after layer in :mod:`loihi1.block_kernel`; whole recordings only.

Any other network is run step after step in :mod:`loihi1.kernel`, which knows no recordings: :func:`advance`
moves a state by any number of chip steps.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.errors import NumericRangeError
from spikeloom.compiler.layer_kernel import require_below
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, EventArray, IntArray
from spikeloom.runtime.machines.base import Done, require_channels
from spikeloom.runtime.machines.loihi1.block_kernel import (
    CHARGES,
    Blocks,
    add_charges,
    run_recordings,
    scratch_of,
)
from spikeloom.runtime.machines.loihi1.blocks import lay_out_blocks
from spikeloom.runtime.machines.loihi1.kernel import State, Tables, chip_steps, state_of, tables_of
from spikeloom.runtime.machines.loihi1.trace import (
    REGISTER_LIMITS,
    Charges,
    Counts,
    MembraneArray,
    Trace,
    pack,
    range_error,
    unpack,
)

WordArray = npt.NDArray[np.uint64]

NO_END = 2**62
"""Length of a recording of which nobody knows yet where it ends."""

PART = 4
"""Recordings that a thread takes at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Engine:
    """A netlist prepared for a kernel by :func:`prepare`; holds no state and can be shared by threads.

    The kernel of layers reads `blocks`, that of steps `tables`.
    """

    netlist: Netlist
    blocks: Blocks | None
    tables: Tables | None


def prepare(netlist: Netlist, *, stepwise: bool = False) -> Engine:
    """Lay a netlist out; `stepwise` is for :func:`advance`: the kernel of steps even where that of layers would do."""
    blocks = None if stepwise else lay_out_blocks(netlist)
    if blocks is None or isinstance(blocks, str):
        return Engine(netlist=netlist, blocks=None, tables=tables_of(netlist))
    return Engine(netlist=netlist, blocks=blocks, tables=None)


def start(engine: Engine) -> State:
    """State before a recording: at rest, or what a free-running chip comes to in blank steps."""
    state = state_of(engine.netlist)
    if engine.netlist.blank:
        advance(
            engine,
            state,
            np.zeros((engine.netlist.n_inputs, 0), np.uint8),
            length=0,
            steps=engine.netlist.blank,
        )
        for counts in (state.spikes, state.updates, state.saturations):
            counts[:] = 0
    return state


def advance(
    engine: Engine,
    state: State,
    events: EventArray,
    *,
    length: int,
    steps: int | None = None,
    spikes: BoolArray | None = None,
    membranes: MembraneArray | None = None,
    updated: BoolArray | None = None,
) -> None:
    """Run some chip steps, by default one per column; any split of a recording into calls gives the same result.

    Column 0 of `events` (n_inputs, columns) belongs to the next step of `state`, see :func:`start`; steps
    beyond the last column have no events. `length` are the data steps of the whole recording, which close
    each layer's window if it has one, ``NO_END`` if nobody knows. `spikes`, `membranes`, `updated` (steps,
    compartments) are filled, see :class:`trace.Trace`. Raises DataError and NumericRangeError as
    :func:`spec.simulate` does, with the same message; after that the state is of no further use.
    """
    require_channels(engine.netlist, events.shape[0])
    assert engine.tables is not None, "single steps need prepare(netlist, stepwise=True)"
    n = engine.netlist.n_compartments
    step, compartment, register, value = chip_steps(
        engine.tables,
        state,
        np.ascontiguousarray(events != 0).view(np.uint8),
        events.shape[1] if steps is None else steps,
        NO_END if engine.netlist.blank else length,
        np.zeros((0, n), np.bool_) if spikes is None else spikes,
        np.zeros((0, n), np.int32) if membranes is None else membranes,
        np.zeros((0, n), np.bool_) if updated is None else updated,
    )
    if compartment >= 0:
        raise range_error(engine.netlist, tuple(REGISTER_LIMITS)[register], compartment, step, value)


def _empty_trace(
    netlist: Netlist,
    recordings: int,
    length: int,
    spikes: bool,
    membranes: bool,
    updated: bool,
    packed: bool,
    charged: int | None,
) -> Trace:
    """Zeros of what is kept of recordings, and of so many `charged` sums."""
    shape = (recordings, length + netlist.drain, netlist.n_compartments)
    fired = np.zeros((recordings, netlist.n_compartments), np.int64)
    return Trace(
        counts=Counts(
            inputs=np.zeros((recordings, netlist.n_inputs), np.int64),
            spikes=fired,
            votes=np.zeros_like(fired) if netlist.blank else fired,
            updates=np.zeros((recordings, len(netlist.layers)), np.int64),
            saturations=np.zeros((recordings, len(netlist.layers)), np.int64),
        ),
        spikes=np.zeros(shape, np.bool_) if spikes else None,
        membranes=np.zeros(shape, np.int32) if membranes else None,
        updated=np.zeros(shape, np.bool_) if updated else None,
        charged=np.zeros((*shape[:2], charged), np.int64) if charged is not None else None,
        packed=np.zeros((*shape[:2], -(-shape[2] // 64)), np.uint64) if packed else None,
    )


def simulate(
    netlist: Netlist | Engine,
    events: EventArray,
    *,
    lengths: IntArray | None = None,
    spikes: bool = False,
    membranes: bool = False,
    updated: bool = False,
    packed: bool = False,
    charges: Charges | None = None,
    threads: int | None = None,
    progress: Done = None,
) -> Trace:
    """Run a batch of recordings (recordings, n_inputs, T) uint8 or bool, each from rest; the trace has a leading axis.

    `lengths` (recordings,) are the data steps of each where some are shorter: what comes after them is not
    run and zero in the trace. `spikes`, `membranes`, `updated` say what to keep per chip step (one, four and
    one bytes for each compartment), `packed` keeps spikes at a bit each, `charges` are what events add to
    the sums of each chip step. Recordings run on `threads` at a time, by default one per processor;
    `progress` is called with the number that is done.

    Raises DataError for another number of channels, and NumericRangeError as :func:`spec.simulate` does, for
    the first recording that overflows; a note on the exception says which.
    """
    engine = netlist if isinstance(netlist, Engine) else prepare(netlist)
    netlist = engine.netlist
    require_channels(netlist, events.shape[1])
    recordings, _, length = events.shape
    charged = None if charges is None else charges.sources.shape[1]
    trace = _empty_trace(netlist, recordings, length, spikes, membranes, updated, packed, charged)
    ends = np.full(recordings, length) if lengths is None else np.asarray(lengths, np.int64)
    run_part, size = (_run_steps, 1) if engine.blocks is None else (_run_layers, PART)
    require_below("length", ends, length + 1)
    given = np.ascontiguousarray(events if events.dtype in (np.uint8, np.bool_) else events != 0).view(
        np.uint8
    )
    given.flags.writeable = False  # or the kernels would be compiled twice, for either
    if charges is not None:
        sources = np.pad(charges.sources, ((0, 0), (0, -charges.sources.shape[1] % CHARGES)))
        kinds, members = charges.kinds

    def run(part: slice) -> None:
        fired, worked = run_part(engine, given[part], ends[part], trace, part)
        if charges is not None and trace.charged is not None:
            totals = np.empty(sources.shape[1], np.int64)
            add_charges(
                given[part], ends[part], fired, worked, sources, kinds, members, trace.charged[part], totals
            )

    parts = [slice(i, min(i + size, recordings)) for i in range(0, recordings, size)]
    workers = min(threads or os.cpu_count() or 1, len(parts))
    with ThreadPoolExecutor(workers) if workers > 1 else nullcontext() as pool:
        for part, _ in zip(parts, pool.map(run, parts) if pool else map(run, parts), strict=True):
            if progress is not None:
                progress(part.stop)
    return trace


def _run_layers(
    engine: Engine, events: EventArray, ends: IntArray, trace: Trace, part: slice
) -> tuple[WordArray, WordArray]:
    """Run some recordings layer after layer, `part` of the trace; spikes and updates at a bit each where wanted."""
    blocks = engine.blocks
    nothing = (0, 0, 0)
    assert blocks is not None, "laid out for the kernel of steps"
    n = engine.netlist.n_compartments
    words = len(events), events.shape[2] + engine.netlist.drain, -(-n // 64)
    spikes, updated = (
        np.zeros(words if trace.charged is not None or kept is not None else nothing, np.uint64)
        for kept in (trace.spikes, trace.updated)
    )
    if trace.packed is not None:
        spikes = trace.packed[part]
    run_recordings(
        blocks,
        *scratch_of(
            blocks, events.shape[1], int(ends.max(initial=0)), membranes=trace.membranes is not None
        ),
        events,
        ends,
        trace.counts.inputs[part],
        trace.counts.spikes[part],
        trace.counts.updates[part],
        spikes,
        np.zeros(nothing, np.int32) if trace.membranes is None else trace.membranes[part],
        updated,
    )
    if trace.spikes is not None:
        trace.spikes[part] = unpack(spikes, n)
    if trace.updated is not None:
        trace.updated[part] = unpack(updated, n)
    return spikes, updated


def _run_steps(
    engine: Engine, events: EventArray, ends: IntArray, trace: Trace, part: slice
) -> tuple[WordArray, WordArray]:
    """Run the one recording of a part step after step; its spikes and updates at a bit each."""
    netlist = engine.netlist
    index = part.start
    length = int(ends[0])
    state = start(engine)
    steps = length + netlist.max_depth
    size = events.shape[2] + netlist.drain, netlist.n_compartments
    fired = np.zeros(size, np.bool_) if trace.spikes is None else trace.spikes[index]
    worked = np.zeros(size, np.bool_) if trace.updated is None else trace.updated[index]
    try:
        for begin, end in ((0, steps), (steps, length + netlist.drain)):
            advance(
                engine,
                state,
                events[0, :, begin:length],
                length=length,
                steps=end - begin,
                spikes=fired[begin:end],
                membranes=None if trace.membranes is None else trace.membranes[index, begin:end],
                updated=worked[begin:end],
            )
            if end == steps:
                trace.counts.votes[index] = state.spikes
    except NumericRangeError as error:
        error.add_note(f"recording {index} of {len(trace.counts.inputs)}, counted from 0")
        raise
    trace.counts.inputs[index] = state.inputs
    trace.counts.spikes[index] = state.spikes
    np.add.at(trace.counts.updates[index], netlist.layer, state.updates)
    np.add.at(trace.counts.saturations[index], netlist.layer, state.saturations)
    spikes = pack(fired)
    if trace.packed is not None:
        trace.packed[index] = spikes
    return spikes[None], pack(worked)[None]
