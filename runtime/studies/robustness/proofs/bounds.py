"""How many events must at least change until a decision does: a sound lower bound, by what the chip forgets.

Changed events come in groups, one a step. The votes from where a group can be seen until the next can be are
lost to this group. How many they are at most, :class:`Groups` says, by how long ago the group before it was:
nothing more is assumed of the past. A dynamic program over steps, spacings and events finds the worst of all.
Each vote is counted for one group; those before the first group can be seen are the known ones.
"""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.changes import Groups

APART = np.array([1, 5, 7])
"""Steps from a group to the one before it, at least, for which bounds are worked out."""

REACH = 12
"""Steps to the next group that are told apart; no less than the last of these."""


def needed(votes: IntArray) -> tuple[int, IntArray]:
    """Decision of votes (classes,), and by how much each other class must gain on it to win; 0 for itself.

    >>> needed(np.array([3, 5, 5]))
    (1, array([2, 0, 1]))
    """
    decision = int(np.argmax(votes))
    gaps = votes[decision] - votes + (np.arange(len(votes)) > decision)
    gaps[decision] = 0
    return decision, gaps


def lower_bound(votes: IntArray, groups: Groups, apart: IntArray, most: int) -> int:
    """Most events, up to `most`, of which it is proven that no so many alter the decision of votes (classes,)."""
    from spikeloom.runtime.studies.robustness.proofs.worst import (
        most_lost,
    )  # with numba, which help need not wait for

    assert apart[0] == 1, "a group may follow another in the next step"
    decision, gaps = needed(votes)
    certified = most
    for other in np.argsort(gaps, kind="stable").tolist():
        if other != decision and certified > 0:
            of_class = np.ascontiguousarray(groups.lost[: len(apart), ..., other])
            lost = most_lost(of_class, apart, certified)
            certified = min(certified, int(np.searchsorted(lost, gaps[other])) - 1)
    return certified
