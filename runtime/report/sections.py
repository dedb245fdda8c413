"""What a result has to say, laid out once: sections of text, tables and figures, and three small renderers.

A study returns a frozen dataclass; a function beside it turns that into sections. The first heading of a table is its
name. :func:`terminal` joins what stands in one section line by line and leaves an empty line between sections.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph; a line break in it stays one on the terminal."""

    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as people read them; all columns but the first are right-aligned, unless they hold words."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    words: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """An SVG drawing and its numbers; terminal and Markdown show the numbers only."""

    svg: str
    caption: str
    numbers: Table | None = None


Block = Text | Table | Figure


@dataclass(frozen=True, slots=True)
class Section:
    """Blocks under one title; the title is for pages and Markdown."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a command has found: a result that :mod:`report.json` can encode, its layout, and the exit code."""

    result: Any
    sections: Callable[[Any], Iterable[Section]]
    code: int = 0


def terminal(sections: Iterable[Section]) -> str:
    """Plain text.

    Examples
    --------
    >>> spikes = Table(["layer", "spikes"], [["conv1", "12"], ["fc1", "3456"]])
    >>> print(terminal([Section("Spikes", [Text("of 3 recordings"), spikes])]))
    of 3 recordings
      layer  spikes
      conv1      12
      fc1      3456
    """
    return "\n\n".join("\n".join(_plain(block) for block in section.blocks) for section in sections if section.blocks)


def _plain(block: Block) -> str:
    match block:
        case Text(text):
            return text
        case Table(head, rows, words=words):
            return _aligned([head, *rows], words=words)
        case Figure(numbers=numbers, caption=caption):
            return caption if numbers is None else _plain(numbers)


def _aligned(lines: Sequence[Sequence[str]], *, words: bool) -> str:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 or words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown(sections: Iterable[Section]) -> str:
    """Markdown with a heading for each titled section.

    Examples
    --------
    >>> print(markdown([Section("", [Table(["layer", "spikes"], [["fc1", "3"]])])]))
    | layer | spikes |
    |---|---:|
    | fc1 | 3 |
    """
    parts = []
    for section in sections:
        parts += [f"## {section.title}"] if section.title else []
        parts += [_marked(block) for block in section.blocks]
    return "\n\n".join(parts)


def _marked(block: Block) -> str:
    match block:
        case Text(text):
            return text
        case Table(head, rows, words=words):
            ruler = "|".join(["---", *(["---" if words else "---:"] * (len(head) - 1))])
            lines = [f"| {' | '.join(head)} |", f"|{ruler}|", *(f"| {' | '.join(row)} |" for row in rows)]
            return "\n".join(lines)
        case Figure(numbers=numbers, caption=caption):
            return caption if numbers is None else f"{caption}\n\n{_marked(numbers)}"


def html(sections: Iterable[Section]) -> str:
    """Fragments of a page, one ``<section>`` each; the page's frame and style are :mod:`runtime.page`'s.

    Examples
    --------
    >>> html([Section("Spikes", [Text("3 < 4")])])
    '<section id="spikes"><h2>Spikes</h2><p>3 &lt; 4</p></section>'
    """
    return "".join(
        f'<section id="{"-".join(section.title.lower().split())}"><h2>{escape(section.title)}</h2>'
        f"{''.join(map(_tagged, section.blocks))}</section>"
        for section in sections
    )


def _tagged(block: Block) -> str:
    match block:
        case Text(text):
            return f"<p>{'<br>'.join(map(escape, text.splitlines()))}</p>"
        case Table(head, rows, caption, words):
            above = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
            below = "".join(
                f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}'
                "</tr>"
                for row in rows
            )
            said = f"<caption>{escape(caption)}</caption>" if caption else ""
            kind = ' class="left"' if words else ""
            return f"<table{kind}>{said}<thead><tr>{above}</tr></thead><tbody>{below}</tbody></table>"
        case Figure(svg, caption, numbers):
            unfold = "" if numbers is None else f"<details><summary>Numbers</summary>{_tagged(numbers)}</details>"
            said = f"<figcaption>{escape(caption)}</figcaption>"
            return f'<figure>{said}{svg}<output class="readout"></output>{unfold}</figure>'
