"""Sections as a page: one HTML file that needs nothing else, the same bytes for the same sections."""

from collections.abc import Iterable
from importlib import resources
from typing import Any

from spikeloom.compiler.files import plain
from spikeloom.runtime.report.sections import Section


def page(title: str, about: str, sections: Iterable[Section]) -> str:
    """A whole page: its heading, a sentence below it, and chapters that it links to; each has a title."""
    from spikeloom.compiler import __version__

    files = resources.files("spikeloom.runtime.report")
    template = _environment().get_template("page.html")
    rendered: str = template.render(
        title=title,
        about=about,
        sections=list(sections),
        style=files.joinpath("page.css").read_text("utf-8"),
        script=files.joinpath("page.js").read_text("utf-8"),
        version=__version__,
    )
    return rendered


def _environment() -> Any:
    from jinja2 import (
        Environment,
        PackageLoader,
        StrictUndefined,
    )  # a tenth of a second that other commands save

    environment = Environment(
        loader=PackageLoader("spikeloom.runtime.report", "."),
        autoescape=True,
        finalize=lambda value: plain(value) if type(value) is str else value,  # not what is marked as safe
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["anchor"] = anchor
    environment.tests["kind"] = lambda block, name: type(block).__name__ == name
    return environment


def fragment(section: Section) -> str:
    """A section alone."""
    blocks = _environment().get_template("blocks.html").module
    return str(blocks.show(section, 3))


def anchor(title: str) -> str:
    """Id of a chapter.

    >>> anchor("Energy and time")
    'energy-and-time'
    """
    return "-".join(title.lower().split())
