"""How long each chip step takes: a simple model from sums alone, and a detailed one that schedules every message.

*Simple.* The cores sweep their neurons and send, and they receive, both at once; a step lasts as long as the longest
of these, then the barrier.

*Detailed.* Every message is sent when the sweep reaches its neuron, crosses the mesh along x, then along y, slower
where others are under way and blocked where the links are full, and waits until the receiving core is free. A step
lasts until the last neuron is swept and the last message processed, then the barrier. The tests hold both models
against a plain definition, one message at a time.

Spikes of a step are sent and processed within that step and act in the next. *Input events* act in the step in which
they arrive: the receiving cores process them from its start, and nobody pays for their injection. Other simulators
let channels be neurons of a core that cost nothing but their messages; `input_tiles` says so. An event that acts in
step ``t`` is then sent in step ``t - 1``.

References
----------
.. [1] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025: the equations, and the fit to silicon (within
   25 % of the latency of three applications).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import lcm
from typing import Any

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.targets.base import PICOSECONDS, Target, TimeTable
from spikeloom.compiler.targets.loihi1.layout.place import require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.engine import EventArray
from spikeloom.runtime.machines.loihi1.timing_kernel import Tables, schedule
from spikeloom.runtime.machines.loihi1.trace import Charges

EAST, WEST, NORTH, SOUTH, PORTS = range(5)
"""Links of a tile: one that messages enter by for each direction in which they travel, then its cores' own ports."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepTimes:
    """What a model says of a batch of recordings; nothing happens after a recording's own steps."""

    duration_ns: FloatArray  # (samples, steps) float64; of each chip step, barrier included
    critical_core: IntArray  # (samples, steps) int64; core that took longest; the lowest of several, -1 after the end
    receiving: BoolArray  # (samples, steps) bool; whether it took longest to receive

    @property
    def seconds(self) -> FloatArray:
        """Of each recording; shape (samples,)."""
        seconds: FloatArray = self.duration_ns.sum(axis=1) * 1e-9
        return seconds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimpleTimes(StepTimes):
    """Also (samples, cores) float64: how long each core sweeps and sends, and how long it receives, in all steps."""

    generation_ns: FloatArray
    processing_ns: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetailedTimes(StepTimes):
    """Also, each (samples, steps) float64, what queues and the mesh do."""

    # when the last core ended its sweep and sending, and when the last message was processed
    sent_ns: FloatArray
    processed_ns: FloatArray
    blocked_ns: FloatArray  # for which cores could not send because the links were full, summed over the cores
    # most messages on any link at any time; one on its way counts as one spread evenly over its links and its end
    peak_load: FloatArray


def _way(start: int, end: int, port: int, width: int, tile_links: int) -> list[int]:
    """Links from a core to a tile, along x first: the core's port, then the link by which each further tile is entered.

    Examples
    --------
    >>> _way(0, 9, 2, 8, 8)
    [6, 8, 74]
    """
    links = [start * tile_links + PORTS + port]
    y, x = divmod(start, width)
    to_y, to_x = divmod(end, width)
    while (x, y) != (to_x, to_y):
        if x != to_x:
            direction = EAST if x < to_x else WEST
            x += 1 if x < to_x else -1
        else:
            direction = NORTH if y < to_y else SOUTH
            y += 1 if y < to_y else -1
        links.append((y * width + x) * tile_links + direction)
    return links


def prepare(
    netlist: Netlist,
    target: Target,
    table: TimeTable,
    *,
    input_tiles: tuple[int, ...] = (),
    dense: BoolArray | None = None,
) -> Tables:
    """Lay a netlist out for the time models.

    `input_tiles` are tiles of cores that hold the input channels, as many on each as it has room for; empty if no core
    holds them. `dense` (synapses,) says which synapses take the time of a dense list; by default those that are stored
    in one. Raises OptionError if the netlist takes several chips.
    """
    require_one_chip(netlist.core_tile, target, "time")
    size, n_inputs = netlist.n_compartments, netlist.n_inputs
    core_tile = np.append(netlist.core_tile, np.array(input_tiles, np.int64))
    extra = [min(i * target.limit("core.compartments"), n_inputs) for i in range(1, len(input_tiles) + 1)]
    inner = np.arange(len(core_tile)) < netlist.n_cores
    latency = {event: table.picoseconds(event) for event in table.latencies}

    axon = netlist.axon_of_synapse()
    if dense is None:
        dense = netlist.format_index_bits[netlist.axon_format[axon]] == 0
    in_dense, in_sparse = (np.bincount(axon[form], minlength=netlist.n_axons) for form in (dense, ~dense))
    processing = latency["axon_in"] + in_dense * latency["synaptic_operation_dense"]
    processing += in_sparse * latency["synaptic_operation_sparse"]
    destination = netlist.core_of_axon()
    width, tile_cores = target.limit("mesh.width"), target.limit("mesh.tile_cores")
    port = np.array([np.sum(core_tile[:core] == tile) for core, tile in enumerate(core_tile)])
    is_input = netlist.axon_source < n_inputs
    slot = np.where(is_input, netlist.axon_source + size, netlist.axon_source - n_inputs)
    slots = size + n_inputs if input_tiles else size
    # the messages of a spike go out in the order of columns, rows and cores of a tile, as the reference has it
    rank = np.lexsort((port, core_tile // width, core_tile % width)).argsort()
    order = np.lexsort((rank[destination], slot))
    on_core, alone = order[slot[order] < slots], order[slot[order] >= slots]

    start = np.append(netlist.core_compartments, size + np.array(extra, np.int64))
    sender = np.repeat(np.arange(len(core_tile)), np.diff(start))
    first = np.searchsorted(slot[on_core], np.arange(slots + 1))
    spike = np.where(inner, latency["spike"], 0)
    pairs, route = np.unique(sender[slot[on_core]] * len(core_tile) + destination[on_core], return_inverse=True)
    ways = [
        _way(int(core_tile[a]), int(core_tile[b]), int(port[a]), width, PORTS + tile_cores)
        for a, b in (divmod(int(pair), len(core_tile)) for pair in pairs)
    ]
    tiles = [[link // (PORTS + tile_cores) for link in way] for way in ways]
    hop = {True: latency["hop_east_west"], False: latency["hop_north_south"]}
    unit = lcm(*(len(way) + 1 for way in ways))
    return Tables(
        start=start,
        access=np.where(inner, latency["neuron_access"], 0),
        update=np.where(inner, latency["neuron_update"], 0),
        spike=spike,
        axon_out=latency["axon_out"],
        sender=sender,
        sending=spike[sender] + np.diff(first) * latency["axon_out"],
        first=first,
        destination=destination[on_core],
        processing=processing[on_core],
        route=route.reshape(-1),
        channel_first=np.searchsorted(slot[alone], np.arange(size, size + n_inputs + 1)),
        channel_destination=destination[alone],
        channel_processing=processing[alone],
        route_first=np.cumsum([0, *map(len, ways)]),
        route_link=np.array([link for way in ways for link in way], np.int64),
        route_hops=np.array([sum(hop[abs(a - b) == 1] for a, b in pairwise(way)) for way in tiles], np.float64),
        route_share=np.array([unit // (len(way) + 1) for way in ways], np.int64),
        unit=unit,
        capacity=int(table.link_buffer.value),
        barrier=table.barrier(len(np.unique(core_tile))),
    )


def _slots(
    tables: Tables, spikes: BoolArray, updated: BoolArray, events: EventArray
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Firing slots, working slots and events that nobody sends, as the kernels want them."""
    fired, worked, seen = (np.ascontiguousarray(bits).view(np.uint8) for bits in (spikes, updated, events != 0))
    if tables.sender.size == spikes.shape[2]:
        return fired, worked, seen
    sent = np.zeros((*spikes.shape[:2], seen.shape[1]), np.uint8)
    ahead = seen[:, :, 1 : spikes.shape[1] + 1]
    sent[:, : ahead.shape[2]] = ahead.transpose(0, 2, 1)
    return np.concatenate([fired, sent], 2), np.concatenate([worked, sent], 2), seen[:, :, :0]


def charges(tables: Tables) -> Charges:
    """What events add to each core's picoseconds of sweep and sending, then to those of receiving: ``2 * cores`` sums.

    The engine adds them up as it runs, without spike trains. The netlist's input channels are on no core.
    """
    cores, slots, channels = tables.access.size, tables.sender.size, tables.channel_first.size - 1
    sources, updates = np.zeros((channels + slots, 2 * cores), np.int64), np.zeros((slots, 2 * cores), np.int64)
    every = np.arange(slots)
    sources[channels + every, tables.sender] = tables.sending
    updates[every, tables.sender] = tables.update[tables.sender]
    channel = np.repeat(np.arange(channels), np.diff(tables.channel_first))
    np.add.at(sources, (channel, cores + tables.channel_destination), tables.channel_processing)
    slot = np.repeat(channels + every, np.diff(tables.first))
    np.add.at(sources, (slot, cores + tables.destination), tables.processing)
    return Charges(sources=sources, updates=updates)


def _ends(spent: npt.NDArray[Any], steps: IntArray, barrier: int) -> dict[str, Any]:
    """Fields of :class:`StepTimes`, of what cores take to send, then to receive, (samples, chip steps, 2 * cores)."""
    runs, longest = np.arange(spent.shape[1]) < steps[:, None], spent.argmax(axis=2)
    receives, core = np.divmod(longest, spent.shape[2] // 2)
    return {
        "duration_ns": np.where(runs, spent.max(axis=2) + barrier, 0) / PICOSECONDS,
        "critical_core": np.where(runs, core, -1),
        "receiving": runs & (receives == 1),
    }


def simple_times(tables: Tables, charged: IntArray, steps: IntArray) -> SimpleTimes:
    """Times of the simple model from what :func:`charges` added up to, (samples, chip steps, 2 * cores) int64.

    `steps` (samples,) are the chip steps of each recording.
    """
    cores = tables.access.size
    spent = charged.copy()
    spent[:, :, :cores] += np.diff(tables.start) * tables.access
    spent *= (np.arange(charged.shape[1]) < steps[:, None])[:, :, None]
    each = spent.sum(axis=1) / PICOSECONDS
    return SimpleTimes(
        **_ends(spent, steps, tables.barrier), generation_ns=each[:, :cores], processing_ns=each[:, cores:]
    )


def detailed(
    tables: Tables, spikes: BoolArray, updated: BoolArray, events: EventArray, *, steps: IntArray | None = None
) -> DetailedTimes:
    """Time a batch of recordings by the detailed model.

    `spikes` and `updated` (samples, chip steps, compartments) are a simulator's, see :class:`trace.Trace`, for `events`
    (samples, n_inputs, T); `steps` (samples,) are the chip steps of each recording, by default all.
    """
    fired, worked, events = _slots(tables, spikes, updated, events)
    cores, (samples, length) = tables.access.size, spikes.shape[:2]
    own = np.full(samples, length) if steps is None else steps
    blocked, peak = np.zeros((2, samples, length))
    spent = np.zeros((samples, length, 2 * cores))
    for i in range(samples):
        schedule(tables, fired[i], worked[i], events[i], int(own[i]), spent[i], blocked[i], peak[i])
    return DetailedTimes(
        **_ends(spent, own, tables.barrier),
        sent_ns=spent[:, :, :cores].max(axis=2) / PICOSECONDS,
        processed_ns=spent[:, :, cores:].max(axis=2) / PICOSECONDS,
        blocked_ns=blocked / PICOSECONDS,
        peak_load=peak,
    )
