"""A compilation is a list of passes; what the list is, every target says for itself."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar


class Work(Protocol):
    """What passes hand on: all that was made so far."""

    @property
    def newest(self) -> Any:
        """What the last pass made that changed anything, which :func:`formats.text.text` prints."""

    def verify(self) -> None:
        """Check every rule of that; VerifyError if a pass broke one."""


W = TypeVar("W", bound=Work)

LATER: Any = None
"""Value of a field of the work until a pass fills it in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass(Generic[W]):
    """One step of a compilation."""

    name: str  # For ``--dump-after`` and the table in docs/compile.md
    does: str  # Its contract in one sentence
    keeps: str  # What is the same before and after it
    apply: Callable[[W], W]  # Makes new work of what it is given, which stays as it is


def step(does: str, *, keeps: str) -> Callable[[Callable[[W], W]], Pass[W]]:
    """Make a function the pass of its name; `does` and `keeps` as of :class:`Pass`."""
    return lambda apply: Pass(name=apply.__name__.strip("_"), does=does, keeps=keeps, apply=apply)


def run(passes: Iterable[Pass[W]], work: W, after: Callable[[str, W], object] | None = None) -> W:
    """Apply passes in order and verify what each one made; `after` gets the name of each and its work."""
    for each in passes:
        work = each.apply(work)
        work.verify()
        if after is not None:
            after(each.name, work)
    return work
