"""What is left out in turn: a condition of the recordings at a time, or a part of them at random."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spikeloom.compiler.types import BoolArray
from spikeloom.models.recordings.conditions import conditions
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.models.training.counters import FOLDS, split_folds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fold:
    """Recordings that are left out together, and the condition that they have in common, if any."""

    held: BoolArray  # (samples,)
    condition: str | None = None


def folds_of(data: Recordings, rounds: int, *, at_random: bool = False) -> list[list[Fold]]:
    """Rounds of cross-validation: in each of them every recording is left out once.

    A round for each group column of the recordings, which leaves out one of its conditions at a time. Without
    conditions, or `at_random`, so many rounds whose parts have the same share of every class.
    """
    known = {} if at_random else conditions(data)
    if known:
        return [
            [Fold(held=held, condition=name) for name, held in parts.items()] for parts in known.values()
        ]
    seeds = range(1, rounds + 1) if rounds > 1 else (0,)
    parts = [split_folds(data.labels, FOLDS, np.random.default_rng(seed)) for seed in seeds]
    return [[Fold(held=fold == part) for part in np.unique(fold)] for fold in parts]


def every(rounds: list[list[Fold]]) -> Iterator[Fold]:
    """All of them, one after the other: the first of each round come first."""
    longest = max(map(len, rounds))
    for index in range(longest):
        yield from (each[index] for each in rounds if index < len(each))
