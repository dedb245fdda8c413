"""Loops of :mod:`costs.timing`, compiled with numba.

Latencies are whole picoseconds and link loads are whole multiples of one over ``Tables.unit``, so sums
neither round nor depend on their order. Only what congestion and blocking add is fractional.

*Who is next.* Of equal times the lower core comes first. Messages to one core arrive in the order in which they are
sent, so each core needs only a queue.
"""

from typing import Any, NamedTuple

import numpy as np

from spikeloom.compiler.layer_kernel import compiled, compiled_and_cached
from spikeloom.compiler.types import AnyArray, FloatArray, IntArray


class Tables(NamedTuple):
    """A placed netlist as the time models see it; nothing in here changes."""

    start: IntArray  # (cores + 1,) int64; bounds of each core in the compartments
    # access, update, spike: Picoseconds of a compartment in the sweep of its core
    access: int
    update: int
    spike: int
    axon_out: int  # Picoseconds of a message at its sender
    # sender, sending: (compartments,) int64; core of each, and picoseconds of a spike there, messages
    # included
    sender: IntArray
    sending: IntArray
    first: IntArray  # (compartments + 1,) int64; bounds of each compartment in the deliveries
    # destination, processing, route: (deliveries,) int64; core that receives it, picoseconds that it takes
    # there, and way that it goes
    destination: IntArray
    processing: IntArray
    route: IntArray
    # channel_first, channel_destination, channel_processing: The same for input channels, which are on no
    # core and go no way
    channel_first: IntArray
    channel_destination: IntArray
    channel_processing: IntArray
    # route_first, route_link: Bounds of each way in the links, and the links, the sender's own port first
    route_first: IntArray
    route_link: IntArray
    route_hops: FloatArray  # (ways,) float64; picoseconds of the hops
    # (ways,) int64; what one message adds to each link of its way, ``unit / (links + 1)``, a whole number
    route_share: IntArray
    unit: int  # What a load of one message is counted as
    capacity: int  # Messages that a link holds
    barrier: int  # Picoseconds that end each step


@compiled
def _inject(
    first: IntArray, destination: IntArray, cost: IntArray, events: AnyArray, t: int, busy: Any
) -> None:
    """Let each core process the input events of a step."""
    if t < events.shape[1]:
        for channel in range(first.size - 1):
            if events[channel, t]:
                for a in range(first[channel], first[channel + 1]):
                    busy[destination[a]] += cost[a]


@compiled
def _list_messages(
    tables: Tables,
    row: AnyArray,
    worked: AnyArray,
    delivery: IntArray,
    generation: IntArray,
    queue: IntArray,
) -> None:
    """List what each core sends in a step: delivery (-1 for work after its last message) and time it takes."""
    start = tables.start
    first = tables.first
    axon_out = tables.axon_out
    access = tables.access
    update = tables.update
    spike = tables.spike
    n = 0
    for core in range(start.size - 1):
        queue[core] = n
        spent = 0
        for i in range(start[core], start[core + 1]):
            spent += access + (update if worked[i] else 0)
            if row[i]:
                spent += spike
                for a in range(first[i], first[i + 1]):
                    delivery[n] = a
                    generation[n] = spent + axon_out
                    spent = 0
                    n += 1
        if spent:
            delivery[n] = -1
            generation[n] = spent
            n += 1
    queue[start.size - 1] = n


@compiled
def _wait(first: int, end: int, route_link: IntArray, load: IntArray, unit: int) -> float:
    """Messages along a way."""
    total = 0
    for i in range(first, end):
        total += load[route_link[i]]
    return float(total / unit)


@compiled
def _occupy(first: int, end: int, route_link: IntArray, load: IntArray, share: int) -> int:
    """Add to the links of a way; return the highest load on it."""
    highest = 0
    for i in range(first, end):
        link = route_link[i]
        load[link] += share
        highest = max(highest, load[link])
    return highest


@compiled
def _send_all(  # noqa: PLR0915 - one loop over local state, which numba passes to parts of it only at a price
    tables: Tables,
    delivery: IntArray,
    generation: IntArray,
    queue: IntArray,
    received: FloatArray,
    later: IntArray,
    load: IntArray,
    done: FloatArray,
    free: FloatArray,
) -> tuple[float, float]:
    """Send the messages of a step; return for how long cores were blocked and the highest load of a link."""
    # an array taken out of a tuple costs more than a message: take them out once
    destination = tables.destination
    processing = tables.processing
    route = tables.route
    route_first = tables.route_first
    route_link = tables.route_link
    route_share = tables.route_share
    route_hops = tables.route_hops
    unit = tables.unit
    cores = done.size
    due = np.full(cores, np.inf)
    arrives = np.full(cores, np.inf)
    cursor = queue[:cores].copy()
    front = np.full(cores, -1)
    back = np.empty(cores, np.int64)
    for core in range(cores):
        if queue[core] < queue[core + 1]:
            due[core] = generation[queue[core]]
    under_way = 0
    work_under_way: Any = 0
    blocked = 0.0
    peak = 0
    while True:
        core = int(np.argmin(due))
        if due[core] == np.inf:
            return blocked, peak / unit
        m = cursor[core]
        sent = due[core]
        a = delivery[m]
        if a >= 0:
            # what has arrived leaves the mesh
            to = int(np.argmin(arrives))
            while arrives[to] <= sent:
                gone = front[to]
                other = delivery[gone]
                way = route[other]
                _occupy(route_first[way], route_first[way + 1], route_link, load, -route_share[way])
                under_way -= 1
                work_under_way -= processing[other]
                front[to] = later[gone]
                arrives[to] = np.inf if later[gone] < 0 else received[later[gone]]
                to = int(np.argmin(arrives))
            # what is under way slows or blocks the message
            way = route[a]
            begin = route_first[way]
            end = route_first[way + 1]
            links = end - begin
            along = _wait(begin, end, route_link, load, unit)
            mean = work_under_way / under_way if under_way else 0.0
            if along > links * tables.capacity:
                block = (along - links * tables.capacity) * mean
                blocked += block
                sent += block
            to = destination[a]
            received[m] = max(free[to], sent + max(route_hops[way], along * mean / links))
            free[to] = received[m] + processing[a]
            # it enters the mesh
            peak = max(peak, _occupy(begin, end, route_link, load, route_share[way]))
            under_way += 1
            work_under_way += processing[a]
            later[m] = -1
            if front[to] < 0:
                front[to] = m
                arrives[to] = received[m]
            else:
                later[back[to]] = m
            back[to] = m
        done[core] = sent
        cursor[core] = m + 1
        due[core] = sent + generation[m + 1] if m + 1 < queue[core + 1] else np.inf


@compiled_and_cached
def schedule(
    tables: Tables,
    fired: AnyArray,
    updated: AnyArray,
    events: AnyArray,
    steps: int,
    spent: FloatArray,
    blocked: FloatArray,
    peak: FloatArray,
) -> None:
    """Send the messages of each step of a recording in the order of time.

    Filled are `spent` (steps, 2 * cores), from zeros: when each core has sent everything, then when it has
    processed everything; and as :func:`_send_all` says `blocked` and `peak` (steps,). Times are picoseconds.
    """
    cores = tables.start.size - 1
    most = tables.destination.size + cores
    delivery = np.empty(most, np.int64)
    generation = np.empty(most, np.int64)
    later = np.empty(most, np.int64)
    received = np.empty(most, np.float64)
    queue = np.empty(cores + 1, np.int64)
    load = np.zeros(tables.route_link.max() + 1 if tables.route_link.size else 0, np.int64)
    first = tables.channel_first
    destination = tables.channel_destination
    cost = tables.channel_processing
    for t in range(steps):
        load[:] = 0
        done = spent[t, :cores]
        free = spent[t, cores:]
        _inject(first, destination, cost, events, t, free)
        _list_messages(tables, fired[t], updated[t], delivery, generation, queue)
        blocked[t], peak[t] = _send_all(
            tables, delivery, generation, queue, received, later, load, done, free
        )
