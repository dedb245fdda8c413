"""A compilation is a series of passes; which they are, every target says for itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar


class Work(Protocol):
    """What passes hand on: all that was made so far."""

    def verify(self) -> None:
        """Check every rule of the newest artefact; VerifyError if a pass broke one."""

    def text(self) -> str:
        """The newest artefact in print; equal text means equal content."""


W = TypeVar("W", bound=Work)


Passes = Mapping[str, Callable[[W], W]]
"""Passes by name, in their order; each makes new work of what it is given, which stays as it is."""


def run(passes: Passes[W], work: W, after: Callable[[str, W], Any] | None = None) -> W:
    """Apply passes in order and verify what each one made; `after` gets the name of each and its work."""
    for name, apply in passes.items():
        work = apply(work)
        work.verify()
        if after is not None:
            after(name, work)
    return work
