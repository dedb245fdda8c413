"""Ways in which a quantised network is known to fail at once, looked for by name.

Shares of equal spikes hide them: a silent layer agrees with a quiet one, and one class for every recording
is right now and then.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.interpret import vote
from spikeloom.compiler.types import IntArray

OFTEN = 10
"""Spikes from which on a neuron that falls silent, or that wakes up, is worth a line."""

LISTED = 3
"""Neurons or recordings that a line names at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdown:
    """A known failure.

    Its kind (``silent layer``, ``silenced neurons``, ``woken neurons``, ``one class``, ``no vote`` or ``tied
    votes``), the layer if it is in one, how many spikes of the float model, neurons or recordings it
    concerns, and a line for people.
    """

    kind: str
    layer: str | None
    count: int
    text: str


def breakdowns(
    names: Sequence[str],
    reference: Sequence[IntArray],
    chip: Sequence[IntArray],
    neurons: Sequence[IntArray],
    votes: tuple[IntArray, IntArray],
    files: Sequence[str],
) -> tuple[Breakdown, ...]:
    """Look for all of them.

    `reference` and `chip` are the spikes of each layer, (compared,), of those neurons that `neurons`
    numbers; `votes` are those of float model and chip, (samples, classes), of recordings that `files` names.
    """
    failures: list[Breakdown] = []
    for name, ours, theirs, ids in zip(names, reference, chip, neurons, strict=True):
        failures += _fallen(name, ours, theirs, ids)
    return (*failures, *undecided(*votes, files))


def _fallen(name: str, before: IntArray, after: IntArray, ids: IntArray) -> list[Breakdown]:
    """Layers and neurons that fire on one side only."""
    total = int(before.sum())
    if total >= OFTEN and not after.any():
        text = f"{name} never fires on the chip; it fires {total:,} times in the float model"
        return [Breakdown(kind="silent layer", layer=name, count=total, text=text)]
    failures = []
    for kind, one, other, where, beside in (
        ("silenced neurons", before, after, "in the float model", "never on the chip"),
        ("woken neurons", after, before, "on the chip", "never in the float model"),
    ):
        silent = np.flatnonzero((one >= OFTEN) & (other == 0))
        silent = silent[np.argsort(-one[silent], kind="stable")]
        if len(silent):
            worst = ", ".join(f"{ids[i]} ({one[i]:,} times)" for i in silent[:LISTED])
            more = f" and {len(silent) - LISTED} more" if len(silent) > LISTED else ""
            text = f"{name} neurons that fire {where} and {beside}: {worst}{more}"
            failures.append(Breakdown(kind=kind, layer=name, count=len(silent), text=text))
    return failures


def undecided(before: IntArray, after: IntArray, files: Sequence[str]) -> list[Breakdown]:
    """Decisions that say nothing about the recording; votes (samples, classes) of the reference and of the chip."""
    failures = []
    decided = vote(after)
    wanted = vote(before)
    if len(set(decided)) == 1 and len(set(wanted)) > 1:
        text = f"the chip decides class {decided[0]} for every recording, the float model {len(set(wanted))} classes"
        failures.append(Breakdown(kind="one class", layer=None, count=len(decided), text=text))
    most = after.max(axis=1, initial=0)
    tied = (most > 0) & (np.count_nonzero(after == most[:, None], axis=1) > 1)
    for kind, what, where in (
        ("no vote", "without a single vote, so class 0 by rule", most == 0),
        ("tied votes", "decided among equal votes, the first class taken", tied),
    ):
        if count := int(np.count_nonzero(where)):
            named = ", ".join(files[i] for i in np.flatnonzero(where)[:LISTED])
            more = f" and {count - LISTED} more" if count > LISTED else ""
            text = f"{what}: {count} of {len(files)} recordings ({named}{more})"
            failures.append(Breakdown(kind=kind, layer=None, count=count, text=text))
    return failures
