"""Pieces of an HTML page: tables, figures with their numbers, paragraphs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], *, left: bool = False) -> str:
    """A table with a caption; the first cell of a row is its heading.

    Parameters
    ----------
    caption : str
        What it shows.
    head : sequence of str
        Names of the columns.
    rows : iterable of sequence of str
        Plain text.
    left : bool
        Of words, not of numbers.

    Examples
    --------
    >>> table("spikes", ["layer", "n"], [["fc1", "3"]]).count("<th")
    4
    """
    above = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>'
        for row in rows
    )
    kind = ' class="left"' if left else ""
    return (
        f'<div class="table"><table{kind}>'
        f"<caption>{escape(caption)}</caption><thead><tr>{above}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def figure(drawing: str, caption: str, numbers: str = "", *, raster: str | None = None) -> str:
    """What is said of a figure, the figure, a line for values under the pointer, and its numbers to unfold."""
    below = unfold("Numbers of this figure", numbers) if numbers else ""
    kind = "" if raster is None else f' data-raster="{escape(raster)}"'
    return (
        f'<figure{kind}><figcaption>{escape(caption)}</figcaption>{drawing}<output class="readout"></output>'
        f"{below}</figure>"
    )


def unfold(title: str, content: str) -> str:
    """Something to open."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def facts(found: Mapping[str, tuple[str, str]]) -> str:
    """Key figures: name to value and what is said of it."""
    items = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}<small>{escape(note)}</small></dd></div>"
        for name, (value, note) in found.items()
    )
    return f'<dl class="facts">{items}</dl>'


def section(name: str, title: str, content: Iterable[str]) -> str:
    """A section with its heading."""
    heading = f'<h2 id="{name}-h">{escape(title)}</h2>'
    return f'<section id="{name}" aria-labelledby="{name}-h">{heading}{"".join(content)}</section>'
