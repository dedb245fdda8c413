"""What may happen to recordings between a finger and a chip: pure functions from events to events.

All take events (recordings, taxels, 2, T) uint8, zeros and ones, hand back as many in the same form, and draw from the
generator that they are given. For one seed a stronger disturbance contains the weaker one wherever that makes sense:
five dead taxels are the three and two more, an event that is lost at a rate of 0.1 is lost at 0.2. Clocks are no
taxels; they are not among the events here.
"""

from collections.abc import Callable

import numpy as np

from spikeloom.compiler.types import FloatArray, IntArray
from spikeloom.runtime.studies.stress.pair import TAXELS, Events, Pair, perturbation

COUNTS = (1, 3, 5, 10, 20)
STEPS = (2, 5, 10, 25, 50)
TEMPO = (1.1, 1.25, 1.5, 2, 4)
MOST_STEPS = 100_000

DENSITY = "share of entries with an event"


def chosen(events: Events, count: int, rng: np.random.Generator) -> IntArray:
    """Some taxels at random; (count,) int64."""
    return np.asarray(rng.permutation(events.shape[1])[:count])


def neighbours(distance: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """A taxel at random and those nearest to it, it among them; (count,) int64.

    Distances (taxels, taxels) are in any unit; of equal ones the lower number is nearer.
    """
    centre = int(rng.integers(len(distance)))
    order = np.argsort(distance[centre], kind="stable")
    return np.append(centre, order[order != centre])[:count]


@perturbation(TAXELS, COUNTS, most=np.inf)
def taxels_dead(events: Events, count: int, rng: np.random.Generator) -> Events:
    """Random taxels send nothing."""
    return held(events, chosen(events, count, rng), 0)


@perturbation(TAXELS, COUNTS, most=np.inf)
def taxels_dead_adjacent(events: Events, count: int, distance: FloatArray, rng: np.random.Generator) -> Events:
    """A taxel and its nearest ones send nothing."""
    return held(events, neighbours(distance, count, rng), 0)


@perturbation(TAXELS, COUNTS, most=np.inf)
def taxels_stuck(events: Events, count: int, rng: np.random.Generator) -> Events:
    """Random taxels send both polarities in every step."""
    return held(events, chosen(events, count, rng), 1)


@perturbation(TAXELS, COUNTS, most=np.inf)
def taxels_stuck_adjacent(events: Events, count: int, distance: FloatArray, rng: np.random.Generator) -> Events:
    """A taxel and its nearest ones send both polarities in every step."""
    return held(events, neighbours(distance, count, rng), 1)


def held(events: Events, taxels: IntArray, value: int) -> Events:
    """Some taxels are dead (0: no events) or stuck (1: an event of either polarity in every step)."""
    changed = events.copy()
    changed[:, taxels] = value
    return changed


@perturbation("probability", (0.1, 0.25, 0.5, 0.75, 0.9))
def events_lost(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each event is lost with a probability."""
    return _one_by_one(events, lambda one: one & (rng.random(one.shape, np.float32) >= share))


@perturbation("probability", (0.005, 0.01, 0.02, 0.05, 0.1))
def events_spurious(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Each empty entry gets an event with a probability."""
    return _one_by_one(events, lambda one: one | (rng.random(one.shape, np.float32) < share))


def _one_by_one(events: Events, change: Callable[[Events], Events]) -> Events:
    """Change each recording on its own: numbers that are drawn for all entries of all would fill the memory."""
    changed = np.empty_like(events)
    for one, to in zip(events, changed, strict=True):
        to[...] = change(one)
    return changed


@perturbation("steps, standard deviation", (1, 2, 5, 10, 25), most=MOST_STEPS)
def time_jitter(events: Events, sigma: float, rng: np.random.Generator) -> Events:
    """Each event moves by a normal number of steps.

    Not beyond the ends; what meets becomes one event.
    """
    last = events.shape[3] - 1
    return moved(events, lambda step: np.clip(step + np.rint(sigma * rng.standard_normal(len(step))), 0, last))


@perturbation("steps", STEPS, most=MOST_STEPS)
def start_late(events: Events, steps: int) -> Events:
    """The grasp begins later than the recording.

    Silence first, the end is cut off.
    """
    return moved(events, lambda step: step + steps)


@perturbation("steps", STEPS, most=MOST_STEPS)
def start_early(events: Events, steps: int) -> Events:
    """The first steps of the grasp are missing.

    Silence at the end.
    """
    return moved(events, lambda step: step - steps)


@perturbation("times", TEMPO, least=1, most=MOST_STEPS)
def faster(events: Events, times: float) -> Events:
    """The grasp takes place faster."""
    return play(events, times)


@perturbation("times", TEMPO, least=1, most=MOST_STEPS)
def slower(events: Events, times: float) -> Events:
    """The grasp takes place more slowly, its end is cut off."""
    return play(events, 1 / times)


def play(events: Events, speed: float) -> Events:
    """Events come at step / speed; those that meet become one, and each stays one event."""
    return moved(events, lambda step: step / speed)


def moved(events: Events, to: Callable[[IntArray], FloatArray | IntArray]) -> Events:
    """Events at other steps, fractions cut off; what leaves the recording is lost."""
    sample, taxel, polarity, step = np.nonzero(events)
    there = to(step).astype(np.int64)
    kept = (0 <= there) & (there < events.shape[3])
    changed = np.zeros_like(events)
    changed[sample[kept], taxel[kept], polarity[kept], there[kept]] = 1
    return changed


def not_two_polarities(pair: Pair) -> str | None:
    """Why there is nothing to exchange."""
    count = pair.netlist.polarities
    return None if count == 2 else f"the sensor has {count} polarities"


@perturbation("share of taxels", (0.1, 0.25, 0.5, 1), unless=not_two_polarities)
def polarity_swapped(events: Events, share: float, rng: np.random.Generator) -> Events:
    """Random taxels exchange rise and fall."""
    return swap_polarity(events, chosen(events, round(share * events.shape[1]), rng))


def swap_polarity(events: Events, taxels: IntArray) -> Events:
    """Some taxels report rise as fall and fall as rise; done twice it is undone."""
    changed = events.copy()
    changed[:, taxels] = events[:, taxels, ::-1]
    return changed


@perturbation(DENSITY, (0.1, 0.05, 0.02, 0.005, 0.001))
def near_empty(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Events are taken away down to a density."""
    return _filled(events, density, rng, keep=True)


@perturbation(DENSITY, (0.15, 0.2, 0.3, 0.5, 1))
def saturated(events: Events, density: float, rng: np.random.Generator) -> Events:
    """Events are added up to a density."""
    return _filled(events, density, rng, keep=False)


def _filled(events: Events, density: float, rng: np.random.Generator, *, keep: bool) -> Events:
    """Bring recordings to a density: from above if `keep`, else from below; others stay as they are."""
    flat = events.reshape(len(events), -1)
    wanted = int(np.floor(density * flat.shape[1]) if keep else np.ceil(density * flat.shape[1]))

    def filled(before: Events) -> Events:
        # entries that hold an event come first, each kind in random order: the first `wanted` ones hold an event then
        ranked = np.argsort(rng.random(before.shape, np.float32) - before, kind="stable")
        there, changed = int(np.count_nonzero(before)), np.zeros_like(before)
        changed[ranked[: min(there, wanted) if keep else max(there, wanted)]] = 1
        return changed

    return _one_by_one(flat, filled).reshape(events.shape)
