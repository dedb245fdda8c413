"""The definition of the two time models of :mod:`costs.timing`: plain Python, one message at a time.

Both must agree on every figure, exactly. All times are picoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy.sparse import csr_array

from spikeloom.compiler.formats.sanafe import dense_neurons
from spikeloom.compiler.targets.base import Target, TimeTable
from spikeloom.compiler.targets.loihi1.layout.place import hops
from spikeloom.compiler.targets.loihi1.netlist import Netlist
from spikeloom.compiler.types import BoolArray, EventArray
from spikeloom.runtime.machines.loihi1.costs import cost
from spikeloom.runtime.machines.loihi1.costs.timing import SimpleTimes, charges, simple_times
from spikeloom.runtime.machines.loihi1.costs.timing_kernel import Tables

Link = tuple[int, int, str]


@dataclass(slots=True, kw_only=True)
class Message:
    """What a core does up to the end of one message, or after its last one, whose destination is -1.

    `generation` is the work of the sender since its message before, `processing` that of the receiver; `sent` and
    `received` are times within the step.
    """

    source: int
    destination: int
    generation: int
    processing: int
    sent: float = 0.0
    received: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StepTimes:
    """One step of a recording; see :class:`timing.DetailedTimes` for the meaning of the fields."""

    generation: list[int]
    processing: list[int]
    simple: int
    detailed: float
    sent: float
    processed: float
    blocked: float
    critical_core: int
    receiving: bool
    peak_load: float


class Chip:
    """Where everything is and what it takes."""

    def __init__(
        self,
        netlist: Netlist,
        target: Target,
        table: TimeTable,
        input_tiles: tuple[int, ...] = (),
        dense=None,
    ) -> None:
        """SANA-FE has the channels on cores of certain tiles, and says itself which synapses are `dense`."""
        self.netlist = netlist
        self.table = table
        self.inputs_on_core = bool(input_tiles)
        self.tile = [*netlist.core_tile.tolist(), *input_tiles]
        self.width = target.limit("mesh.width")
        room = target.limit("core.compartments")
        bounds = netlist.core_compartments.tolist()
        # sources in the order in which each core sweeps them
        self.sweep = [
            [netlist.n_inputs + c for c in range(bounds[k], bounds[k + 1])] for k in range(netlist.n_cores)
        ] + [list(range(netlist.n_inputs))[i * room : (i + 1) * room] for i in range(len(input_tiles))]
        core_of_axon = netlist.core_of_axon().tolist()
        self.deliveries: dict[int, list[tuple[int, int]]] = {}
        if dense is None:
            dense = netlist.format_index_bits[netlist.axon_format[netlist.axon_of_synapse()]] == 0
        costs = [table.picoseconds(f"synaptic_operation_{form}") for form in ("sparse", "dense")]
        for axon, source in enumerate(netlist.axon_source.tolist()):
            synapses = dense[netlist.axon_synapses[axon] : netlist.axon_synapses[axon + 1]]
            work = table.picoseconds("axon_in") + sum(costs[int(each)] for each in synapses)
            self.deliveries.setdefault(source, []).append((core_of_axon[axon], work))
        for deliveries in self.deliveries.values():
            # messages of one spike go out in the order of columns, rows and cores of a tile
            deliveries.sort(key=lambda delivery: (*self.place(delivery[0]), delivery[0]))

    def place(self, core: int) -> tuple[int, int]:
        """Column and row of a core's tile."""
        return self.tile[core] % self.width, self.tile[core] // self.width

    def way(self, source: int, destination: int) -> list[Link]:
        """Links from core to core: the sender's own port, then the one by which each further tile is entered."""
        (x, y), (to_x, to_y) = self.place(source), self.place(destination)
        links: list[Link] = [(x, y, f"core {source}")]
        step_x, step_y = (1 if to_x > x else -1), (1 if to_y > y else -1)
        links += [(column, y, f"x {step_x}") for column in range(x + step_x, to_x + step_x, step_x)]
        links += [(to_x, row, f"y {step_y}") for row in range(y + step_y, to_y + step_y, step_y)]
        return links

    def flight(self, source: int, destination: int) -> int:
        """Least time from core to core."""
        (x, y), (to_x, to_y) = self.place(source), self.place(destination)
        east_west, north_south = (
            self.table.picoseconds(f"hop_{way}") for way in ("east_west", "north_south")
        )
        return abs(x - to_x) * east_west + abs(y - to_y) * north_south

    def messages(self, core: int, fired: set[int], worked: set[int]) -> list[Message]:
        """What one core sends in a step, in order."""
        is_input = core >= self.netlist.n_cores
        access, update, spike = (
            0 if is_input else self.table.picoseconds(event)
            for event in ("neuron_access", "neuron_update", "spike")
        )
        messages = []
        since = 0
        for source in self.sweep[core]:
            since += access + update * (source in worked)
            if source in fired:
                since += spike
                for destination, work in self.deliveries.get(source, []):
                    since += self.table.picoseconds("axon_out")
                    messages.append(
                        Message(source=core, destination=destination, generation=since, processing=work)
                    )
                    since = 0
        if since:
            messages.append(Message(source=core, destination=-1, generation=since, processing=0))
        return messages

    def step(self, fired: set[int], worked: set[int], injected: set[int]) -> StepTimes:
        """Time a step in which sources on cores `fired` or `worked`, and channels on no core were `injected`."""
        cores = range(len(self.tile))
        waiting = [self.messages(core, fired, worked) for core in cores]
        barrier = self.table.barrier(len(set(self.tile)))
        given = [0 for _ in cores]
        for channel in injected:
            for destination, work in self.deliveries.get(channel, []):
                given[destination] += work

        generation = [sum(message.generation for message in waiting[core]) for core in cores]
        processing = [
            given[core] + sum(m.processing for queue in waiting for m in queue if m.destination == core)
            for core in cores
        ]

        free = [float(work) for work in given]  # when each core has processed what it received
        done = [0.0 for _ in cores]  # when each core ended what it sends
        mesh: list[Message] = []
        blocked, peak = 0.0, Fraction(0)
        while any(waiting):
            # the earliest message of all cores; of several at one time that of the lowest core
            core = min(
                (c for c in cores if waiting[c]), key=lambda c: (done[c] + waiting[c][0].generation, c)
            )
            message = waiting[core].pop(0)
            message.sent = done[core] + message.generation
            if message.destination >= 0:
                mesh = [other for other in mesh if other.received > message.sent]
                way = self.way(core, message.destination)
                along = float(sum((self.load(mesh, link) for link in way), Fraction(0)))
                mean = sum(other.processing for other in mesh) / len(mesh) if mesh else 0.0
                capacity = len(way) * int(self.table.link_buffer.value)
                if along > capacity:
                    block = (along - capacity) * mean
                    blocked += block
                    message.sent += block
                arrival = message.sent + max(self.flight(core, message.destination), along * mean / len(way))
                message.received = max(free[message.destination], arrival)
                free[message.destination] = message.received + message.processing
                mesh.append(message)
                peak = max(peak, *(self.load(mesh, link) for link in way))
            done[core] = message.sent

        sent, processed = max(done), max(free)
        return StepTimes(
            generation=generation,
            processing=processing,
            simple=max(generation + processing) + barrier,
            detailed=max(sent, processed) + barrier,
            sent=sent,
            processed=processed,
            blocked=blocked,
            critical_core=free.index(processed) if processed > sent else done.index(sent),
            receiving=processed > sent,
            peak_load=float(peak),
        )

    def load(self, mesh: list[Message], link: Link) -> Fraction:
        """Messages on a link: each is spread evenly over the links of its way and its end."""
        ways = [self.way(message.source, message.destination) for message in mesh]
        return sum((Fraction(1, len(way) + 1) for way in ways if link in way), Fraction(0))

    def run(self, spikes: BoolArray, updated: BoolArray, events: EventArray) -> list[StepTimes]:
        """Time one recording: `spikes` and `updated` (chip steps, compartments), `events` (n_inputs, T)."""
        times = []
        for t in range(len(spikes)):
            fired = {self.netlist.n_inputs + int(c) for c in np.flatnonzero(spikes[t])}
            worked = {self.netlist.n_inputs + int(c) for c in np.flatnonzero(updated[t])}
            step = t + 1 if self.inputs_on_core else t  # a channel on a core sends in the step before
            channels = {int(c) for c in np.flatnonzero(events[:, step])} if step < events.shape[1] else set()
            if self.inputs_on_core:
                times.append(self.step(fired | channels, worked, set()))
            else:
                times.append(self.step(fired, worked, channels))
        return times


def simple(tables: Tables, spikes: BoolArray, updated: BoolArray, events: EventArray) -> SimpleTimes:
    """Times of the simple model from spikes and updates (samples, chip steps, compartments), by what they add up to."""
    charged, channels = charges(tables), len(tables.channel_first) - 1
    sums = spikes.astype(np.int64) @ charged.sources[channels:] + updated.astype(np.int64) @ charged.updates
    now = (events[:, :, : spikes.shape[1]] != 0).transpose(0, 2, 1).astype(np.int64)
    sums[:, : now.shape[1]] += now @ charged.sources[:channels]
    return simple_times(tables, sums, np.full(len(spikes), spikes.shape[1]))


def parts_of_energy(netlist, target, counts, updates, steps, tiles, dense=None):
    """Joules of the table ``sanafe`` by part, (samples, 1), if channels are neurons of cores on certain tiles.

    `updates` are (samples,), `dense` says which synapses are priced as such.
    """
    amounts = cost.count(
        cost.prepare(netlist, target, "whole"), replace(counts, updates=updates[:, None]), steps
    )
    sent = netlist.axon_source < netlist.n_inputs
    source, end = netlist.axon_source[sent], netlist.core_tile[netlist.core_of_axon()[sent]]
    way = hops(np.array(tiles)[source // target.limit("core.compartments")], end, target.limit("mesh.width"))
    for name, each in zip(
        ("packet", "hop_east_west", "hop_north_south"), (np.ones_like(end), *way), strict=True
    ):
        amounts[name] = amounts[name] + (counts.inputs[:, source] @ each)[:, None]
    if dense is not None:
        sources = np.concatenate([counts.inputs, counts.spikes], axis=1)
        visited = sources[:, netlist.axon_source[netlist.axon_of_synapse()]]
        for form, which in (("dense", dense), ("sparse", ~dense)):
            amounts[f"synaptic_operation_{form}"] = (
                visited[:, which].sum(axis=1, keepdims=True).astype(np.float64)
            )
    return cost.by_part(target, amounts)["sanafe"]


def dense_synapses(netlist):
    """Which synapses the file has priced as dense; shape (synapses,)."""
    return dense_neurons(netlist)[netlist.synapse_compartment()]


def updates(netlist, events, spikes, membranes):
    """Neuron updates (samples, chip steps, compartments) of a run without windows.

    A current that the step before left is no work to it. Only a neuron at rest, without bias, that nothing reaches
    can have no other work; the other updates are those of :class:`trace.Trace`.
    """
    samples, steps, size = spikes.shape
    works = np.zeros(spikes.shape, np.bool_)
    works[:, 1:] = (membranes[:, :-1] != 0) & ~spikes[:, :-1]
    works[:, :, netlist.bias_mantissa != 0] = True
    sources = np.zeros((samples, steps, netlist.n_inputs + size), np.int32)
    given = events[:, :, :steps] != 0
    sources[:, : given.shape[2], : netlist.n_inputs] = given.transpose(0, 2, 1)
    sources[:, 1:, netlist.n_inputs :] = spikes[:, :-1]
    resting = np.flatnonzero(netlist.bias_mantissa == 0)
    source, target = netlist.axon_source[netlist.axon_of_synapse()], netlist.synapse_compartment()
    own = np.isin(target, resting)
    shape = (netlist.n_inputs + size, size)
    reach = csr_array((np.ones(int(own.sum()), np.int32), (source[own], target[own])), shape)[:, resting]
    for i in range(samples):
        works[i][:, resting] |= (sources[i] @ reach) > 0
    return works
