"""What may happen to recordings between a finger and a chip: pure functions from events to events.

All take events (recordings, taxels, 2, T) uint8, zeros and ones, hand back as many in the same form, and draw from the
generator that they are given. For one seed a stronger disturbance contains the weaker one wherever that makes sense:
five dead taxels are the three and two more, an event that is lost at a rate of 0.1 is lost at 0.2. Clocks are no
taxels; they are not among the events here.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.types import FloatArray, IntArray

Events = npt.NDArray[np.uint8]


def chosen(taxels: int, count: int, rng: np.random.Generator) -> IntArray:
    """Some taxels at random; (count,) int64."""
    picked: IntArray = rng.permutation(taxels)[:count]
    return picked


def neighbours(distance: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """A taxel at random and those nearest to it, it among them; (count,) int64.

    Distances (taxels, taxels) are in any unit; of equal ones the lower number is nearer.
    """
    centre = int(rng.integers(len(distance)))
    order = np.argsort(distance[centre], kind="stable")
    return np.append(centre, order[order != centre])[:count]


def silence(events: Events, taxels: IntArray) -> Events:
    """Dead taxels: no events."""
    silent = events.copy()
    silent[:, taxels] = 0
    return silent


def stick(events: Events, taxels: IntArray) -> Events:
    """Stuck taxels: an event of either polarity in every step."""
    stuck = events.copy()
    stuck[:, taxels] = 1
    return stuck


def lose(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each event is lost with a probability."""
    return events & (rng.random(events.shape, np.float32) >= share)


def invent(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each entry (taxel, polarity, step) gets an event that is not there with a probability."""
    return events | (rng.random(events.shape, np.float32) < share)


def jitter(events: Events, sigma: float, rng: np.random.Generator) -> Events:
    """Each event moves by a normal number of steps, rounded; not beyond the ends. What meets becomes one event.

    `sigma` is the standard deviation in steps.
    """
    sample, taxel, polarity, step = np.nonzero(events)
    moved = step + np.rint(sigma * rng.standard_normal(len(step))).astype(np.int64)
    changed = np.zeros_like(events)
    changed[sample, taxel, polarity, np.clip(moved, 0, events.shape[3] - 1)] = 1
    return changed


def start_late(events: Events, steps: int) -> Events:
    """The grasp begins later than the recording: silence first, the end is cut off."""
    changed = np.zeros_like(events)
    changed[..., steps:] = events[..., : max(events.shape[3] - steps, 0)]
    return changed


def start_early(events: Events, steps: int) -> Events:
    """The grasp began before the recording: its first steps are missing, silence at the end."""
    changed = np.zeros_like(events)
    changed[..., : max(events.shape[3] - steps, 0)] = events[..., steps:]
    return changed


def play(events: Events, speed: float) -> Events:
    """The grasp takes place faster (above 1) or more slowly (below): events come at step / speed.

    In a faster one events that meet become one, and silence follows; of a slower one the end is cut off, and each event
    stays one event.
    """
    sample, taxel, polarity, step = np.nonzero(events)
    moved = (step / speed).astype(np.int64)
    kept = moved < events.shape[3]
    changed = np.zeros_like(events)
    changed[sample[kept], taxel[kept], polarity[kept], moved[kept]] = 1
    return changed


def swap_polarity(events: Events, taxels: IntArray) -> Events:
    """Some taxels report rise as fall and fall as rise; done twice it is undone."""
    changed = events.copy()
    changed[:, taxels] = events[:, taxels, ::-1]
    return changed


def thin(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Leave so few events at random that at most a share of all entries of each recording holds one."""
    return _filled(events, density, rng, keep=True)


def fill(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Add events at random until at least a share of all entries of each recording holds one."""
    return _filled(events, density, rng, keep=False)


def _filled(events: Events, density: float, rng: np.random.Generator, *, keep: bool) -> Events:
    """Bring recordings to a density: from above if `keep`, else from below; others stay as they are."""
    flat = events.reshape(len(events), -1)
    wanted = int(np.floor(density * flat.shape[1]) if keep else np.ceil(density * flat.shape[1]))
    # entries that hold an event come first, each kind in random order: the first `wanted` ones hold an event then
    order = np.argsort(rng.random(flat.shape, np.float32) - flat, axis=1, kind="stable")
    changed = np.zeros_like(flat)
    for row, ranked, before in zip(changed, order, flat, strict=True):
        there = int(np.count_nonzero(before))
        row[ranked[: min(there, wanted) if keep else max(there, wanted)]] = 1
    return changed.reshape(events.shape)
