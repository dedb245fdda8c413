"""Synthetic grasps: simple shapes pressed into a taxel layout and lifted again, as event recordings.

They stand in for real recordings in the demonstration and in tests. A shape is a rigid surface whose gap
over the skin, at first contact, is a function of place. Pressing it in by a depth loads each taxel in
proportion to depth less gap. A taxel reports each level of load that it crosses: rising as polarity 1,
falling as polarity 0.

After the generator drew its numbers, only operations that IEEE 754 rounds exactly touch them (no sine, no
exponential), so that a seed gives the same bytes wherever numpy draws the same numbers.
"""

import numpy as np
from numpy.typing import ArrayLike

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.types import BoolArray, FloatArray
from spikeloom.models.graphs import NEUTOUCH, check_coordinates
from spikeloom.models.recordings.evtouch import Recordings

SHAPES = ("sphere", "cylinder", "edge", "ring", "cone", "box")
"""Names of the shapes; the default classes, in this order."""

MIN_STEPS = 10

# Lengths are in radii of the layout (half of what the taxels span), loads in depth; chosen so that events
# are as dense as in the real recordings (8 to 16 %) and that a linear rule on their counts tells most shapes
# apart, not all: 0.85 of new grasps after 60 of each class.
_SHIFT = 0.15  # centre of the shape, most, along each axis
_SIZES = 0.8, 1.2
_DEPTHS = 0.3, 0.4
_GAINS = 0.8, 1.2  # of one taxel
_ONSETS = 0.02, 0.10  # of the recording, as are the next two
_RISES = 0.25, 0.40
_FALLS = 0.20, 0.35
_SWAYS = 0.10, 0.25  # of the depth: the hand trembles while it holds
_PERIODS = 0.10, 0.20
_LEVELS_PER_STEP = 0.25  # levels in the full depth, for each step of the recording
_JITTER = 0.4  # of a level, in each step under load
_STRAY = 0.01  # events from nothing


SYNTHETIC = "synthetic"
"""Name of these recordings where data is asked for."""

SPLITS = {"train": (60, 1), "test": (24, 2)}
"""Grasps of each class, and the seed, of the splits that stand in for a data set."""

SPLIT_STEPS = 100


def synthetic_split(
    split: str, *, limit: int | None = None, coordinates: ArrayLike = NEUTOUCH
) -> Recordings:
    """Draw the split of the fixed synthetic data set that the shipped checkpoint was trained and tested on.

    360 training or 144 test recordings of 100 steps, 6 classes, or the first `limit` of them. With
    `coordinates` the same grasps touch another sensor.
    """
    if split not in SPLITS:
        raise OptionError(
            f"--split {split}: the synthetic grasps have no such split; allowed: {', '.join(SPLITS)}"
        )
    if limit is not None and limit < 1:
        raise OptionError(f"--limit {limit}: at least 1 recording is needed; give a positive number")
    per_class, seed = SPLITS[split]
    grasps = synthetic_grasps(coordinates=coordinates, per_class=per_class, steps=SPLIT_STEPS, seed=seed)
    return grasps.part(slice(limit), split)


def synthetic_grasps(
    *,
    coordinates: ArrayLike = NEUTOUCH,
    per_class: int,
    steps: int,
    seed: int,
    classes: tuple[str, ...] = SHAPES,
) -> Recordings:
    """Draw grasps with random place, orientation, size, depth and speed.

    Of the layout `coordinates` (taxels, 2) in any unit only the proportions matter. A recording has `steps`,
    at least `MIN_STEPS`. Each grasp has a stream of its own: those of a smaller `per_class` come first in a
    larger one, and the choice of `classes` among `SHAPES`, along which labels count, does not change them.
    Classes come in turn, so that the first recordings hold all of them.

    Examples
    --------
    >>> grasps = synthetic_grasps(per_class=2, steps=50, seed=0)
    >>> grasps.events.shape, grasps.labels.tolist()
    ((12, 39, 2, 50), [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 5])
    """
    for name, value, least in (("per_class", per_class, 1), ("steps", steps, MIN_STEPS), ("seed", seed, 0)):
        if value < least:
            raise OptionError(f"grasps: {name} is {value}, allowed are {least} or more; choose another")
    if not classes or len(set(classes) & set(SHAPES)) < len(classes):
        raise OptionError(
            f"grasps: classes {', '.join(classes)}; choose from {', '.join(SHAPES)}, each once"
        )

    place = _unit_layout(check_coordinates(coordinates))
    labels = np.tile(np.arange(len(classes), dtype=np.int64), per_class)
    events = np.empty((len(labels), len(place), 2, steps), dtype=np.uint8)
    for index, label in enumerate(labels.tolist()):
        stream = np.random.SeedSequence(
            seed, spawn_key=(SHAPES.index(classes[label]), index // len(classes))
        )
        events[index] = _grasp(np.random.Generator(np.random.PCG64(stream)), classes[label], place, steps)
    return Recordings(
        held=events,
        labels=labels,
        files=tuple(f"sample_{index}_label_{label}.npy" for index, label in enumerate(labels.tolist())),
        split="synthetic",
        source=f"synthetic grasps, seed {seed}",
    )


def _unit_layout(coordinates: FloatArray) -> FloatArray:
    """First two dimensions, centred, the longer side spanning -1 to 1."""
    place: FloatArray = np.zeros((len(coordinates), 2))
    place[:, : coordinates.shape[1]] = coordinates[:, :2]
    low: FloatArray = place.min(axis=0)
    high: FloatArray = place.max(axis=0)
    half = float((high - low).max()) / 2
    return (place - (low + high) / 2) / (half or 1.0)


def _grasp(rng: np.random.Generator, shape: str, place: FloatArray, steps: int) -> BoolArray:
    """One recording, (taxels, 2, steps)."""
    size = _draw(rng, _SIZES)
    x, y = ((place - _SHIFT * (2 * rng.random(2) - 1)) / size).T
    half = 2 * rng.random() - 1  # tangent of half the angle: a half turn without sine or cosine
    cosine = (1 - half * half) / (1 + half * half)
    sine = 2 * half / (1 + half * half)
    gap = size * _gap(shape, cosine * x + sine * y, cosine * y - sine * x)

    full = _draw(rng, _DEPTHS)
    gain = _GAINS[0] + (_GAINS[1] - _GAINS[0]) * rng.random(len(place))
    load = np.maximum(full * _course(rng, steps) - gap[:, None], 0) * gain[:, None]
    level = _DEPTHS[1] / (_LEVELS_PER_STEP * steps)
    jitter = _JITTER * (2 * rng.random(load.shape) - 1)
    levels = np.floor(np.where(load > 0, load / level + jitter, 0))
    change = np.diff(levels, axis=1, prepend=0)
    events = np.stack([change < 0, change > 0], axis=1)
    return events | (rng.random(events.shape) < _STRAY)


def _gap(shape: str, x: FloatArray, y: FloatArray) -> FloatArray:
    """Height of a shape of unit size over the skin, zero where it touches first."""
    radius = np.sqrt(x * x + y * y)
    match shape:
        case "sphere":
            return 1.2 * radius * radius
        case "cylinder":
            return 1.5 * y * y
        case "edge":
            return 1.5 * np.abs(y)
        case "ring":
            return 1.5 * np.abs(radius - 0.6)
        case "cone":
            return radius
        case _:  # box: flat, with steep sides
            return 3.0 * np.maximum(np.maximum(np.abs(x), np.abs(y)) - 0.55, 0)


def _course(rng: np.random.Generator, steps: int) -> FloatArray:
    """Depth over time, 0 to about 1, (steps,): press, hold with a tremor, lift."""
    time = np.arange(steps) / steps
    onset = _draw(rng, _ONSETS)
    rise = _draw(rng, _RISES)
    fall = _draw(rng, _FALLS)
    pressed = np.minimum((time - onset) / rise, (1 - time) / fall)
    wave = time / _draw(rng, _PERIODS)
    sway = _draw(rng, _SWAYS) * (2 * np.abs(wave - np.floor(wave) - 0.5) - 0.5)
    return np.clip(pressed, 0, 1) * (1 + sway)


def _draw(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """Uniform number between two bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * rng.random()
