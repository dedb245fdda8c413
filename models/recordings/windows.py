"""The first part of recordings: what is known when a share of a grasp has passed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import IntArray
from spikeloom.models.recordings.evtouch import Recordings

WHOLE = 100
"""Per cent of a recording."""


def parse_window(words: str) -> int:
    """Per cent of each recording, a whole number from 1 to 100, from the words of ``--window``.

    Examples
    --------
    >>> parse_window("25%"), parse_window("100")
    (25, 100)
    """
    found = re.fullmatch(r"([0-9]{1,3})%?", words.strip(), re.ASCII)
    if found is None or not 1 <= int(found[1]) <= WHOLE:
        raise OptionError(f"--window {words}: not a part of a recording; give whole per cent from 1% to 100%")
    return int(found[1])


def steps_of(lengths: IntArray, percent: int) -> IntArray:
    """Whole steps of a part of each recording, one at least.

    Examples
    --------
    >>> steps_of(np.array([325, 3, 1]), 50).tolist()
    [162, 1, 1]
    """
    return np.maximum(lengths * percent // WHOLE, 1)


def first_part(recordings: Recordings, percent: int) -> Recordings:
    """The first steps of every recording, so many per cent of its own length; labels, names and order stay."""
    if percent == WHOLE:
        return recordings
    own = recordings.step_counts
    kept = steps_of(own, percent)
    longest = int(kept.max(initial=0))
    return replace(
        recordings,
        events=recordings.events[..., :longest],
        lengths=None if recordings.lengths is None else kept,
    )
