"""How few events alter a decision of a counting network: the least number, by what its counters and sums are.

A count of events in a channel, in a part of the recording, says which counters have spiked, and how often;
a class is decided by the first sum above the threshold, which a ramp lifts: the sums after the last event
decide. To change a count by so many events costs as many, whichever they are. So the fewest events with
which a class overtakes the decision are found by a dynamic program over channels and parts: for each
number of them and each sum of the decision the largest sum of the other class. Sums that cross the
threshold before the last event are bounded: an event more or less alters one count by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import floor

import numpy as np
from numpy.typing import NDArray

from spikeloom.compiler.counters import BLOCK, Counters
from spikeloom.compiler.ir import Sparse, added_up
from spikeloom.compiler.targets.compartments import MEMBRANE_MAX, MEMBRANE_SHIFT, IntegerNetwork
from spikeloom.compiler.types import BoolArray, IntArray
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.capabilities import Comparable
from spikeloom.runtime.machines.counting import Counting
from spikeloom.runtime.studies.robustness.proofs.entries import Cells

FAR = 1 << 40
"""Beyond every sum."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tally:
    """A counting network as whole numbers in membrane units."""

    group: IntArray  # (counters,) int64; part * channels + channel
    count: IntArray  # (counters,) int64; event at which it spikes
    weight: IntArray  # (classes, counters) int64
    slope: int
    threshold: int
    channels: int
    part: int  # Steps of a part
    steps: int
    late: bool = False  # Whether membranes are the sums from the last event on only, see :class:`Counting`

    def times(self, those: IntArray | slice, events: IntArray) -> IntArray:
        """How often some counters spike within so many events of each, (…, counters)."""
        count = self.count[those]
        return np.where(events < count, 0, 1 + (events - count) // (count + BLOCK))

    def of(self, those: IntArray | slice, events: IntArray) -> IntArray:
        """What some counters add to the sums after so many events of each, (…, counters); (…, classes)."""
        return np.asarray(self.times(those, events) @ self.weight[:, those].T)

    def highest(self, those: IntArray | slice, events: IntArray, end: IntArray) -> IntArray:
        """Most that they can have added after so many events of each, if there are so many in the end."""
        if not self.late:
            return self.of(those, events)
        weight = self.weight[:, those].T
        above = self.times(those, end) @ np.maximum(weight, 0)
        return np.asarray(above + self.times(those, events) @ np.minimum(weight, 0))

    @cached_property
    def largest(self) -> int:
        """Most that an event adds to a sum, or takes from it."""
        counts = np.arange(self.steps + 1)[:, None]
        weight = 2 * np.abs(self.weight) if self.late else self.weight  # twice: in the end, and before it
        each = (np.flatnonzero(self.group == group) for group in np.unique(self.group))
        added = (np.diff(self.times(those, counts), axis=0) @ weight[:, those].T for those in each)
        return max(int(np.abs(one).max()) for one in added)

    def groups(self, channel: IntArray, step: IntArray) -> IntArray:
        """Groups of entries."""
        return step // self.part * self.channels + channel

    def events(self, recording: BoolArray) -> IntArray:
        """Events of each group after each step of a recording (channels, steps); (steps of the network, groups)."""
        channel, step = np.nonzero(recording)
        arrived = np.zeros((self.steps, int(self.group.max()) + self.channels), np.int64)
        group = self.groups(channel, step)
        inside = group < arrived.shape[1]
        np.add.at(arrived, (step[inside], group[inside]), 1)
        return arrived.cumsum(axis=0)


def tally_of(machine: Machine) -> Tally | None:
    """What a counting network (:mod:`formats.counters`) is on the chip; None where a network is none."""
    if isinstance(machine, Counting):
        return None if machine.counters is None else _tally(machine.counters)
    length = machine.netlist.clocks.length
    if machine.layers[-2:] != ("sums", "votes") or length is None or not isinstance(machine, Comparable):
        return None
    network: IntegerNetwork = machine.integer
    names = [population.name for population in network.populations]
    into: dict[int, dict[int, Sparse]] = {}
    for post in range(len(names)):
        into[post] = added_up((p.pre, p.effective()) for p in network.projections if p.post == post)
    sums = len(names) - 2
    group = []
    count = []
    weight = []
    for pre, weights in into[sums].items():
        ones = next(each for source, each in into[pre].items() if source != pre).tocoo()
        place = np.full(network.populations[pre].size, -1)
        place[ones.row] = ones.col  # a channel, or the gate of a channel in a part: numbered as groups are
        counters = np.flatnonzero(place >= 0)
        group.append(place[counters])
        count.append(network.populations[pre].threshold[counters] // int(ones.data.max(initial=1)) + 1)
        weight.append(weights.toarray()[:, counters].astype(np.int64) << MEMBRANE_SHIFT)
    last = network.populations[sums]
    return Tally(
        group=np.concatenate(group),
        count=np.concatenate(count),
        weight=np.concatenate(weight, axis=1),
        slope=int(last.bias[0]),
        threshold=int(last.threshold[0]) << MEMBRANE_SHIFT,
        channels=network.input.taxels * network.input.polarities,
        part=network.input.clocks.steps if network.input.clocks.channels else length,
        steps=length,
    )


def _tally(counters: Counters) -> Tally:
    """What a network is on a chip that holds it as it is."""
    channels = counters.taxels * counters.polarities
    length = counters.steps + counters.ramp
    channel, part, count = counters.counter.T
    return Tally(
        group=part * channels + channel,
        count=count,
        weight=counters.weight << MEMBRANE_SHIFT,
        slope=int(counters.slope) << MEMBRANE_SHIFT,
        threshold=floor(counters.threshold) << MEMBRANE_SHIFT,
        channels=channels,
        part=counters.clocks.steps if counters.parts > 1 else length,
        steps=length,
        late=True,
    )


@dataclass(frozen=True, slots=True)
class _Option:
    """Another number of events in a group: what it costs, what it adds to the sums, and entries to flip."""

    cost: int
    gain: IntArray  # (classes,)
    flips: IntArray


def least(
    tally: Tally, recording: BoolArray, votes: IntArray, cells: Cells, most: int
) -> tuple[int, IntArray | None] | None:
    """How many events, up to `most`, do not alter the decision of a recording, whichever they are.

    The recording is (channels, steps), its votes (classes,). Also entries whose flips alter it, the fewest
    if there are one more of them. None where the chip does not follow the counts alone; where it does,
    entries of one group that hold events, and those that hold none, do the same.
    """
    recording = recording[: tally.channels]  # without clocks
    ramp = tally.slope * np.arange(1, tally.steps + 1)[:, None]
    events = tally.events(recording)[:, tally.group]
    membranes = tally.of(slice(None), events) + ramp  # without a reset
    above = membranes > tally.threshold
    crossing = np.where(above.any(axis=0), above.argmax(axis=0), tally.steps)
    last = int(cells.cells[-1, 1])
    decision = int(np.argmax(votes))
    room = MEMBRANE_MAX + int(membranes.min())
    most = min(most, max(room - 1, 0) // max(tally.largest, 1))  # beyond that a sum might saturate
    highest = (tally.highest(slice(None), events, events[-1:]) + ramp)[: last + 1]
    classes = np.arange(len(votes))
    early = _early(tally, recording, highest, np.delete(classes, decision), most)
    if np.any(tally.steps - crossing != votes) or crossing[decision] <= last or early < 2:
        return None
    if _early(tally, recording, highest, classes, 1) < 2:  # then it matters when an event comes
        return None
    options = _options(tally, recording, cells, most)
    sums = membranes[-1] - tally.slope * tally.steps
    best = most + 1
    taken = None
    for other in sorted(set(range(len(votes))) - {decision}, key=lambda other: -sums[other]):
        attack = _against(tally, options, sums, decision, other, last, best - 1)
        if attack is not None:
            best, taken = attack
    return min(best, early) - 1, taken


def _options(tally: Tally, recording: BoolArray, cells: Cells, most: int) -> list[list[_Option]]:
    """What can become of the events of each group that has counters, for up to `most` of them."""
    by_group = []
    events = tally.events(recording)[-1]
    group = tally.groups(*cells.cells.T)
    for each in np.unique(tally.group).tolist():
        counters = np.flatnonzero(tally.group == each)
        here = np.flatnonzero(group == each)
        known = tally.of(counters, events[each])
        options = []
        before = known
        there = cells.there[here]
        gone = here[there][np.argsort(cells.cost[here[there]], kind="stable")]
        for flips in (gone, here[~there]):
            costs = np.cumsum(cells.cost[flips])
            sign = -1 if flips is gone else 1
            for n in range(int(np.searchsorted(costs, most, side="right"))):
                after = tally.of(counters, events[each] + sign * (n + 1))
                if np.any(after != (before if n else known)):
                    options.append(_Option(int(costs[n]), after - known, flips[: n + 1]))
                before = after
        by_group.append(options)
    return by_group


def _early(tally: Tally, recording: BoolArray, membranes: IntArray, classes: IntArray, most: int) -> int:
    """Events, up to one more than `most`, that it takes at least to lift one of some classes above the threshold soon.

    `membranes` (steps, all classes) are those of the steps up to the last with events, or the most they can be.
    """
    membranes = membranes[:, classes]
    events = tally.events(recording)[: len(membranes)]
    near = np.flatnonzero((membranes + most * tally.largest > tally.threshold).any(axis=1))
    lead = np.zeros((most + 1, len(near), len(classes)), np.int64)
    for each in np.unique(tally.group).tolist():
        counters = np.flatnonzero(tally.group == each)
        before = lead.copy()
        seen = events[near, each][:, None]
        end = events[-1:, each][:, None]
        known = tally.highest(counters, seen, end)[:, classes]
        for count in range(1, most + 1):
            for sign in (-1, 1):
                gain = tally.highest(counters, seen + sign * count, end + count)[:, classes] - known
                if gain.any():
                    lead[count:] = np.maximum(lead[count:], before[: most + 1 - count] + gain)
    above = (lead + membranes[near] > tally.threshold).any(axis=(1, 2))
    return int(np.argmax(above)) if above.any() else most + 1


def _against(
    tally: Tally,
    options: list[list[_Option]],
    sums: IntArray,
    decision: int,
    other: int,
    last: int,
    most: int,
) -> tuple[int, IntArray] | None:
    """Fewest events, up to `most`, with which a class overtakes the decision after the step `last`, and which."""
    wanted = [
        (option.cost, int(option.gain[decision]), int(option.gain[other]))
        for each in options
        for option in each
    ]
    lead = np.zeros(most + 1, np.int64)
    tie = tally.slope if other < decision else 0
    for each in options:
        before = lead.copy()
        for option in each:
            gain = int(option.gain[other] - option.gain[decision])
            lead[option.cost :] = np.maximum(
                lead[option.cost :], before[: max(most + 1 - option.cost, 0)] + gain
            )
    # no class that comes before the decision has to cross if no sum does
    silent = tally.threshold - tally.slope * tally.steps if other == 0 else -FAR
    if most < 1 or (lead[-1] + sums[other] - sums[decision] <= -tie and silent == -FAR):
        return None
    unit = int(np.gcd.reduce([gain for _, gain, _ in wanted if gain] or [1]))
    reach = max((abs(gain) * most // cost for cost, gain, _ in wanted), default=0) // unit + 1
    best = np.full((most + 1, 2 * reach + 1), -FAR)
    best[0, reach] = 0
    trail: list[NDArray[np.int16]] = []
    for each in options:
        table = best.copy()
        choice = np.full(best.shape, -1, np.int16)
        for index, option in enumerate(each):
            if option.cost <= most:
                by = int(option.gain[decision]) // unit
                moved = np.full(best.shape, -FAR)
                to = slice(max(by, 0), best.shape[1] + min(by, 0))
                from_ = slice(max(-by, 0), best.shape[1] - max(by, 0))
                moved[option.cost :, to] = table[: most + 1 - option.cost, from_] + int(option.gain[other])
                better = moved > best
                best[better], choice[better] = moved[better], index
        trail.append(choice)
    ours = sums[decision] + unit * (np.arange(best.shape[1]) - reach)
    # of a sum that crosses in each step
    level = tally.threshold - tally.slope * (np.arange(last, tally.steps) + 1)
    for count in range(1, most + 1):
        hit = best[count] > -FAR // 2
        # the first step in which the decision crosses; before it, or with it for a lower class, the other
        # one must
        steps = np.searchsorted(-level, -ours, side="right")
        place = steps - (0 if other < decision else 1)
        due = np.where(place < 0, FAR, level[np.clip(place, 0, len(level) - 1)])
        hit &= (best[count] + sums[other] > due) | (ours <= silent)
        if hit.any():
            return count, _flips(options, trail, count, int(np.argmax(hit)), decision, unit)
    return None


def _flips(
    options: list[list[_Option]],
    trail: list[NDArray[np.int16]],
    count: int,
    place: int,
    decision: int,
    unit: int,
) -> IntArray:
    """Entries to flip for a cell of the last table."""
    taken = [np.zeros(0, np.int64)]
    for each, choice in zip(reversed(options), reversed(trail), strict=True):
        index = int(choice[count, place])
        if index >= 0:
            taken.append(each[index].flips)
            count -= each[index].cost
            place -= int(each[index].gain[decision]) // unit
    return np.concatenate(taken)
