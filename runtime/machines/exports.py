"""Formats of other programs that netlists can be written in."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from spikeloom.runtime.requests.exchange import ExportRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What a file of any format holds."""

    neurons: int
    synapses: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Export:
    """Content of a file, facts about it, and lines for people.

    `form` is which of several forms of the format it has.
    """

    content: Iterable[bytes]
    facts: Facts
    form: str | None = None
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format by its name on the command line.

    name, title: value of ``--to``, and what it is.
    write: raises OptionError and ModelError where the format cannot hold the network.
    options: options that it takes beside the network.
    whole: whether it also holds the neurons that the compiler left out.
    ending: of its files, where that is not its name.
    """

    name: str
    title: str
    write: Callable[[ExportRequest], Export]
    options: tuple[str, ...] = ()
    whole: bool = False
    ending: str = ""
