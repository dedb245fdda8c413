"""Events of many recordings in a temporary file, at a bit each: some at a time are read when they are asked for."""

import math
import os
import weakref
from collections.abc import Callable
from functools import cached_property
from tempfile import SpooledTemporaryFile
from threading import Lock
from typing import Any

import numpy as np

from spikeloom.compiler.arrays import frozen
from spikeloom.compiler.types import EventArray

IN_MEMORY = 32 << 20
"""Bytes that stay in memory; more lie on disk, in the folder for temporary files."""

Change = Callable[[EventArray, range], EventArray]
"""Makes events (some recordings, taxels, polarities, steps) of others, and of the numbers of these recordings."""


class EventFile:
    """Recordings one after another, each of its own shape (taxels, polarities, steps)."""

    def __init__(self) -> None:
        self._file = SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115 (closed when this goes)
        weakref.finalize(self, self._file.close)
        self._lock = Lock()
        self._places: list[tuple[int, tuple[int, ...]]] = []
        self._on_disk: int | None = None  # Descriptor, once it is there

    def append(self, grid: EventArray) -> None:
        """Write one more."""
        self._places.append((self._file.tell(), grid.shape))
        self._file.write(np.packbits(grid != 0).data)
        if self._file.tell() > IN_MEMORY:
            self._file.flush()
            self._on_disk = self._file.fileno()

    def read(self, index: int) -> EventArray:
        """One of them, uint8."""
        place, shape = self._places[index]
        size = math.prod(shape)
        # `seek` would move the place of forked processes, too
        if self._on_disk is not None and hasattr(os, "pread"):
            content = os.pread(self._on_disk, -(-size // 8), place)
        else:
            with self._lock:
                self._file.seek(place)
                content = self._file.read(-(-size // 8))
        bits = np.frombuffer(content, np.uint8)
        return np.unpackbits(bits, count=size).reshape(shape)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of an array that holds all."""
        taxels, polarities, steps = np.max([shape for _, shape in self._places], axis=0).tolist()
        return len(self._places), taxels, polarities, steps


class Stored:
    """Events (recordings, taxels, polarities, steps): a slice of recordings is an array, uint8, read there and then.

    Shorter recordings are filled up with silence to so many `steps`.
    """

    def __init__(self, file: EventFile, steps: int, changes: tuple[tuple[int, Change], ...] = ()) -> None:
        self._file = file
        self._steps = steps
        self._changes = changes
        changed = changes[-1][0] if changes else steps
        self.shape = (*file.shape[:3], changed)
        self.dtype = np.dtype(np.uint8)

    def __len__(self) -> int:
        """Return the number of recordings."""
        return self.shape[0]

    def __getitem__(self, rows: slice) -> EventArray:
        """Events of some recordings."""
        chosen = range(len(self))[rows]
        events: EventArray = np.zeros((len(chosen), *self.shape[1:3], self._steps), np.uint8)
        for target, index in zip(events, chosen, strict=True):
            grid = self._file.read(index)
            target[: grid.shape[0], :, : grid.shape[2]] = grid
        for _, change in self._changes:
            events = change(events, chosen)
        return events

    def changed(self, steps: int, change: Change) -> "Stored":
        """The same recordings with events, of so many steps, that are changed when they are read."""
        return Stored(self._file, self._steps, (*self._changes, (steps, change)))

    @cached_property
    def whole(self) -> EventArray:
        """All in memory, read-only."""
        return frozen(np.ascontiguousarray(self[:]))

    def __reduce__(self) -> tuple[Any, ...]:
        """As an array, for another process."""
        return frozen, (self.whole,)
