"""When a vote is decided: by proof, or as sure as other recordings say.

Votes only ever add up, and the network is causal, so the decision after any step is known without running
anything twice. A vote ends early

* *by proof*, when no spikes whatever can change it: every rival is behind by more than it can still gain while the
  leader gets nothing more. An output neuron gains at most one vote a step, or fewer where even its largest
  input takes several steps to lift it over its threshold (:func:`most_votes`), and exactly one where its own
  spike lifts it over it again (:func:`steady_classes`);
* *by calibration*, when the leader is ahead by more than ``a * sqrt(steps left)``: the lead of one neuron over another
  strays from its course about as the root of the steps. The factor comes from other recordings.

*Calibration.* In recordings that the network was trained on, their class leads by far. Without the winner's votes a
race for second place is left, as narrow and fickle as votes on unknown recordings, which can say it themselves.

References
----------
.. [1] S. S. Wilks, "Determination of sample sizes for setting tolerance limits", Ann. Math. Stat. 12, 1941: the share
   beyond an order statistic of n values follows a beta distribution, whatever theirs.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from spikeloom.compiler.types import BoolArray, FloatArray, IntArray
from spikeloom.runtime.machines.capabilities import Stoppable
from spikeloom.runtime.machines.votes import wins
from spikeloom.runtime.report.encode import key

CONFIDENCE = 0.95
"""Of the bound on the share of other races that end otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standing:
    """Where votes stand after each step of the read-out, (samples, steps).

    The class with most votes, the lowest on a tie; the votes by which it is ahead of the next; and the steps
    that are still to come, 0 from a recording's end on.
    """

    leader: IntArray
    lead: IntArray
    left: IntArray

    @property
    def decision(self) -> IntArray:
        """Leader in the end; shape (samples,)."""
        return self.leader[:, -1]

    @property
    def confidence(self) -> FloatArray:
        """Lead in votes per root of a step that is left, infinite at the end; shape (samples, steps)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found: FloatArray = np.where(self.left == 0, np.inf, self.lead / np.sqrt(self.left))
        return found


def standing(votes: IntArray, lengths: IntArray) -> Standing:
    """Say who leads, by how much, and for how long that can still change.

    Votes so far, (samples, steps, classes); of recordings shorter than the longest they stay as they are
    from their end on, `lengths` (samples,) says where.
    """
    ahead = votes[..., 0]
    if votes.shape[2] > 1:
        second, first = np.moveaxis(np.partition(votes, -2)[..., -2:], -1, 0)
        ahead = first - second
    left = np.maximum(np.reshape(lengths, (-1, 1)) - 1 - np.arange(votes.shape[1]), 0)
    return Standing(leader=np.argmax(votes, axis=2), lead=ahead, left=left)


def most_votes(machine: Stoppable, steps: int) -> IntArray:
    """Most votes that each class can still get when 0 … `steps` steps are left; shape (classes, steps + 1)."""
    netlist = machine.netlist
    interval = machine.least_intervals
    left = np.arange(steps + 1)
    each = np.where(interval[:, None] > 0, -(-left // np.maximum(interval, 1)[:, None]), 0)
    most = np.zeros((netlist.classes, steps + 1), np.int64)
    np.add.at(most, netlist.readout_class[netlist.voters], each)
    return most


def steady_classes(machine: Stoppable) -> BoolArray:
    """Classes that get a vote in every step after their first one; shape (classes,)."""
    classes = machine.netlist.classes
    votes = machine.netlist.readout_class[machine.netlist.voters]
    counts = [np.bincount(each, minlength=classes) for each in (votes, votes[machine.steady])]
    return np.asarray((counts[0] == 1) & (counts[1] == 1))


def proven(votes: IntArray, at: Standing, most: IntArray, steady: BoolArray | None = None) -> BoolArray:
    """Whether the decision after each step is the last word, whatever follows; shape (samples, steps).

    `most` (classes, longest + 1) is that of :func:`most_votes`, `steady` (classes,) that of
    :func:`steady_classes`.
    """
    classes = votes.shape[2]
    reach = votes + most.T[at.left]
    least = votes if steady is None else votes + at.left[..., None] * (steady & (votes > 0))
    sure = wins(at.leader.reshape(-1), least.reshape(-1, classes), reach.reshape(-1, classes))
    return sure.reshape(at.leader.shape)


def exits(sure: BoolArray, at: Standing, factor: float = np.inf) -> IntArray:
    """Step of the read-out, from 0, after which each recording may end; shape (samples,).

    By the proof, or where the leader is ahead by more than `factor` votes per root of a step left.
    """
    return np.asarray(np.argmax(sure | (at.confidence > factor), axis=1))


def live(machine: Stoppable, bins: int, factor: float) -> Callable[[int, IntArray], bool]:
    """The rule of a grasp of so many bins that is stepped live.

    It takes a chip step, from 0, and the votes (classes,) after it, and says whether the grasp may end.
    """
    most = most_votes(machine, bins)
    steady = steady_classes(machine)
    depth = machine.read_out_lag

    def may_end(chip_step: int, counts: IntArray) -> bool:
        seen = chip_step + 1 - depth
        if seen < 1:
            return False
        votes = counts[None, None]
        now = standing(votes, np.array([bins - seen + 1]))
        return bool(proven(votes, now, most, steady)[0, 0] or now.confidence[0, 0] > factor)

    return may_end


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """A factor, in votes per root of a step left, and what it rests on.

    Of `races`, or held-out decisions, the share `allowed` may end otherwise, `differ` do; of others at most
    the share `bound` does, with the confidence of ``CONFIDENCE`` [1]_. The proof rests on none: ``PROOF``.
    """

    allowed: float | None
    factor: float
    races: int | None
    differ: int | None = field(metadata=key("races_differ"))
    bound: float | None


PROOF = Calibrated(allowed=None, factor=np.inf, races=None, differ=None, bound=None)
"""No vote ends early but those that nothing can change."""


def races(votes: IntArray, lengths: IntArray) -> Standing:
    """Standing of the race for second place: the votes of each recording without those of its winner.

    With two classes there is none; then that of the vote itself.
    """
    whole = standing(votes, lengths)
    if votes.shape[2] < 3:
        return whole
    others = votes.copy()
    others[np.arange(len(votes)), :, whole.decision] = -1
    return standing(others, lengths)


def turning_points(at: Standing) -> FloatArray:
    """Largest factor with which each recording ends with another decision; 0 where none does; shape (samples,)."""
    confidence = at.confidence
    before = np.maximum.accumulate(confidence, axis=1)[:, :-1]
    before = np.concatenate([np.zeros((len(before), 1)), before], axis=1)
    ends = (confidence > before) & (
        at.leader != at.decision[:, None]
    )  # a smaller one would have ended it already
    return np.asarray(np.where(ends, confidence, 0.0).max(axis=1, initial=0.0), np.float64)


def calibrate(points: FloatArray, allowed: float) -> Calibrated:
    """Smallest factor with which at most the share `allowed` of races ends otherwise, and so with every larger one."""
    from scipy.special import betaincinv  # a tenth of a second that other commands need not wait

    spared = int(allowed * len(points) + 1e-9)
    factor = float(np.sort(points)[::-1][spared])
    bound = float(betaincinv(spared + 1, len(points) - spared, CONFIDENCE))
    return Calibrated(
        allowed=allowed,
        factor=factor,
        races=len(points),
        differ=int(np.count_nonzero(points > factor)),
        bound=round(bound, 4),
    )
