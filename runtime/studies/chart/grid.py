"""What ``--grid`` says: axes and their values.

A grid is ``AXIS=VALUE,VALUE,AXIS=VALUE …``; values stand between commas or slashes, whole numbers may be
ranges: ``bits=2-6,8,cores=cores/fc1:6,window=25-100%:25``. Axes that it does not name keep their usual
value.
"""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.storage import MAX_PLANES
from spikeloom.compiler.targets.base import Target
from spikeloom.models.recordings.evtouch import WHOLE

FEWEST = "cores"
"""The layout of fewest cores."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Values of every axis, in the order in which they were given; each once."""

    bits: tuple[tuple[int, ...], ...] = (
        (2,),
        (3,),
        (4,),
        (5,),
        (6,),
        (8,),
    )  # For all layers, or one for each
    planes: tuple[int, ...] = (1,)  # Times that a synapse is stored
    groups: tuple[int, ...] = (1,)  # Scales in a layer
    prune: tuple[int, ...] = (
        0,
    )  # Whether neurons that never fired on training recordings are left out: 0 or 1
    cores: tuple[str, ...] = (FEWEST,)  # Or least cores as in ``fc1:6+conv1:4``
    window: tuple[int, ...] = (25, 50, 75, WHOLE)  # Per cent of each recording


AXES = tuple(axis.name for axis in fields(Grid))


def parse_grid(text: str, target: Target) -> Grid:
    """Read a grid; the chip says which widths it stores and how many thresholds a core holds.

    An OptionError names the value that cannot be understood, and what is allowed.
    """
    axis = ""
    values_of: dict[str, dict[Any, None]] = {}
    for word in re.split("[,/]", text):
        name, equals, value = (part.strip() for part in word.rpartition("="))
        if equals:
            if name not in AXES or name in values_of:
                raise OptionError(
                    f"--grid {name}: give each of {', '.join(AXES)} once, as in bits=2-6,8,planes=1-2"
                )
            axis = name
            values_of[name] = {}
        if not axis:
            raise OptionError(f"--grid {value}: belongs to no axis; begin with one, as in bits=2-6,8")
        reader, allowed = _readers(target)[axis]
        values = reader(value)
        if not values:
            raise OptionError(f"--grid {axis}={value}: allowed are {allowed}")
        values_of[axis] |= dict.fromkeys(values)
    return Grid(**{name: tuple(values) for name, values in values_of.items()})


def _readers(target: Target) -> dict[str, tuple[Callable[[str], Sequence[Any]], str]]:
    """What reads the values of each axis, with nothing for a value that is not allowed; and what is."""
    widths = sorted(target.choices["synapse.weight_bits"])
    slots = target.limit("core.threshold_slots")
    listed = ", ".join(map(str, widths))
    return {
        "bits": (
            lambda words: _widths(words, widths),
            f"{listed}, ranges, or a width for each layer as in 8+4+4+8",
        ),
        "planes": (lambda words: _numbers(words, range(1, MAX_PLANES + 1)), f"1 to {MAX_PLANES} planes"),
        "groups": (lambda words: _numbers(words, range(1, slots + 1)), f"1 to {slots} scale groups"),
        "prune": (lambda words: _numbers(words, range(2)), "0 (keep) and 1 (leave out)"),
        "cores": (_cores, f"{FEWEST}, or LAYER:N as in fc1:6+conv1:4, each layer once"),
        "window": (
            lambda words: _numbers(words, range(1, WHOLE + 1), 25),  # by quarters where a range does not say
            f"1 to {WHOLE} per cent, or ranges as in 25-100%:5",
        ),
    }


def _numbers(words: str, allowed: Collection[int], step: int = 1) -> list[int]:
    """A number, or of a range every so many, and its end; per cent signs are for people."""
    ends = re.fullmatch(r"([0-9]{1,3})%?(?:-([0-9]{1,3})%?(?::([0-9]{1,3})%?)?)?", words, re.ASCII)
    if ends is None:
        return []
    first = int(ends[1])
    last = int(ends[2] or ends[1])
    every = int(ends[3] or step)
    numbers = [*range(first, last, every), last] if first <= last and every else []
    return list(dict.fromkeys(numbers)) if set(numbers) <= set(allowed) else []


def _widths(words: str, allowed: Collection[int]) -> list[tuple[int, ...]]:
    """A width for all layers, a range of these, or one for each layer."""
    each = [_numbers(width, allowed) for width in words.split("+")]
    if len(each) == 1:
        return [(width,) for width in each[0]]
    widths = tuple(width for numbers in each for width in numbers)
    if any(len(numbers) != 1 for numbers in each):
        return []
    return [widths[:1] if len(set(widths)) == 1 else widths]


def _cores(words: str) -> list[str]:
    """The fewest cores, or least cores of some layers."""
    if words == FEWEST:
        return [words]
    parts = [re.fullmatch(r"([^:+]+):([1-9][0-9]{0,3})", part, re.ASCII) for part in words.split("+")]
    cores = {part[1]: part[2] for part in parts if part is not None}
    return (
        ["+".join(f"{layer}:{count}" for layer, count in cores.items())] if len(cores) == len(parts) else []
    )
