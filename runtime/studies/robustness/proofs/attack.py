"""How many events suffice to alter a decision: a greedy attack, which the chip confirms."""

from __future__ import annotations

import numpy as np

from spikeloom.compiler.types import EventArray, IntArray
from spikeloom.runtime.machines.base import Machine
from spikeloom.runtime.machines.changes import Effects, joined, single
from spikeloom.runtime.studies.robustness.proofs.bounds import needed
from spikeloom.runtime.studies.robustness.proofs.entries import Cells

CANDIDATES = 2000
"""Entries that a further round looks at."""

ROUNDS = 16


def attack(
    machine: Machine, channels: EventArray, votes: IntArray, cells: Cells, effects: Effects
) -> IntArray:
    """Entries whose flips together alter the decision of a recording (channels, steps); empty if none do.

    Those that cost the decision most votes against one class are taken, none while another still has an
    effect, until they do half of what is lacking; then, in the changed recording, further ones. Those that
    turn out not to be needed are dropped.
    `votes` (classes,) are of the recording, `effects` of each entry alone.
    """
    decision, gaps = needed(votes)
    attacks = []
    for other in _easiest(gaps, decision, cells, effects):
        taken = _against(machine, channels, votes, cells, effects, (decision, other))
        if taken is not None:
            attacks.append(_without_idle(machine, channels, votes, cells, taken))
    return min(attacks, key=lambda taken: int(cells.cost[taken].sum()), default=np.zeros(0, np.int64))


def _easiest(gaps: IntArray, decision: int, cells: Cells, effects: Effects) -> list[int]:
    """The two classes against which the fewest events might do."""
    worth = effects.votes - effects.votes[:, [decision]]
    each = (worth / cells.cost[:, None]).max(axis=0)
    effort = np.where(each > 0, gaps / np.maximum(each, 1e-9), np.inf)
    effort[decision] = np.inf
    return [int(other) for other in np.argsort(effort, kind="stable")[:2] if np.isfinite(effort[other])]


def _against(
    machine: Machine,
    channels: EventArray,
    votes: IntArray,
    cells: Cells,
    effects: Effects,
    sides: tuple[int, int],
) -> IntArray | None:
    """Entries whose flips make one class win, or any other, over the decision."""
    decision, other = sides
    changed = channels.copy()
    now = votes
    taken = np.zeros(0, np.int64)
    those = np.arange(len(cells.cells))
    for _ in range(ROUNDS):
        lacking = needed(now)[1][other] if int(np.argmax(now)) == decision else 0
        gap = (lacking + 1) // 2
        worth = effects.votes[:, other] - effects.votes[:, decision]
        order = np.argsort(-worth / cells.cost[those], kind="stable")
        busy = np.zeros(int(effects.end.max(initial=0)) + 2, np.bool_)
        chosen: list[int] = []
        for e in order[worth[order] > 0].tolist():
            begin = cells.cells[those[e], 1]
            end = effects.end[e]
            if gap <= 0:
                break
            if not busy[begin:end].any():
                busy[begin:end] = True
                chosen.append(e)
                gap -= worth[e]
        if not chosen:
            return None
        taken = np.concatenate([taken, those[chosen]])
        channel, step = cells.cells[those[chosen]].T
        changed[channel, step] ^= 1
        now = machine.votes(changed[None])[0]
        if int(np.argmax(now)) != decision:
            return taken
        left = order[~np.isin(those[order], taken)][:CANDIDATES]
        those = np.sort(those[left])
        effects = machine.effects(changed, single(cells.cells[those]))
    return None


def _without_idle(
    machine: Machine, channels: EventArray, votes: IntArray, cells: Cells, taken: IntArray
) -> IntArray:
    """Entries whose flips still alter the decision when none can be dropped alone."""
    while len(taken) > 1:
        fewer = [np.delete(taken, place) for place in range(len(taken))]
        changed = machine.effects(channels, joined([cells.cells[each] for each in fewer])).votes + votes
        idle = np.flatnonzero(changed.argmax(axis=1) != votes.argmax())
        if not len(idle):
            break
        taken = fewer[max(idle.tolist(), key=lambda place: int(cells.cost[taken[place]]))]
    return taken
