"""What a result has to say, laid out once: sections of text, tables, figures and commands; and these as text.

A study returns a frozen dataclass; a function beside it turns that into sections. :func:`terminal` prints
them, :mod:`report.html` makes a page of them. The first heading of a table is its name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from spikeloom.compiler.files import plain

if TYPE_CHECKING:
    from spikeloom.runtime.report.drawing import Drawing


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph; a line break in it stays one."""

    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as people read them; all columns but the first are right-aligned, unless they hold words.

    A terminal shows the first `most` rows, if that is given: none of them for 0. The caption is for pages.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    words: bool = False
    most: int | None = None

    def __str__(self) -> str:
        return _aligned(self)


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture by :mod:`report.drawing` and its numbers; text shows the numbers only.

    It is drawn when a page needs it. The name is its id on the page.
    """

    name: str
    draw: Callable[[], Drawing]
    caption: str
    numbers: Sequence[Table] = ()


@dataclass(frozen=True, slots=True)
class Facts:
    """Key figures for the eye: name to value and a note about it; for pages, since the text says the same."""

    values: Mapping[str, tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Code:
    """Commands to type."""

    lines: Sequence[str]


@dataclass(frozen=True, slots=True)
class Details:
    """Something to unfold on a page; terminals leave it out. Of those in one `group` one is unfolded at a time."""

    title: str
    blocks: Sequence[Block]
    group: str = ""
    unfolded: bool = False


@dataclass(frozen=True, slots=True)
class Section:
    """Blocks under one title; terminals print the title only of a chapter."""

    title: str
    blocks: Sequence[Block]
    chapter: bool = False


Block = Text | Table | Figure | Facts | Code | Details | Section


LAYOUTS: dict[type, Callable[[Any], Iterable[Section]]] = {}
"""What lays out results of a class, known as soon as there is one, see :mod:`report.shown`."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a command has found: a result that :mod:`report.encode` can encode, its layout, and the exit code."""

    result: Any
    sections: Callable[[Any], Iterable[Section]]
    code: int = 0

    def __post_init__(self) -> None:
        """Let the result show itself."""
        LAYOUTS[type(self.result)] = self.sections


def terminal(sections: Iterable[Section]) -> str:
    """Plain text: the blocks of a section line by line, an empty line between sections.

    >>> spikes = Table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3456"], ["fc2", "7"]], most=2)
    >>> print(terminal([Section("Spikes", [Text("of 3 recordings"), spikes], chapter=True)]))
    Spikes
    ------
    of 3 recordings
      layer  spikes
      conv1      12
      fc1      3456
      … and 1 more
    """
    return "\n\n".join(filter(None, map(_printed, sections)))


def _printed(section: Section) -> str:
    """A section with those in it, which stand apart."""
    parts: list[str] = []
    apart = True
    for block in section.blocks:
        text = _plain(block)
        if not text:
            continue
        if apart or isinstance(block, Section):
            parts.append(text)
        else:
            parts[-1] += f"\n{text}"
        apart = isinstance(block, Section)
    if section.chapter and parts:
        parts[0] = f"{section.title}\n{'-' * len(section.title)}\n{parts[0]}"
    return "\n\n".join(parts)


def _plain(block: Block) -> str:  # noqa: PLR0911 - one for each kind
    match block:
        case Text(text):
            return text
        case Table(rows=rows, most=most):
            if most == 0 or not block.head:
                return ""
            left = 0 if most is None else len(rows) - most
            return _aligned(block) + (f"\n  … and {left:,} more" if left > 0 else "")
        case Figure(numbers=numbers):
            return "\n\n".join(filter(None, map(_plain, numbers)))
        case Code(lines):
            return "\n".join(f"$ {line}" for line in lines)
        case Section():
            return _printed(block)
        case _:
            return ""


def _aligned(table: Table) -> str:
    lines = [
        [plain(cell).replace("\n", " ") for cell in line] for line in (table.head, *table.rows[: table.most])
    ]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 or table.words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
