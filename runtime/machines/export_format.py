"""What a machine says of a format of another program that it can write."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from spikeloom.models.recordings.evtouch import Recordings


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What a format is written from; options that were not given are None.

    source, output: file of the network, and the one to be written.
    recordings: reads recordings for a network of some classes, taxels and bins of a step, where a format has a use
        for them.
    recording: which of them.
    form: which form of the format.
    dt: seconds of a step.
    strict: whether to write nothing that had to be rounded.
    """

    source: str
    output: str
    recordings: Callable[[int, int, int], Recordings] | None = None
    recording: int | None = None
    form: str | None = None
    dt: float | None = None
    strict: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Export:
    """Content of a file, a dataclass of facts about it with ``neurons`` and ``synapses``, and lines for people.

    `form` is which of several forms of the format it has.
    """

    content: Iterable[bytes]
    facts: Any
    form: str | None = None
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format by its name on the command line.

    name, title: value of ``--to``, and what it is.
    write: raises OptionError and ModelError where the format cannot hold the network.
    options: options that it takes beside the network.
    """

    name: str
    title: str
    write: Callable[[Request], Export]
    options: tuple[str, ...] = ()
