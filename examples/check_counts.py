"""Rule 4 of ``check_certificate.py``: no k events alter what a counting network decides.

All of this is derived from the netlist, or refused. A *counter* adds up the events of one channel, or those that a
*gate* lets through while a clock runs, without a leak: it spikes with the event `first`, is lowered by that, and spikes
again every `again` events; when these come does not matter. *Sums*, one a class, add up weights of counters that
spiked, and a ramp that is the same for all; a *vote* spikes from the step after its sum did. So the largest sum after
the last event decides, where none but that of the decision can be above the threshold before.

An event added or removed alters the count of one group, a channel or a gate. A dynamic program over groups finds for
each number of events and each sum of the decision the largest sum that another class can have beside it.

On TrueNorth weights above zero and below add up apart, in *rows* that pass on one spike a tick, so before the last
event a sum may have all that comes above zero, and must have what came below zero `late` ticks ago. A row has passed
all on by then: in w ticks it gets at most what its counters add up to, once more for each `again` ticks, so that
`late` + w - 1 ticks suffice if neither that sum is more than `late` nor `late` is more than `again`.
"""

import numpy as np

LIMIT = 2**23 - 1  # of membranes
FAR = 2**40
ONE = 64  # membrane units of a weight


class Counts:
    """A counting network: by counter (counters,) its group, `first`, `again`, and weights (counters, classes)."""

    def __init__(self, chip, require):
        self.chip, self.require = chip, require
        weight = np.zeros((len(chip.first) - 1, chip.neurons), np.int64)
        source = np.repeat(np.arange(len(weight)), np.diff(chip.first))
        np.add.at(weight, (source, chip.target), chip.weight)
        self.into, inner = weight, weight[chip.channels :]
        lowered = inner.diagonal().copy()
        np.fill_diagonal(inner, 0)
        votes = np.flatnonzero(chip.label >= 0)
        votes = votes[np.argsort(chip.label[votes])]
        sums, counters = np.zeros(0, int), np.zeros(0, int)
        if np.array_equal(chip.label[votes], np.arange(chip.classes)):
            sums = np.concatenate([np.flatnonzero(inner[:, vote])[:1] for vote in votes])
            counters = np.flatnonzero(inner[:, sums].any(axis=1))
        gates = np.flatnonzero(inner[:, counters].any(axis=1))
        kinds = [gates, counters, sums, votes][not len(gates) :]
        every = np.concatenate(kinds)
        added = np.concatenate([counters, sums])
        threshold, one = chip.threshold, ONE * weight
        self.group = weight[:, counters].argmax(axis=0)
        unit = one[self.group, counters]
        lasting = ONE * inner[sums, votes] if len(sums) == len(votes) else votes * 0
        facts = [
            len(sums) == chip.classes and len(np.unique(every)) == len(every) and len(counters) > 0,
            not chip.keep_u[every].any() and (weight[:, gates] >= 0).all() and (chip.bias[gates] >= 0).all(),
            (chip.keep_v[added] == 4096).all() and (threshold[every] >= 0).all(),
            all((chip.depth[kind] == depth).all() for depth, kind in enumerate(kinds)),
            not chip.bias[np.concatenate([counters, votes])].any() and len(set(chip.bias[sums])) == 1,
            ((weight[:, np.concatenate([counters, votes])] != 0).sum(axis=0) == 1).all()
            and (unit > 0).all(),
            not lowered[sums].any() and not lowered[gates].any() and (lowered[counters] <= 0).all(),
            (np.delete(weight, chip.channels + counters, axis=0)[:, sums] == 0).all(),
            (lasting > threshold[votes]).all() and (ONE * lowered[votes] > threshold[votes]).all(),
            not inner[:, gates].any() and len(set(threshold[sums])) == 1,
            len(set(self.group >= chip.channels)) == 1,  # all of channels, or all of gates
        ]
        require(all(map(bool, facts)), "that it is a counting network")
        self.first = threshold[counters] // unit + 1
        self.again = (threshold[counters] - ONE * lowered[counters]) // unit + 1
        self.weight = inner[counters][:, sums]
        self.ramp, self.threshold = int(chip.bias[sums[0]]), int(threshold[sums[0]])
        fullest = (unit * chip.steps - ONE * lowered[counters]).max()
        require(self.ramp > 0 and fullest <= LIMIT, "that no counter overflows")

    def times(self, group, events):
        """How often counters of a group have spiked after so many of its events (…,); (…, counters)."""
        those = self.group == group
        more = np.asarray(events)[..., None] - self.first[those]
        return np.where(more < 0, 0, 1 + more // self.again[those])

    def added(self, group, events):
        """What they have added to the sums then; (…, classes)."""
        return self.times(group, events) @ self.weight[self.group == group]

    def highest(self, group, events, end):  # noqa: ARG002
        """Most that they have added to a sum then, if there are so many events in the end."""
        return self.added(group, events)

    def lets_through(self, group, events, data):
        """Channel of a group, and steps in which its events count; the first `data` channels are no clocks."""
        if group < self.chip.channels:
            self.require(group < data, "counters of channels")
            return group, np.ones(events.shape[1], np.bool_)
        gate = group - self.chip.channels
        into, threshold = self.into[: self.chip.channels, gate], self.chip.threshold[gate]
        channels = np.flatnonzero(into[:data])
        kept = threshold * self.chip.keep_v[gate] // 4096  # of the step before, at most
        clocked = ONE * (events[data:].T @ into[data:]) + self.chip.bias[gate]
        self.require(len(channels) == 1 and (clocked + kept <= threshold).all(), "gates of one channel")
        through = clocked + ONE * into[channels[0]]
        self.require(((through > threshold) | (through + kept <= threshold)).all(), "gates of single steps")
        return channels[0], through > threshold

    def none_of(self, k, events, bins, decision):
        """Whether no `k` events alter the decision of a recording; `bins` as in ``check_certificate.check``."""
        steps, last = events.shape[1], bins.shape[1] - 1
        sums = np.zeros((steps, self.chip.classes), np.int64)  # known, after each step
        groups, sizes, largest = [], np.arange(-k, k + 1), 0
        lead = np.zeros((k + 1, last + 1, self.chip.classes), np.int64)  # beyond these, at most
        highest = lead[0].copy()  # known, at most, where sums may be late
        reached = np.zeros((len(bins), steps), np.int64)
        for group in np.unique(self.group):
            channel, through = self.lets_through(group, events, len(bins))
            reached[channel] += through
            self.require(reached[channel].max() <= 1, "that an event is of one group")
            seen = (events[channel] & through).cumsum()
            known = self.added(group, seen)
            sums += known
            most = self.highest(group, seen[: last + 1], seen[-1])
            highest += most
            counts = self.added(group, np.arange(steps + 1))
            largest = max(largest, np.abs(np.diff(counts, axis=0)).max())  # that one event adds or takes
            before = lead.copy()
            for more in sizes[sizes != 0]:
                cost = abs(more)
                gain = self.highest(group, seen[: last + 1] + more, seen[-1] + cost) - most
                if gain.any():
                    np.maximum(lead[cost:], before[: k + 1 - cost] + gain, out=lead[cost:])
            cost = bins[channel][through[: last + 1]]
            ways = []
            for sign, each in (
                (-1, np.sort(cost[cost > 0])),
                (1, np.ones(np.count_nonzero(cost == 0), int)),
            ):
                for n, price in enumerate(np.cumsum(each)[:k], 1):
                    gain = self.added(group, seen[-1] + sign * n) - known[-1]
                    if price <= k and gain.any():
                        ways.append((int(price), gain))
            groups.append(ways)
        ramp = self.ramp * np.arange(1, steps + 1)[:, None]
        self.require((ONE * (sums - k * largest) + ramp).min() > -LIMIT, "that no sum saturates")
        above = ONE * (highest + lead[k]) + ramp[: last + 1] > self.threshold
        if np.delete(above, decision, axis=1).any():
            return False
        others = np.delete(np.arange(self.chip.classes), decision)
        return not any(
            self.overtakes(k, groups, sums[-1], decision, other, (last, steps)) for other in others
        )

    def overtakes(self, k, groups, sums, decision, other, ends):
        """Whether `k` changes can make the sum of another class cross the threshold before that of the decision."""
        lead = np.full(k + 1, sums[other] - sums[decision])  # at most, by events
        for ways in groups:
            before = lead.copy()
            for cost, gain in ways:
                more = before[: k + 1 - cost] + gain[other] - gain[decision]
                np.maximum(lead[cost:], more, out=lead[cost:])
        if other and ONE * lead[k] <= -self.ramp * (
            other < decision
        ):  # class 0 decides where no sum crosses
            return False
        steepest = max((abs(gain[decision]) / cost for ways in groups for cost, gain in ways), default=0)
        reach = int(np.ceil(k * steepest))
        best = np.full(
            (k + 1, 2 * reach + 1), -FAR
        )  # sum of the other class, by events and that of the decision
        best[:, reach] = sums[other]
        for ways in groups:
            before = best.copy()
            for cost, gain in ways:
                moved = (
                    np.roll(before[: k + 1 - cost], gain[decision], axis=1) + gain[other]
                )  # none goes round
                np.maximum(best[cost:], moved, out=best[cost:])
        ours, theirs = sums[decision] + np.arange(-reach, reach + 1), best[k]
        ours, theirs = (
            np.clip((self.threshold - ONE * each) // self.ramp, *ends) for each in (ours, theirs)
        )
        return bool(((best[k] > -FAR // 2) & (theirs < ours + (other < decision))).any())


class Crossbars(Counts):
    """The same on TrueNorth, where a neuron has one target, so that there are copies of counters and gates.

    A group is a channel, or a channel and the clock of a part, in `pairs`.
    """

    def __init__(self, chip, require):
        self.chip, self.require, a = chip, require, chip.a
        channels, axons = chip.channels, len(chip.first) - 1
        source = np.full(axons, channels + chip.neurons)  # of each axon: a channel, a neuron, or none
        source[chip.feed], source[chip.wire] = a["feed_channel"], channels + a["wire_neuron"]
        weight = np.zeros((channels + chip.neurons + 1, chip.neurons), np.int64)
        np.add.at(weight, (np.repeat(source, np.diff(chip.first)), chip.target), chip.weight)
        inner = weight[channels:-1]
        votes = np.flatnonzero(chip.label >= 0)
        votes = votes[np.argsort(chip.label[votes])]
        require(np.array_equal(chip.label[votes], np.arange(chip.classes)), "that each class has one vote")
        sums = np.flatnonzero(inner[:, votes].any(axis=1))
        counters = np.flatnonzero(inner[:, sums].any(axis=1))
        gates = np.flatnonzero(inner[:, counters].any(axis=1))
        kinds = [gates, counters, sums, votes]
        fed = [np.arange(channels), *(channels + kind for kind in kinds[:-1])]  # sources of each kind
        fed[1] = fed[1] if len(gates) else fed[0]
        first, ramp, threshold = (int(a[name][votes[0]]) for name in ("readout_first", "leak", "threshold"))
        rows, passed = inner[counters][:, sums], inner[sums][:, votes]
        registers = {  # of each kind
            "leak": (-2, 0, 0, ramp),
            "leak_reversal": (0, 0, 0, 0),
            "reset_mode": (0, 0, 1, 2),
            "initial": (0, 0, 0, -ramp * first),
            "threshold": (0, a["threshold"][counters], 1, threshold),
        }
        self.first, self.again = a["threshold"][counters], (a["threshold"] - a["reset"])[counters]
        self.above, self.below = rows @ (passed > 0), rows @ (passed < 0)
        self.weight = self.above - self.below
        single = (weight[:, counters] != 0).sum(axis=0) == 1
        facts = [
            len(counters) > 0 and not len(chip.clock) and chip.bin_ticks == 1 and chip.drain == first,
            len(np.unique(np.concatenate(kinds))) == sum(map(len, kinds)),
            np.bincount(np.concatenate([chip.feed, chip.wire]), minlength=axons).max() == 1,
            not a["feed_tick"].any() and (a["wire_delay"] == 1).all(),
            not any(
                np.delete(weight[:, k], those, axis=0).any() for those, k in zip(fed, kinds, strict=True)
            ),
            all(
                (a[name][k] == due[n]).all() for name, due in registers.items() for n, k in enumerate(kinds)
            ),
            (a["readout_first"][votes] == first).all() and ramp > 0,
            not a["negative_threshold"][gates].any() and not a["reset"][gates].any(),
            single.all() and (weight[:, counters].max(axis=0) == 1).all() and (self.first > 0).all(),
            (a["reset"] <= 0)[counters].all() and (a["reset"] >= -a["negative_threshold"])[counters].all(),
            (rows >= 0).all() and np.isin(passed, (-1, 0, 1)).all(),
        ]
        require(all(map(bool, facts)), "that it is a counting network")
        late, shortest = first - 1 - (len(gates) > 0), self.again.min()
        require(rows.sum(axis=0).max() <= late <= shortest, "that all is passed on in time")
        often = 1 + chip.steps // shortest  # a counter spikes, at most
        most = often * max(each.sum(axis=0).max() for each in (self.above, self.below))
        floor = a["negative_threshold"][votes].min()
        require(most + ramp * (chip.steps + first) <= min(floor, 2**19 - 1), "that no sum saturates")
        self.ramp = ONE * ramp
        self.threshold = ONE * threshold - 1  # to be above is to be at least the chip's
        self.group = weight[:, counters].argmax(axis=0)
        self.pairs = None
        if len(gates):
            into = weight[:channels, self.group - channels].T
            two = np.isin(into, (0, 1)).all() and (into.sum(axis=1) == 2).all()
            require(two, "that gates are of a channel and a clock")
            self.pairs, group = np.unique(np.nonzero(into)[1].reshape(-1, 2), axis=0, return_inverse=True)
            self.group = group.reshape(-1)

    def highest(self, group, events, end):
        """The same where sums are late: above zero all of the end, below zero what must have come."""
        those = self.group == group
        return self.times(group, end) @ self.above[those] - self.times(group, events) @ self.below[those]

    def lets_through(self, group, events, data):
        """As of gates that spike when both of a pair do, and remember nothing."""
        channel, clock = (group, None) if self.pairs is None else self.pairs[group]
        self.require(channel < data, "counters of channels")
        if clock is None:
            return channel, np.ones(events.shape[1], np.bool_)
        self.require(clock >= data, "gates of a channel and a clock")
        return channel, events[clock]
