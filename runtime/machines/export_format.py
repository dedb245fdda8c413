"""What a machine says of a format of another program that it can write."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from spikeloom.models.recordings.evtouch import Recordings


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What a format is written from; options that were not given are None.

    Parameters
    ----------
    source, output : str
        File of the network, and the one to be written.
    recordings : callable, optional
        Reads recordings for a network of some classes, taxels and bins of a step, where a format has a use for them.
    recording : int, optional
        Which of them.
    form : str, optional
        Which form of the format.
    dt : float, optional
        Seconds of a step.
    strict : bool
        Whether to write nothing that had to be rounded.
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
    """Content of a file, a dataclass of facts about it with ``neurons``, and lines of them for people.

    `form` is which of several forms of the format it has.
    """

    content: Iterable[bytes]
    facts: Any
    synapses: int | None
    form: str | None = None
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format by its name on the command line.

    Parameters
    ----------
    name, title : str
        Value of ``--to``, and what it is.
    write : callable
        Raises OptionError and ModelError where the format cannot hold the network.
    options : tuple of str
        Options that it takes beside the network.
    """

    name: str
    title: str
    write: Callable[[Request], Export]
    options: tuple[str, ...] = ()
