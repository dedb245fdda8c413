"""Rules 2 and 3 of ``check_certificate.py``: no k events alter what a network on Loihi decides.

Let events change at the steps t1 < t2 < …; those of one step are a *group*. A vote sees an event `lag` steps later at
the earliest. So votes before t1 + lag are the known ones, and those from ti + lag to before ti+1 + lag depend on no
group after i. ``turned`` bounds how many of these can turn by interval arithmetic: from all registers that any input
can bring about (``before``), through the known events between the groups, the group (its one change, or any), and
known events again. Decay, sums, saturation and comparison are monotone, and a reset leaves zero or at most the
threshold, so no run leaves its bounds. They are followed until every membrane is where known events make every spike
the known one for ever (``safe``: an interval, found backwards). That ends a layer too, with those before it, if none
after it feeds them.

Of the group before one is known that it was at least so many steps ago, or that it was one event exactly so many steps
ago: then bounds are the widest of runs with each event of that step. ``none_of`` adds the worst of all steps, distances
and sizes of groups that have k events together; a group is of one event, or of any number, which counts as two. By rule
3 the certificate names steps, and what shall be told apart there; all else counts as if nothing were known of the past.
If no class makes up for what it lacks, no k events alter the decision.
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
    """Neurons from `first` to before `end`, sources that feed them, and the weights above and below zero, apart.

    Either of these add up to less than 2 ** 15 at a neuron, or ``Loihi`` refuses it: products are exact in float32.
    """

    def __init__(self, chip, depth):
        self.first, self.end = np.searchsorted(chip.depth, [depth, depth + 1])
        synapse = np.flatnonzero((self.first <= chip.target) & (chip.target < self.end))
        source = np.searchsorted(chip.first, synapse, side="right") - 1
        self.sources, row = np.unique(source, return_inverse=True)
        at, weight = (row, chip.target[synapse] - self.first), chip.weight[synapse]
        self.above, self.below = np.zeros((2, len(self.sources), self.end - self.first), np.float32)
        np.add.at(self.above, at, np.maximum(weight, 0))
        np.add.at(self.below, at, np.minimum(weight, 0))


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
        # known spikes of all sources that reach neurons in each step, and what they add up to
        self.spikes = np.hstack([self.events, np.concatenate([each[4] for each in states[:-1]])])
        self.sums = np.zeros((len(counts), chip.neurons), np.float32)
        self.ends, last = [0], -1  # neurons up to which none is fed by later ones
        for layer in self.layers:
            spikes = self.spikes[:, layer.sources].astype(np.float32)
            self.sums[:, layer.first : layer.end] = spikes @ (layer.above + layer.below)
            last = max(last, layer.sources.max(initial=-1))
            if last < chip.channels + layer.end:
                self.ends.append(layer.end)
        reached, self.lag = np.arange(chip.channels + chip.neurons) < chip.channels, -1
        while self.lag < len(counts) and not (chip.label[reached[chip.channels :]] >= 0).any():
            low, high = chip.sums(reached[None] & False, reached[None])
            reached[chip.channels :] |= (low[0] < 0) | (high[0] > 0)
            self.lag += 1

    def changed(self, t):
        """Events of a step when one of them is changed, each in turn: (changes, channels)."""
        source = np.flatnonzero(self.flips[:, t])
        events = np.repeat(self.events[[t]], len(source), axis=0)
        events[np.arange(len(source)), source] ^= True
        return events

    def step(self, state, t, seen=None):
        """Bounds a step on of all neurons, or of the last ones where the others spike as known; `state` is overwritten.

        `seen` are the events (rows, channels), sure and possible, if they are not the known ones.
        """
        first = self.chip.neurons - state[0].shape[1]
        fired, begin = state[4:], self.chip.channels + first  # of sources from this one on
        if seen:
            fired, begin = [np.hstack(each) for each in zip(seen, fired, strict=True)], 0
        sure, may = (each - self.spikes[t, begin:].astype(np.float32) for each in fired)  # not as known
        low, high = (np.repeat(self.sums[[t], first:], len(sure), axis=0) for _ in range(2))
        for layer in self.layers:
            if layer.first >= first:
                k = np.searchsorted(layer.sources, begin)
                above, below, source = layer.above[k:], layer.below[k:], layer.sources[k:] - begin
                least, most = sure[:, source], may[:, source]
                low[:, layer.first - first : layer.end - first] += least @ above + most @ below
                high[:, layer.first - first : layer.end - first] += most @ above + least @ below
        return self.chip.after(state, (low, high), t)

    def before(self, t, far, single):
        """Bounds of the state before step `t`; the last group was `far` steps ago at least, or a single event then."""
        begin = max(t - far + (not single), 0)
        state = self.chip.unknown(begin, self.least) if begin else [each.copy() for each in self.states[0]]
        if single:
            seen = self.changed(begin)
            state = [np.repeat(each, len(seen), axis=0) for each in state]
            state = self.step(state, begin, (seen, seen))
        for s in range(begin + single, t):
            state = self.step(state, s)
        least, most = ([end(each, axis=0, keepdims=True) for each in state] for end in (np.min, np.max))
        return [least[0], most[1], least[2], most[3], least[4], most[5]]

    def turned(self, t, far, single):
        """Votes that each class gains on the decision until the next group comes 1 … REACH steps later, or never.

        The group is of step `t`, the one before it as in ``before``. By (one event or more, reach, classes).
        """
        state, flips = self.before(t, far, single), self.flips[:, t]
        most = self.follow(state, t, (self.events[[t]] & ~flips, self.events[[t]] | flips))[0]
        if far == 1 and not single:
            return np.stack([most, most])
        one = self.changed(t)
        return np.stack([self.follow(state, t, (one, one)).max(axis=0), most])

    def follow(self, state, t, seen):
        """Those votes (rows, reach, classes) by the state before step `t`, and events in it, sure and possible."""
        chip, rows = self.chip, len(seen[0])
        state = [np.repeat(each, rows, axis=0) for each in state]
        table, lost = np.zeros((rows, REACH, chip.classes), int), np.zeros((rows, chip.classes), int)
        left, first = np.arange(rows), 0  # rows, and neurons from this one on, that are not over yet
        for s in range(t, len(self.counts)):
            state = self.step(state, s, seen if s == t else None)
            known, (low, high) = (
                [each[..., first:] for each in of[s + 1]] for of in (self.states, self.safe)
            )
            r = s + 1 - t - self.lag
            if r > 0:
                fewest, most, votes = (chip.votes(each) for each in (state[4], state[5], known[4]))
                lost = lost + (votes - fewest)[:, [self.decision]] + most - votes
                before = table[left, -1:] if r >= REACH else -FAR
                table[left, min(r, REACH) - 1 :] = np.maximum(lost[:, None], before)
            over = (state[2] >= low) & (state[3] <= high) & (state[4] == known[4]) & (state[5] == known[5])
            over &= (chip.keep_u[first:] == 0) | ((state[0] == known[0]) & (state[1] == known[1]))
            goes_on = ~over.all(axis=1)
            if not goes_on.any():
                break
            # neurons that are over remain so if no others feed them
            end = max(each for each in self.ends if over[:, : max(each - first, 0)].all())
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
