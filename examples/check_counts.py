"""Rule 4 of ``check_certificate.py``: no k events alter what a counting network on Loihi decides.

All of this is derived from the netlist, or refused. A *counter* adds up the events of one channel, or those that a
*gate* lets through while a clock runs, without a leak: it spikes with the event `first`, is lowered by that, and spikes
again every `again` events; when these come does not matter. *Sums*, one a class, add up weights of counters that
spiked, and a ramp that is the same for all; a *vote* spikes from the step after its sum did. So the largest sum after
the last event decides, where none but that of the decision can be above the threshold before.

An event added or removed alters the count of one group, a channel or a gate. A dynamic program over groups finds for
each number of events and each sum of the decision the largest sum that another class can have beside it.
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

    def added(self, group, events):
        """What counters of a group have added to the sums after so many of its events (…,); (…, classes)."""
        those = self.group == group
        more = np.asarray(events)[..., None] - self.first[those]
        return np.where(more < 0, 0, 1 + more // self.again[those]) @ self.weight[those]

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
        for group in np.unique(self.group):
            channel, through = self.lets_through(group, events, len(bins))
            seen = (events[channel] & through).cumsum()
            known = self.added(group, seen)
            sums += known
            counts = self.added(group, np.arange(steps + 1))
            largest = max(largest, np.abs(np.diff(counts, axis=0)).max())  # that one event adds or takes
            before = lead.copy()
            for more in sizes[sizes != 0]:
                gain = self.added(group, seen[: last + 1] + more) - known[: last + 1]
                if gain.any():
                    cost = abs(more)
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
        above = ONE * (sums[: last + 1] + lead[k]) + ramp[: last + 1] > self.threshold
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
