"""What may happen to recordings between a finger and a chip: pure functions from events to events.

All take events (recordings, taxels, 2, T) uint8, zeros and ones, hand back as many in the same form, and draw from the
generator that they are given. For one seed a stronger disturbance contains the weaker one wherever that makes sense:
five dead taxels are the three and two more, an event that is lost at a rate of 0.1 is lost at 0.2. Clocks are no
taxels; they are not among the events here.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spikeloom.compiler.fixedpoint import FloatArray, IntArray

Events = npt.NDArray[np.uint8]


def chosen(taxels: int, count: int, rng: np.random.Generator) -> IntArray:
    """Some taxels at random; (count,) int64."""
    picked: IntArray = rng.permutation(taxels)[:count]
    return picked


def neighbours(distance: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """A taxel at random and those nearest to it, it among them; (count,) int64.

    Parameters
    ----------
    distance : (taxels, taxels) float64
        In any unit; of equal ones the lower number is nearer.
    """
    centre = int(rng.integers(len(distance)))
    order = np.argsort(distance[centre], kind="stable")
    return np.append(centre, order[order != centre])[:count]


def silence(events: Events, taxels: IntArray) -> Events:
    """Dead taxels: no events."""
    found = events.copy()
    found[:, taxels] = 0
    return found


def stick(events: Events, taxels: IntArray) -> Events:
    """Stuck taxels: an event of either polarity in every step."""
    found = events.copy()
    found[:, taxels] = 1
    return found


def lose(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each event is lost with a probability."""
    return events & (rng.random(events.shape, np.float32) >= share)


def invent(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each entry (taxel, polarity, step) gets an event that is not there with a probability."""
    return events | (rng.random(events.shape, np.float32) < share)


def jitter(events: Events, sigma: float, rng: np.random.Generator) -> Events:
    """Each event moves by a normal number of steps, rounded; not beyond the ends. What meets becomes one event.

    Parameters
    ----------
    sigma : float
        Standard deviation, steps.
    """
    sample, taxel, polarity, step = np.nonzero(events)
    moved = step + np.rint(sigma * rng.standard_normal(len(step))).astype(np.int64)
    found = np.zeros_like(events)
    found[sample, taxel, polarity, np.clip(moved, 0, events.shape[3] - 1)] = 1
    return found


def start_late(events: Events, steps: int) -> Events:
    """The grasp begins later than the recording: silence first, the end is cut off."""
    found = np.zeros_like(events)
    found[..., steps:] = events[..., : max(events.shape[3] - steps, 0)]
    return found


def start_early(events: Events, steps: int) -> Events:
    """The grasp began before the recording: its first steps are missing, silence at the end."""
    found = np.zeros_like(events)
    found[..., : max(events.shape[3] - steps, 0)] = events[..., steps:]
    return found


def play(events: Events, speed: float) -> Events:
    """The grasp takes place faster (above 1) or more slowly (below): events come at step / speed.

    In a faster one events that meet become one, and silence follows; of a slower one the end is cut off, and each event
    stays one event.
    """
    sample, taxel, polarity, step = np.nonzero(events)
    moved = (step / speed).astype(np.int64)
    kept = moved < events.shape[3]
    found = np.zeros_like(events)
    found[sample[kept], taxel[kept], polarity[kept], moved[kept]] = 1
    return found


def swap_polarity(events: Events, taxels: IntArray) -> Events:
    """Some taxels tell rise from fall the wrong way round; done twice it is undone."""
    found = events.copy()
    found[:, taxels] = events[:, taxels, ::-1]
    return found


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
    found = np.zeros_like(flat)
    for row, ranked, own in zip(found, order, flat, strict=True):
        there = int(np.count_nonzero(own))
        row[ranked[: min(there, wanted) if keep else max(there, wanted)]] = 1
    return found.reshape(events.shape)
