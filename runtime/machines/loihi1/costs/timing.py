"""How long each chip step takes: a simple model from sums alone, and a detailed one that schedules every message.

*Simple.* The cores sweep their neurons and send, and they receive, both at once; a step lasts as long as the longest
of these, then the barrier.

*Detailed.* Every message is sent when the sweep reaches its neuron, crosses the mesh along x, then along y, slower
where others are under way and blocked where the links are full, and waits until the receiving core is free. A step
lasts until the last neuron is swept and the last message processed, then the barrier. The tests hold both models
against a plain definition, one message at a time.

Spikes of a step are sent and processed within that step and act in the next. *Input events* act in the step
in which they arrive: the receiving cores process them from its start, and nobody pays for their injection.

References
----------
.. [1] J. Boyle et al., "SANA-FE", IEEE TCAD 44(8), 3165-3178, 2025: the equations, and the fit to silicon (within
   25 % of the latency of three applications).
"""

from dataclasses import dataclass
from itertools import pairwise
from math import lcm

import numpy as np

from spikeloom.compiler.layer_kernel import require_below
from spikeloom.compiler.targets.base import PICOSECONDS, Target, TimeTable
from spikeloom.compiler.targets.loihi1.layout.place import chip_count, require_one_chip
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import AnyArray, BoolArray, EventArray, FloatArray, IntArray
from spikeloom.runtime.machines.loihi1.costs.timing_kernel import Tables, schedule
from spikeloom.runtime.machines.loihi1.trace import Charges

EAST, WEST, NORTH, SOUTH, PORTS = range(5)
"""Links of a tile: one that messages enter by for each direction in which they travel, then its cores' own ports."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepTimes:
    """What a model says of a batch of recordings; nothing happens after a recording's own steps."""

    duration_ns: FloatArray  # (samples, steps) float64; of each chip step, barrier included
    critical_core: (
        IntArray  # (samples, steps) int64; core that took longest; the lowest of several, -1 after the end
    )
    receiving: BoolArray  # (samples, steps) bool; whether it took longest to receive

    @property
    def seconds(self) -> FloatArray:
        """Of each recording; shape (samples,)."""
        return np.asarray(self.duration_ns.sum(axis=1) * 1e-9)

    def _spent(self, cores: int) -> dict[str, AnyArray]:
        """Fields of :class:`Spent`."""
        ran = self.critical_core >= 0
        critical, receiving = (
            np.bincount(self.critical_core[those], minlength=cores)[None] for those in (ran, self.receiving)
        )
        return {
            "duration_ns": self.duration_ns.sum(axis=1),
            "longest_ns": self.duration_ns.max(axis=1, initial=0),
            "critical": critical,
            "receiving": receiving,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spent:
    """What is kept of the steps of whole recordings, some of which were timed together, a batch."""

    duration_ns: FloatArray  # (samples,) float64
    longest_ns: FloatArray  # (samples,) float64; the longest step
    critical: IntArray  # (batches, cores) int64; steps in which a core took longest
    receiving: IntArray  # (batches, cores) int64; those of them in which it took longest to receive

    @property
    def seconds(self) -> FloatArray:
        """Of each recording; shape (samples,)."""
        return np.asarray(self.duration_ns * 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimpleSpent(Spent):
    """As in :class:`SimpleTimes`."""

    generation_ns: FloatArray
    processing_ns: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetailedSpent(Spent):
    """Also, each (samples,) float64, how long cores were blocked, and the most messages on any link."""

    blocked_ns: FloatArray
    peak_load: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimpleTimes(StepTimes):
    """Also (samples, cores) float64: how long each core sweeps and sends, and how long it receives, in all steps."""

    generation_ns: FloatArray
    processing_ns: FloatArray

    def spent(self, cores: int) -> SimpleSpent:
        """By recording."""
        return SimpleSpent(
            **self._spent(cores), generation_ns=self.generation_ns, processing_ns=self.processing_ns
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetailedTimes(StepTimes):
    """Also, each (samples, steps) float64, what queues and the mesh do."""

    # when the last core ended its sweep and sending, and when the last message was processed
    sent_ns: FloatArray
    processed_ns: FloatArray
    blocked_ns: (
        FloatArray  # for which cores could not send because the links were full, summed over the cores
    )
    # most messages on any link at any time; one on its way counts as one spread evenly over its links and
    # its end
    peak_load: FloatArray

    def spent(self, cores: int) -> DetailedSpent:
        """By recording."""
        return DetailedSpent(
            **self._spent(cores),
            blocked_ns=self.blocked_ns.sum(axis=1),
            peak_load=self.peak_load.max(axis=1, initial=0),
        )


def _way(start: int, end: int, port: int, width: int, tile_links: int) -> list[int]:
    """Links from a core to a tile, along x first: the core's port, then the link by which each further tile is entered.

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


def prepare(netlist: Netlist, target: Target, table: TimeTable) -> Tables:
    """Lay a netlist out for the time models; OptionError if it takes several chips."""
    require_one_chip(netlist.core_tile, target, "time")
    tile = netlist.core_tile
    n_inputs = netlist.n_inputs
    n_cores = netlist.n_cores
    latency = {event: table.picoseconds(event) for event in table.latencies}
    dense = netlist.format_index_bits[netlist.axon_format] == 0
    synapse = np.where(dense, latency["synaptic_operation_dense"], latency["synaptic_operation_sparse"])
    processing = latency["axon_in"] + np.diff(netlist.axon_synapses) * synapse
    destination = netlist.core_of_axon()
    width = target.limit("mesh.width")
    tile_cores = target.limit("mesh.tile_cores")
    port = np.array([np.sum(tile[:core] == tile[core]) for core in range(n_cores)])
    # the messages of a spike go out in the order of columns, rows and cores of a tile, as the reference has
    # it
    rank = np.lexsort((port, tile // width, tile % width)).argsort()
    order = np.lexsort((rank[destination], netlist.axon_source))
    from_input = netlist.axon_source[order] < n_inputs
    injected = order[from_input]
    sent = order[~from_input]

    slot = netlist.axon_source[sent] - n_inputs
    sender = netlist.core_of_compartment()
    first = np.searchsorted(slot, np.arange(netlist.n_compartments + 1))
    pairs, route = np.unique(sender[slot] * n_cores + destination[sent], return_inverse=True)
    ways = [
        _way(int(tile[a]), int(tile[b]), int(port[a]), width, PORTS + tile_cores)
        for a, b in (divmod(int(pair), n_cores) for pair in pairs)
    ]
    tiles = [[link // (PORTS + tile_cores) for link in way] for way in ways]
    hop = {True: latency["hop_east_west"], False: latency["hop_north_south"]}
    unit = lcm(*(len(way) + 1 for way in ways))
    return Tables(
        start=netlist.core_compartments,
        access=latency["neuron_access"],
        update=latency["neuron_update"],
        spike=latency["spike"],
        axon_out=latency["axon_out"],
        sender=sender,
        sending=latency["spike"] + np.diff(first) * latency["axon_out"],
        first=first,
        destination=destination[sent],
        processing=processing[sent],
        route=route.reshape(-1),
        channel_first=np.searchsorted(netlist.axon_source[injected], np.arange(n_inputs + 1)),
        channel_destination=destination[injected],
        channel_processing=processing[injected],
        route_first=np.cumsum([0, *map(len, ways)]),
        route_link=np.array([link for way in ways for link in way], np.int64),
        route_hops=np.array(
            [sum(hop[abs(a - b) == 1] for a, b in pairwise(way)) for way in tiles], np.float64
        ),
        route_share=np.array([unit // (len(way) + 1) for way in ways], np.int64),
        unit=unit,
        capacity=int(table.link_buffer.value),
        barrier=table.barrier(len(np.unique(tile))),
    )


def tables_of(netlist: Netlist, target: Target) -> dict[str, Tables]:
    """For each of the chip's time tables; none for several chips, whose links have no public latency."""
    if chip_count(netlist.core_tile, target) > 1:
        return {}
    return {table.name: prepare(netlist, target, table) for table in target.time}


def charges(tables: Tables) -> Charges:
    """What events add to each core's picoseconds of sweep and sending, then to those of receiving: ``2 * cores`` sums.

    The engine adds them up as it runs, without spike trains.
    """
    cores = tables.start.size - 1
    size = tables.sender.size
    channels = tables.channel_first.size - 1
    sources = np.zeros((channels + size, 2 * cores), np.int64)
    updates = np.zeros((size, 2 * cores), np.int64)
    every = np.arange(size)
    sources[channels + every, tables.sender] = tables.sending
    updates[every, tables.sender] = tables.update
    channel = np.repeat(np.arange(channels), np.diff(tables.channel_first))
    np.add.at(sources, (channel, cores + tables.channel_destination), tables.channel_processing)
    slot = np.repeat(channels + every, np.diff(tables.first))
    np.add.at(sources, (slot, cores + tables.destination), tables.processing)
    return Charges(sources=sources, updates=updates)


def _ends(spent: AnyArray, steps: IntArray, barrier: int) -> dict[str, AnyArray]:
    """Fields of :class:`StepTimes`, of what cores take to send, then to receive, (samples, chip steps, 2 * cores)."""
    runs = np.arange(spent.shape[1]) < steps[:, None]
    longest = spent.argmax(axis=2)
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
    cores = tables.start.size - 1
    spent = charged.copy()
    spent[:, :, :cores] += np.diff(tables.start) * tables.access
    spent *= (np.arange(charged.shape[1]) < steps[:, None])[:, :, None]
    each = spent.sum(axis=1) / PICOSECONDS
    return SimpleTimes(
        **_ends(spent, steps, tables.barrier), generation_ns=each[:, :cores], processing_ns=each[:, cores:]
    )


def detailed(
    tables: Tables,
    spikes: BoolArray,
    updated: BoolArray,
    events: EventArray,
    *,
    steps: IntArray | None = None,
) -> DetailedTimes:
    """Time a batch of recordings by the detailed model.

    `spikes` and `updated` (samples, chip steps, compartments) are a simulator's, see :class:`trace.Trace`,
    for `events` (samples, n_inputs, T); `steps` (samples,) are the chip steps of each recording, by default
    all.
    """
    fired, worked, seen = (
        np.ascontiguousarray(bits).view(np.uint8) for bits in (spikes, updated, events != 0)
    )
    cores = tables.start.size - 1
    samples, length, _ = spikes.shape
    lengths = np.full(samples, length) if steps is None else steps
    require_below("compartments", np.array(fired.shape[2]), tables.sender.size + 1)
    require_below("channels", np.array(seen.shape[1]), tables.channel_first.size)
    require_below("chip steps", lengths, length + 1)
    blocked, peak = np.zeros((2, samples, length))
    spent = np.zeros((samples, length, 2 * cores))
    for i in range(samples):
        schedule(tables, fired[i], worked[i], seen[i], int(lengths[i]), spent[i], blocked[i], peak[i])
    return DetailedTimes(
        **_ends(spent, lengths, tables.barrier),
        sent_ns=spent[:, :, :cores].max(axis=2) / PICOSECONDS,
        processed_ns=spent[:, :, cores:].max(axis=2) / PICOSECONDS,
        blocked_ns=blocked / PICOSECONDS,
        peak_load=peak,
    )
