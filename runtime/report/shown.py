"""Results as people meet them in Python: printed whole, short at a prompt, tables in a notebook, JSON on request."""

from __future__ import annotations

import json
from collections.abc import Iterable

from spikeloom.runtime.report.encode import encode
from spikeloom.runtime.report.html import fragment
from spikeloom.runtime.report.sections import LAYOUTS, Section, terminal

BRIEF = 8
"""Lines of a result that a prompt shows."""


class Shown:
    """A result that shows itself as its command prints it."""

    __slots__ = ()

    def sections(self) -> Iterable[Section]:
        """What it says, laid out."""
        return LAYOUTS[type(self)](self)

    def to_json(self) -> str:
        """What ``--json`` prints."""
        return json.dumps(encode(self))

    def __str__(self) -> str:
        """All of it, as on a terminal."""
        return terminal(self.sections())

    def __repr__(self) -> str:
        """The first lines; ``print`` shows all."""
        first = str(self).split("\n\n", 1)[0].splitlines()
        return "\n".join(first[:BRIEF] + ["…"] * (len(first) > BRIEF))

    def _repr_html_(self) -> str:
        """What notebooks show."""
        return "".join(map(fragment, self.sections()))
