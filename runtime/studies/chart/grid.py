"""What ``--grid`` says: axes and their values, or where exactly it cannot be understood.

A grid is ``AXIS=VALUE,VALUE,AXIS=VALUE …``; values stand between commas or slashes, whole numbers may be ranges:
``bits=2-6,8,graph=manual/knn:1,window=25-100%:25``. Axes that it does not name keep their usual value.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spikeloom.compiler import GOALS, MAX_PLANES
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets.base import Target
from spikeloom.models.recordings.windows import WHOLE

WINDOW_STEP = 25
"""Per cent between the windows of a range that does not say."""

MOST = 100_000
"""Points that a grid may have for each checkpoint."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Values of every axis, in the order in which they were given; each once."""

    # Storage widths: one number for all layers, or one for each
    bits: tuple[tuple[int, ...], ...] = ((2,), (3,), (4,), (5,), (6,), (8,))
    # planes, groups: Times that a synapse is stored, and scales in a layer
    planes: tuple[int, ...] = (1,)
    groups: tuple[int, ...] = (1,)
    prune: tuple[int, ...] = (0,)  # Whether neurons that never fired on training recordings are left out: 0 or 1
    # What the layout is for, as ``--optimize`` names it, or least cores as in ``fc1:6+conv1:4``
    cores: tuple[str, ...] = ("cores",)
    window: tuple[int, ...] = (25, 50, 75, WHOLE)  # Per cent of each recording
    graph: tuple[str, ...] = ()  # Graphs that networks were trained on; empty: of all that are given


class _BadValueError(Exception):
    """What is wrong, and at which character of the value."""

    def __init__(self, offset: int, text: str) -> None:
        self.offset, self.text = offset, text
        super().__init__(text)


def parse_grid(text: str, target: Target) -> Grid:
    """Read a grid.

    Parameters
    ----------
    text : str
        As typed.
    target : Target
        Chip, for the widths that it stores and the thresholds that a core holds.

    Raises
    ------
    OptionError
        Of three lines: what is wrong, the grid, and a caret under the character.

    Examples
    --------
    >>> from spikeloom.compiler import DEFAULT_TARGET
    >>> from spikeloom.compiler.targets.base import load_target
    >>> found = parse_grid("bits=2-3,8+4+4+8,window=50-100%", load_target(DEFAULT_TARGET))
    >>> found.bits, found.window
    (((2,), (3,), (8, 4, 4, 8)), (50, 75, 100))
    """
    if not text.strip():
        raise OptionError("--grid: is empty; name an axis as in bits=2-6,8, or omit --grid")
    readers = _readers(target)
    found: dict[str, dict[Any, None]] = {}
    axis: str | None = None
    for start, part in _parts(text):
        value, at = part, start
        if "=" in part:
            name, _, value = part.partition("=")
            axis, at = name.strip(), start + len(name) + 1
            if axis not in readers:
                where = start + len(name) - len(name.lstrip())
                raise _error(text, where, f"{axis!r} is no axis; axes are {', '.join(readers)}")
            if axis in found:
                raise _error(text, start, f"{axis} is given twice; write all its values after one {axis}=")
            found[axis] = {}
        if axis is None:
            raise _error(text, start, f"{part.strip()!r} belongs to no axis; begin with one, as in bits=2-6,8")
        at += len(value) - len(value.lstrip())
        if not value.strip():
            raise _error(text, at, f"{axis} has an empty value; write one, or take the separator away")
        try:
            found[axis] |= dict.fromkeys(readers[axis](value.strip()))
        except _BadValueError as fault:
            raise _error(text, at + fault.offset, fault.text) from None
    grid = Grid(**{name: tuple(values) for name, values in found.items()})
    points = len(grid.bits) * len(grid.planes) * len(grid.groups) * len(grid.prune) * len(grid.cores) * len(grid.window)
    if points > MOST:
        raise OptionError(f"--grid: {points:,} points a network, allowed are {MOST:,}; give fewer values")
    return grid


def axes(target: Target) -> tuple[str, ...]:
    """Names of all axes."""
    return tuple(_readers(target))


def _parts(text: str) -> list[tuple[int, str]]:
    """What stands between commas and slashes, with where it begins."""
    return [(match.start(), match[0]) for match in re.finditer(r"[^,/]+|(?<=[,/])(?=[,/]|$)|^(?=[,/])", text)]


def _error(text: str, at: int, what: str) -> OptionError:
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    return OptionError(f"--grid, character {at + 1}: {what}\n  {shown}\n  {' ' * at}^")


# -- values ------------------------------------------------------------------------------------------------------------

Reader = Callable[[str], Sequence[Any]]


def _readers(target: Target) -> Mapping[str, Reader]:
    """What reads the values of each axis."""
    widths = sorted(target.choices["synapse.weight_bits"])
    slots = target.limit("core.threshold_slots")
    return {
        "bits": lambda words: _widths(words, widths),
        "planes": lambda words: _numbers(words, range(1, MAX_PLANES + 1), "a number of planes"),
        "groups": lambda words: _numbers(words, range(1, slots + 1), "a number of scale groups"),
        "prune": lambda words: _numbers(words, range(2), "0 (keep) or 1 (leave out)"),
        "cores": _cores,
        "window": _windows,
        "graph": lambda words: [words],
    }


def _number(words: str, offset: int, allowed: Sequence[int], what: str) -> int:
    if not (words.isascii() and words.isdecimal() and len(words) < 10):
        raise _BadValueError(offset, f"{words!r} is not {what}; allowed: {_listed(allowed)}")
    if int(words) not in allowed:
        raise _BadValueError(offset, f"{int(words)} is not {what}; allowed: {_listed(allowed)}")
    return int(words)


def _listed(allowed: Sequence[int]) -> str:
    if len(allowed) > 2 and allowed[-1] - allowed[0] == len(allowed) - 1:
        return f"{allowed[0]} to {allowed[-1]}"
    return ", ".join(map(str, allowed))


def _range(words: str, allowed: Sequence[int], what: str) -> tuple[int, int] | None:
    """Both ends of a range; None where there is no dash."""
    low, dash, high = words.partition("-")
    if not dash:
        return None
    first = _number(low, 0, allowed, what)
    last = _number(high, len(low) + 1, allowed, what)
    if last < first:
        raise _BadValueError(0, f"{words!r} runs backwards; write {last}-{first}")
    return first, last


def _numbers(words: str, allowed: Sequence[int], what: str) -> list[int]:
    ends = _range(words, allowed, what)
    if ends is None:
        return [_number(words, 0, allowed, what)]
    found = list(range(ends[0], ends[1] + 1))
    for value in found:
        if value not in allowed:
            raise _BadValueError(0, f"{words!r} holds {value}, which is not {what}; allowed: {_listed(allowed)}")
    return found


def _widths(words: str, allowed: Sequence[int]) -> list[tuple[int, ...]]:
    what = "a width that the chip stores"
    if "+" not in words:
        return [(value,) for value in _numbers(words, allowed, what)]
    found, offset = [], 0
    for part in words.split("+"):
        found.append(_number(part, offset, allowed, what))
        offset += len(part) + 1
    return [(found[0],) if len(set(found)) == 1 else tuple(found)]


def _windows(words: str) -> list[int]:
    allowed, what = range(1, WHOLE + 1), "a part in per cent"
    body, colon, step = words.partition(":")
    bare = body.removesuffix("%")
    low, dash, high = bare.partition("-")
    if low.endswith("%"):
        low = low[:-1]
    if not dash:
        if colon:
            raise _BadValueError(len(body), f"{words!r} is no range, so it has no step; write {bare}%")
        return [_number(low, 0, allowed, what)]
    first = _number(low, 0, allowed, what)
    last = _number(high, bare.index("-") + 1, allowed, what)
    by = _number(step.removesuffix("%"), len(body) + 1, allowed, "a step in per cent") if colon else WINDOW_STEP
    if last < first:
        raise _BadValueError(0, f"{words!r} runs backwards; write {last}-{first}%")
    return list(dict.fromkeys([*range(first, last, by), last]))


def _cores(words: str) -> list[str]:
    if words in GOALS:
        return [words]
    if ":" not in words:
        raise _BadValueError(0, f"{words!r} is no layout; allowed: {', '.join(GOALS)}, or LAYER:N as in fc1:6+conv1:4")
    offset, seen = 0, dict[str, int]()
    for part in words.split("+"):
        layer, _, count = part.partition(":")
        if not layer:
            raise _BadValueError(offset, f"{part!r} names no layer; write LAYER:N as in fc1:6")
        if layer in seen:
            raise _BadValueError(offset, f"{layer} is given twice; give it once")
        seen[layer] = _number(count, offset + len(layer) + 1, range(1, 10_000), "a number of cores")
        offset += len(part) + 1
    return ["+".join(f"{layer}:{count}" for layer, count in seen.items())]
