"""The pages as a site with search: ``sphinx-build -W -c docs . build/html``.

Its files lie as those of the repository do, so links between pages hold in both.
"""

import argparse
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import indent

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))
os.environ["COLUMNS"] = "84"  # of what --help prints

project = "spikeloom"
root_doc = "docs/contents"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "docs/*",
    "models/pretrained/README.md",
    "benchmarks/README.md",
    "benchmarks/results/paper/*.md",
    "examples/touch.ipynb",
]

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb"]
myst_heading_anchors = 4
nb_execution_mode = "off"
autodoc_typehints = "none"  # parameters say their types
napoleon_use_rtype = False

add_module_names = False  # as long as a narrow screen is wide
smartquotes = False  # options begin with two dashes
html_theme = "sphinx_book_theme"
html_title = project
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "use_download_button": False,
    "show_toc_level": 2,
    "navbar_persistent": [],
    "footer_content_items": [],
}


def commands() -> Iterator[str]:
    """What each command says of itself and its options."""
    from spikeloom.runtime.cli import build_parser

    (below,) = (
        action for action in build_parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    for name, parser in below.choices.items():
        shown = indent(parser.format_help(), "   ")
        yield f"\n{name}\n{'-' * len(name)}\n\n.. code-block:: text\n\n{shown}\n"


def add_commands(_site: Sphinx, name: str, source: list[str]) -> None:
    """Complete the page of commands."""
    if name == "docs/commands":
        source[0] += "".join(commands())


def list_fields(
    _site: Sphinx, what: str, _name: str, _thing: object, _more: object, lines: list[str]
) -> None:
    """Show what a class says of its fields, ``name: text``, as a list."""
    if what == "class":
        text = re.sub(r"^(\w+(?:, \w+)*): ", r"``\1``\n    ", "\n".join(lines), flags=re.MULTILINE)
        lines[:] = text.split("\n")


def first_page(site: Sphinx, _error: Exception | None) -> None:
    """README comes first."""
    written = Path(site.outdir)
    shutil.copy(written / "README.html", written / "index.html")


def setup(site: Sphinx) -> None:
    """What Sphinx asks for."""
    site.connect("source-read", add_commands)
    site.connect("autodoc-process-docstring", list_fields)
    site.connect("build-finished", first_page)
