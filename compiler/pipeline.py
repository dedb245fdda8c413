"""A compilation is a list of passes; what the list is, every target says for itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar


class Work(Protocol):
    """What passes hand on: all that was made so far."""

    @property
    def newest(self) -> Any:
        """What the last pass made that changed anything, which :func:`formats.text.text` prints."""

    def verify(self) -> None:
        """Check every rule of that; VerifyError if a pass broke one."""


W = TypeVar("W", bound=Work)

LATER: Any = None
"""Of a field of the work that a pass fills in."""


Pass = Callable[[W], W]
"""One step of a compilation: new work of what it is given, which stays as it is. What each keeps: docs/compile.md."""


def name_of(step: Callable[..., Any]) -> str:
    """Name of a pass, for ``--dump-after`` and the table in docs/compile.md: that of the function."""
    return step.__name__.strip("_")


def run(passes: Iterable[Pass[W]], work: W, after: Callable[[str, W], object] | None = None) -> W:
    """Apply passes in order and verify what each one made; `after` gets the name of each and its work."""
    for each in passes:
        work = each(work)
        work.verify()
        if after is not None:
            after(name_of(each), work)
    return work
