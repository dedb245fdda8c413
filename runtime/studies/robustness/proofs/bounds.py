"""How many events must at least change until a decision does: a sound lower bound, by what the chip forgets.

Changes of events come one after another. As soon as the chip is in the state that it would be in anyway,
what follows is as if nothing had been: effects of events so far apart add up, and each of them is known
exactly. Where a further event changes before that, nothing is assumed but what :class:`Forgetting` knows:
every vote that is open may go the wrong way. A dynamic program over steps and events finds the worst of
all. Votes may be lost

*exactly*: by a change whose run is the known one before the next change;
*in a cluster*: by its first change at most as many as its own effects hold, until the second shows; by each further one
    those that are open between the first step that it can alter and the first that the next can alter.
"""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.types import IntArray
from spikeloom.runtime.machines.changes import Effects, Forgetting
from spikeloom.runtime.studies.robustness.proofs.entries import Cells


def needed(votes: IntArray) -> tuple[int, IntArray]:
    """Decision of votes (classes,), and by how much each other class must gain on it to win; 0 for itself.

    >>> needed(np.array([3, 5, 5]))
    (1, array([2, 0, 1]))
    """
    decision = int(np.argmax(votes))
    gaps = votes[decision] - votes + (np.arange(len(votes)) > decision)
    gaps[decision] = 0
    return decision, gaps


def lower_bound(votes: IntArray, cells: Cells, effects: Effects, known: Forgetting, most: int) -> int:
    """Most events, up to `most`, of which it is proven that no so many alter the decision of a recording.

    `votes` (classes,) are those of the known run, `effects` those of each entry flipped alone.
    """
    from spikeloom.compiler.layer_kernel import require_below
    from spikeloom.runtime.studies.robustness.proofs.worst import (
        most_lost,
    )  # with numba, which help need not wait for

    decision, gaps = needed(votes)
    steps = len(known.back) - 1
    step = cells.cells[:, 1]
    first = np.searchsorted(step, np.arange(steps + 1))
    end = np.minimum(effects.end, steps)
    for name, indices in (("quiet", known.quiet), ("back", known.back)):
        require_below(name, indices, steps + 1)
    certified = most
    for other in np.flatnonzero(np.arange(len(votes)) != decision).tolist():
        alone = effects.votes[:, other] - effects.votes[:, decision]
        partly = effects.come[:, other] + effects.gone[:, decision]
        opened = known.come[:, :, other].astype(np.int64) + known.gone[:, :, decision]
        votes_lost = most_lost(
            first,
            end,
            cells.cost,
            alone,
            partly,
            known.quiet,
            known.back,
            opened,
            known.lag,
            min(certified, most),
        )
        certified = min(certified, int(np.searchsorted(votes_lost, gaps[other])) - 1)
        if certified <= 0:
            return 0
    return certified
