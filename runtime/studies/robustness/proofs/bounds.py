"""How many events must at least change until a decision does: a sound lower bound, by what the chip forgets.

Changed events come in groups, one a step. The votes from where a group can be seen until the next can be are
lost to this group. How many they are at most, :class:`Groups` says, by what is known of the group before it:
nothing more is assumed of the past. A dynamic program over steps, pasts and events finds the worst of all.
Each vote is counted for one group; those before the first group can be seen are the known ones. At
first nothing is assumed of any past. For the groups on the worst chain it is then worked out, until the chain has no
other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spikeloom.compiler.types import AnyArray, IntArray
from spikeloom.runtime.machines.changes import Groups, Past

PASTS = (*(Past(steps) for steps in range(1, 8)), *(Past(steps, single=True) for steps in range(1, 4)))
"""What is told apart of the group before one."""

REACH = 12
"""Steps to the next group that are told apart; no less than any of these."""


class Proven(NamedTuple):
    """Most events of which it is proven that no so many alter a decision, and what that rests on."""

    events: int
    # (groups, 3) int64; what is known of the past of a group, see :class:`Past`, and its step; of all others nothing
    pasts: IntArray = np.zeros((0, 3), np.int64)


def needed(votes: IntArray) -> tuple[int, IntArray]:
    """Decision of votes (classes,), and by how much each other class must gain on it to win; 0 for itself.

    >>> needed(np.array([3, 5, 5]))
    (1, array([2, 0, 1]))
    """
    decision = int(np.argmax(votes))
    gaps = votes[decision] - votes + (np.arange(len(votes)) > decision)
    gaps[decision] = 0
    return decision, gaps


def lower_bound(votes: IntArray, groups: Groups, pasts: tuple[Past, ...], most: int) -> Proven:
    """Most events, up to `most`, of which it is proven that no so many alter the decision of votes (classes,)."""
    from spikeloom.runtime.studies.robustness.proofs.worst import (
        fewest,
    )  # with numba, which help need not wait for

    assert pasts[0] == Past(1), "a group may follow another in the next step"
    decision, gaps = needed(votes)
    last = max(index for index, past in enumerate(pasts) if not past.single)
    follows = np.array([[_past_after(pasts, r, single) for r in range(REACH)] for single in (True, False)])
    known: dict[tuple[int, int], AnyArray] = {}
    certified = most
    for other in np.argsort(gaps, kind="stable").tolist():
        if other == decision:
            continue
        of_class = np.broadcast_to(groups.lost[..., other], (len(pasts), 2, *groups.lost.shape[:2])).copy()
        for (past, step), each in known.items():
            of_class[past, :, step] = each[..., other]
        while True:
            events, chain = fewest(of_class, follows, last, certified, gaps[other])
            unknown = {(past, step) for past, step in chain.tolist() if past} - known.keys()
            if not unknown:
                break
            for past, step in sorted(unknown):
                known[past, step] = groups.after(pasts[past], step)
                of_class[past, :, step] = known[past, step][..., other]
        certified = min(certified, events - 1)
    rests_on = [(*pasts[past], step) for past, step in sorted(known)]
    return Proven(certified, np.array(rests_on, np.int64).reshape(-1, 3))


def _past_after(pasts: tuple[Past, ...], steps: int, single: bool) -> int:
    """Which of the pasts says most of a group so many steps ago."""
    exact = Past(steps, single=True)
    if single and exact in pasts:
        return pasts.index(exact)
    return max(
        (index for index, past in enumerate(pasts) if not past.single and past.steps <= steps), default=0
    )
