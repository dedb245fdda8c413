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
        more, fired = states[t + 1][0][0] + chip.bias, states[t + 1][4][0]
        least = np.where(fired, chip.threshold + 1, ends[-1][0])
        most = np.where(fired, FAR, np.minimum(chip.threshold, ends[-1][1]))
        low = np.where(least <= -LIMIT, -FAR, -largest(more - least, chip.keep_v))
        high = np.where(most >= LIMIT, FAR, largest(most - more, chip.keep_v))
        inside = (chip.depth <= t) & (t < chip.depth + chip.steps)
        ends.append((np.where(inside, low, -FAR), np.where(inside, high, FAR)))
    return ends[::-1]


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
        reached, self.lag = np.arange(chip.channels + chip.neurons) < chip.channels, -1
        while self.lag < len(counts) and not (chip.label[reached[chip.channels :]] >= 0).any():
            low, high = chip.sums(reached[None] & False, reached[None])
            reached[chip.channels :] |= (low[0] < 0) | (high[0] > 0)
            self.lag += 1

    def before(self, t, far, single):
        """Bounds of the state before step `t`; the last group was `far` steps ago at least, or a single event then."""
        begin = max(t - far + (not single), 0)
        state = self.chip.unknown(begin, self.least) if begin else self.states[0]
        for s in range(begin, t):
            source = np.flatnonzero(self.flips[:, s]) if single and s == begin else np.zeros(0, int)
            state = [np.repeat(each, max(len(source), 1), axis=0) for each in state]
            now = np.repeat(self.events[[s]], len(state[0]), axis=0)
            now[np.arange(len(source)), source] ^= True
            state, _ = self.chip.tick(state, (now, now), s)
        least, most = ([end(each, axis=0, keepdims=True) for each in state] for end in (np.min, np.max))
        return [least[0], most[1], least[2], most[3], least[4], most[5]]

    def turned(self, t, far, single):
        """Votes that each class gains on the decision until the next group comes 1 … REACH steps later, or never.

        The group is of step `t`, the one before it as in ``before``. By (one event or more, reach, classes).
        """
        chip, source = self.chip, np.flatnonzero(self.flips[:, t])
        rows = 1 if far == 1 and not single else 1 + len(source)
        state = [np.repeat(each, rows, axis=0) for each in self.before(t, far, single)]
        table, lost = np.zeros((rows, REACH, chip.classes), int), np.zeros((rows, chip.classes), int)
        left = np.arange(rows)  # that are not over yet
        for s in range(t, len(self.counts)):
            sure, may = (np.repeat(self.events[[s]], len(left), axis=0) for _ in range(2))
            if s == t:
                sure[0, source], may[0, source] = False, True
                for k in range(1, rows):
                    sure[k, source[k - 1]] = may[k, source[k - 1]] = not self.events[s, source[k - 1]]
            state, (fewest, most) = chip.tick(state, (sure, may), s)
            r = s + 1 - t - self.lag
            if r > 0:
                known = self.counts[s]
                lost = lost + (known[self.decision] - fewest[:, [self.decision]]) + most - known
                before = table[left, -1:] if r >= REACH else -FAR
                table[left, min(r, REACH) - 1 :] = np.maximum(lost[:, None], before)
            known, (low, high) = self.states[s + 1], self.safe[s + 1]
            over = (state[2] >= low) & (state[3] <= high) & (state[4] == known[4]) & (state[5] == known[5])
            over &= (chip.keep_u == 0) | ((state[0] == known[0]) & (state[1] == known[1]))
            goes_on = ~over.all(axis=1)
            state, left, lost = [each[goes_on] for each in state], left[goes_on], lost[goes_on]
            if not len(left):
                break
        return table[[0, 0]] if rows == 1 else np.stack([table[1:].max(axis=0), table[0]])

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
