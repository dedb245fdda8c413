"""Rules 2 and 3 of ``check_certificate.py``: no k events alter what a network on Loihi decides.

Let events change at the steps t1 < t2 < …; those of one step are a *group*. A vote sees an event `lag` steps later at
the earliest. So votes before t1 + lag are the known ones, and those from ti + lag to before ti+1 + lag depend on no
group after i. ``turned`` bounds how many of these can turn by interval arithmetic: from all registers that any input
can bring about (``before``), through the known events between the groups, the group (its one change, or any), and
known events again. Decay, sums, saturation and comparison are monotone, and a reset leaves zero or what is below the
threshold, so no run leaves its bounds. They are followed until every membrane is where known events make every spike
the known one for ever (``safe``: an interval, found backwards).

Of the group before one is known that it was at least so many steps ago, or that it was one event exactly so many steps
ago: then bounds are the widest of runs with each event of that step. ``none_of`` adds the worst of all steps, distances
and sizes of groups that have k events together. By rule 3 the certificate names steps, and what shall be told apart
there; all else counts as if nothing were known of the past. If no class makes up for what it lacks, no k events alter
the decision.
"""

import numpy as np

LIMIT = 2**23 - 1  # of membranes
FAR = 2**40
REACH = 12  # steps to the next group that are told apart


def largest(most, keep):
    """Largest value of which at most `most` is kept."""
    k = np.maximum(keep, 1)
    value = np.where(most >= 0, ((most + 1) * 4096 - 1) // k, -((-most * 4096 + k - 1) // k))
    return np.clip(np.where(keep > 0, value, np.where(most >= 0, FAR, -FAR)), -FAR, FAR)


def safe(chip, states):
    """Least and largest membrane before each step from which, the events known, all spikes are the known ones."""
    ends = [(np.full(chip.neurons, -FAR), np.full(chip.neurons, FAR))]
    for t in reversed(range(len(states) - 1)):
        more, fired = states[t + 1][0][0].astype(np.int64) + chip.bias, states[t + 1][4][0]
        least = np.where(fired, chip.threshold + 1, ends[-1][0])
        most = np.where(fired, FAR, np.minimum(chip.threshold, ends[-1][1]))
        low = np.where(least <= -LIMIT, -FAR, -largest(more - least, chip.keep_v))
        high = np.where(most >= LIMIT, FAR, largest(most - more, chip.keep_v))
        inside = (chip.depth <= t) & (t < chip.depth + chip.steps)
        ends.append((np.where(inside, low, -FAR), np.where(inside, high, FAR)))
    return ends[::-1]


class Layer:
    """Neurons of one depth, the sources that feed them, and the weights between, above and below zero.

    Products with these are exact in float32: a register that sums of 2 ** 15 and more could reach was refused.
    """

    def __init__(self, chip, depth):
        first, last = np.searchsorted(chip.depth, [depth, depth + 1])
        here = np.flatnonzero((first <= chip.target) & (chip.target < last))
        source = np.searchsorted(chip.first, here, side="right") - 1
        self.neurons, self.first = np.arange(first, last), first
        self.sources, row = np.unique(source, return_inverse=True)
        self.above, self.below = np.zeros((2, len(self.sources), last - first), np.float32)
        for weights, end in ((self.above, np.maximum), (self.below, np.minimum)):
            np.add.at(weights, (row, chip.target[here] - first), end(chip.weight[here], 0))


class Groups:
    """What groups of changed events can turn in one recording."""

    def __init__(self, chip, events, flips, decision, states, counts):
        self.chip, self.flips, self.decision = chip, flips, decision
        self.states, self.counts, self.safe = states, counts, safe(chip, states)
        self.events = np.zeros(
            (len(counts), chip.channels), np.bool_
        )  # by step, until all votes are counted
        self.events[: events.shape[1]] = events.T
        self.least = chip.lowest(len(counts))
        self.layers = [Layer(chip, depth) for depth in range(chip.drain + 1)]
        # spikes of all sources that reach each step, what they add up to, and where no later neuron feeds an earlier one
        self.spikes = np.hstack([self.events, np.concatenate([each[4] for each in states[:-1]])])
        self.sums = np.zeros((len(counts), chip.neurons), np.float32)
        self.ends, last = [0], -1
        for layer in self.layers:
            weights = layer.above + layer.below
            self.sums[:, layer.neurons] = self.spikes[:, layer.sources].astype(np.float32) @ weights
            last = max(last, layer.sources.max(initial=-1))
            if last < chip.channels + layer.first + len(layer.neurons):
                self.ends.append(layer.first + len(layer.neurons))
        reached, self.lag = np.arange(chip.channels + chip.neurons) < chip.channels, -1
        while self.lag < len(counts) and not (chip.label[reached[chip.channels :]] >= 0).any():
            low, high = chip.sums(reached[None] & False, reached[None])
            reached[chip.channels :] |= (low[0] < 0) | (high[0] > 0)
            self.lag += 1

    def step(self, state, seen, s):
        """State a step on of all neurons, or of the last ones if the others spike as known; `seen` if channels do not."""
        first = self.chip.neurons - state[0].shape[1]
        begin = 0 if seen else self.chip.channels + first
        fired = [np.hstack(each) for each in zip(seen, state[4:], strict=True)] if seen else state[4:]
        # beyond those known
        sure, may = (each.astype(np.float32) - self.spikes[s, begin:] for each in fired)
        sums = np.empty((2, *state[0].shape), np.float32)
        sums[:] = self.sums[s, first:]
        for layer in self.layers:
            if layer.first >= first:
                k = np.searchsorted(layer.sources, begin)
                above, below, source = layer.above[k:], layer.below[k:], layer.sources[k:] - begin
                some, any_ = sure[:, source], may[:, source]
                sums[0][:, layer.neurons - first] += some @ above + any_ @ below
                sums[1][:, layer.neurons - first] += any_ @ above + some @ below
        return self.chip.after(state, sums, s)

    def before(self, t, far, single):
        """Bounds of the state before step `t`; the last group was `far` steps ago at least, or a single event then."""
        begin = max(t - far + (not single), 0)
        state = self.chip.unknown(begin, self.least) if begin else self.states[0]
        for s in range(begin, t):
            source = np.flatnonzero(self.flips[:, s]) if single and s == begin else np.zeros(0, int)
            state = [np.repeat(each, max(len(source), 1), axis=0) for each in state]
            now = np.repeat(self.events[[s]], len(state[0]), axis=0)
            now[np.arange(len(source)), source] ^= True
            state = self.step(state, (now, now), s)
        least, most = ([end(each, axis=0, keepdims=True) for each in state] for end in (np.min, np.max))
        return [least[0], most[1], least[2], most[3], least[4], most[5]]

    def turned(self, t, far, single):
        """Votes that each class gains on the decision until the next group comes 1 … REACH steps later, or never.

        The group is of step `t`, the one before it as in ``before``. By (one event or more, reach, classes).
        """
        state, source = self.before(t, far, single), np.flatnonzero(self.flips[:, t])
        sure, may = self.events[[t]], self.events[[t]]
        sure[:, source], may[:, source] = False, True
        more = self.follow(state, (sure, may), t)[0]
        if far == 1 and not single:
            return np.stack([more, more])
        one = np.repeat(self.events[[t]], len(source), axis=0)
        one[np.arange(len(source)), source] ^= True
        return np.stack([self.follow(state, (one, one), t).max(axis=0), more])

    def follow(self, state, seen, t):
        """The same (rows, reach, classes) from a state before step `t`, by events of that step (rows, channels)."""
        chip, rows = self.chip, len(seen[0])
        state = [np.repeat(each, rows, axis=0) for each in state]
        table, lost = np.zeros((rows, REACH, chip.classes), int), np.zeros((rows, chip.classes), int)
        left, first = np.arange(rows), 0  # rows that are not over, neurons before which all are
        for s in range(t, len(self.counts)):
            state = self.step(state, seen, s)
            known, safe = ([each[..., first:] for each in all_[s + 1]] for all_ in (self.states, self.safe))
            r = s + 1 - t - self.lag
            if r > 0:
                fewest, most, votes = (chip.votes(each) for each in (state[4], state[5], known[4]))
                ours = (votes - fewest)[:, [self.decision]]
                lost = lost + ours + most - votes
                before = table[left, -1:] if r >= REACH else -FAR
                table[left, min(r, REACH) - 1 :] = np.maximum(lost[:, None], before)
            over = (state[2] >= safe[0]) & (state[3] <= safe[1])
            over &= (state[4] == known[4]) & (state[5] == known[5])
            over &= (chip.keep_u[first:] == 0) | ((state[0] == known[0]) & (state[1] == known[1]))
            goes_on = ~over.all(axis=1)
            if not goes_on.any():
                break
            all_over = first + over.all(axis=0).argmin()
            end = max(each for each in self.ends if each <= all_over)
            seen = [np.repeat(self.events[[s + 1]], goes_on.sum(), axis=0)] * 2 if not end and s + 1 < len(self.counts) else []
            state = [each[goes_on, end - first :] for each in state]
            left, lost, first = left[goes_on], lost[goes_on], end
        return table

    def none_of(self, k, apart):
        """Whether no `k` events alter the decision; `apart` (rows, 3) says what is told apart, and in which step."""
        steps, classes = self.flips.shape[1], self.chip.classes
        known = {tuple(each): self.turned(each[2], *each[:2]) for each in apart.tolist()}
        pasts = sorted({(1, 0), *(each[:2] for each in known)})

        def past(events, r):
            """Which of the pasts says most of a group `r` steps after one of so many events."""
            fits = [each for each in pasts if not each[1] and each[0] <= r]
            return pasts.index((r, 1) if events == 1 and (r, 1) in pasts else max(fits))

        # votes lost to groups before one at a step, by what is known of the last of them and events so far
        enter = np.full((steps + REACH, len(pasts), k + 1, classes), -FAR)
        enter[:, past(2, REACH), 0] = 0
        worst = np.zeros((k + 1, classes), np.int64)
        for t in np.flatnonzero(self.flips.any(axis=0)):
            whatever = self.turned(t, 1, 0)
            for level, each in enumerate(pasts):
                for events, lost in enumerate(known.get((*each, t), whatever)[: min(k, 2)], 1):
                    after = enter[t, level, : k + 1 - events, None] + lost
                    for r in range(1, REACH):
                        to = enter[t + r, past(events, r), events:]
                        np.maximum(to, after[:, r - 1], out=to)
                    to = enter[t + REACH :, past(2, REACH), events:]
                    np.maximum(to, after[:, -1], out=to)
                    np.maximum(worst[events:], after[:, -1], out=worst[events:])
        votes = self.counts.sum(axis=0)
        needed = votes[self.decision] - votes + (np.arange(classes) > self.decision)
        return bool(np.delete(worst.max(axis=0) < needed, self.decision).all())
