"""Divergences that arise by themselves, and those that only follow: the difference graph of one recording.

An *entry* is one neuron in one step, in aligned time; it *diverges* if float model and chip disagree about
its spike. A neuron remembers what happened since its last *common reset*, the last step in which both
fired: both membranes are zero after it. So an entry follows from

* the diverging entries of its presynaptic neurons, those of its own layer in the step before, and
* the earlier diverging entries of its own neuron,

in the steps that the neuron remembers. An entry that follows from none is a *root*: all its inputs agreed,
and yet it differs. Every diverging entry inherits the roots of what it follows from, and may have several.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.types import BoolArray
from spikeloom.runtime.machines.deviations import Sources


@dataclass(frozen=True, slots=True, kw_only=True)
class Root:
    """A divergence that arises although all inputs of the neuron agreed.

    The step counts data steps; the neuron remembers from step `begin`, the one after its last common
    reset. Of later entries `dragged` follow from it, perhaps among others, and `alone` of them from
    nothing else.
    """

    layer: int
    neuron: int
    step: int
    begin: int
    dragged: int
    alone: int


def find_roots(
    differs: Sequence[BoolArray], resets: Sequence[BoolArray], sources: Sources
) -> tuple[Root, ...]:
    """Separate roots from what follows, in one pass over steps and layers; those that drag most along come first.

    `differs` are the diverging entries of each population, (steps, neurons) bool, aligned with the data,
    populations in order of depth; `resets` entries after which a neuron remembers nothing: both fired, and
    its current does not outlast a step.

    Sets of roots are Python integers, one bit a root: a layer that is densely connected needs one union a
    step, and as many additions to its neurons' sets.
    """
    remembered = [[0] * array.shape[1] for array in differs]
    begin = [np.zeros(array.shape[1], np.int64) for array in differs]
    places: list[tuple[int, int, int, int]] = []
    sets: list[int] = []
    before: list[dict[int, int]] = [{} for _ in differs]
    for step in range(len(differs[0]) if differs else 0):
        arisen: list[dict[int, int]] = []  # sets of this step's entries, by population and neuron
        for post, differing in enumerate(differs):
            known = remembered[post]
            for pre, connected in sources[post]:
                _inherit(known, before[post] if pre == post else arisen[pre], connected)
            now: dict[int, int] = {}
            for neuron in np.flatnonzero(differing[step]).tolist():
                if not known[neuron]:
                    known[neuron] = 1 << len(places)
                    places.append((step, post, neuron, int(begin[post][neuron])))
                now[neuron] = known[neuron]
            arisen.append(now)
            sets += now.values()
            for neuron in np.flatnonzero(resets[post][step]).tolist():
                known[neuron] = 0
                begin[post][neuron] = step + 1
        before = arisen
    dragged, alone = _count(sets, len(places))
    roots = [
        Root(layer=post, neuron=neuron, step=step, begin=first, dragged=dragged[i] - 1, alone=alone[i] - 1)
        for i, (step, post, neuron, first) in enumerate(places)
    ]
    return tuple(sorted(roots, key=lambda root: (-root.dragged, root.step, root.layer, root.neuron)))


def _inherit(known: list[int], arisen: dict[int, int], connected: BoolArray) -> None:
    """Add the sets of presynaptic entries to those of the neurons that they reach."""
    if not arisen:
        return
    union = 0
    for bits in arisen.values():
        union |= bits
    reached: BoolArray = connected[list(arisen)]
    every = np.asarray(reached.all(axis=0))
    for neuron in np.flatnonzero(reached.any(axis=0)).tolist():
        if every[neuron]:
            known[neuron] |= union
        else:
            for bits, hit in zip(arisen.values(), reached[:, neuron].tolist(), strict=True):
                known[neuron] |= bits if hit else 0


def _count(sets: list[int], roots: int) -> tuple[list[int], list[int]]:
    """How many sets hold each root, and how many hold nothing else."""
    counts = np.zeros(roots, np.int64)
    alone = np.zeros(roots, np.int64)
    width = -(-roots // 8)
    for start in range(0, len(sets), 1024):
        part = sets[start : start + 1024]
        packed = np.frombuffer(b"".join(bits.to_bytes(width, "little") for bits in part), np.uint8)
        bits = np.unpackbits(packed.reshape(len(part), width), axis=1, bitorder="little", count=roots)
        counts += bits.sum(axis=0, dtype=np.int64)
        alone += bits[bits.sum(axis=1, dtype=np.int64) == 1].sum(axis=0, dtype=np.int64)
    return counts.tolist(), alone.tolist()
