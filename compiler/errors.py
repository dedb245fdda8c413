"""The error tree: one base, one child per party that must act.

Every message is *where: what was found, what is allowed; what to do*, on one line. The command line prints
it and exits with 2; nothing here carries a traceback to a user.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


class SpikeloomError(Exception):
    """Base of everything that a user can cause and fix."""


class ModelError(SpikeloomError):
    """The checkpoint, its graph or its options cannot be used: the user fixes the model."""


class DataError(SpikeloomError):
    """The recordings cannot be used: the user fixes the data."""


class OptionError(SpikeloomError):
    """An option has a value that does not exist: the user fixes the command."""


def require_least(values: Mapping[str, Any], **least: int) -> None:
    """Refuse numbers that are less than their options allow, where they are given; OptionError."""
    for name, lowest in least.items():
        if values[name] is not None and values[name] < lowest:
            option = f"--{name.replace('_', '-')} {values[name]}"
            raise OptionError(f"{option}: allowed are {lowest} or more; choose another")


class FormatError(SpikeloomError):
    """A netlist file is truncated, altered or from another version."""


class NumericRangeError(SpikeloomError):
    """A chip register would overflow: the simulation stops instead of inventing a value."""


class UnfinishedError(SpikeloomError):
    """Work of several parts ended without some of them: nothing is wrong with what the user gave; exit code 1.

    The message says what is missing and what is kept.
    """


class VerifyError(Exception):
    """A network broke a rule of the intermediate representation: a defect of ours, never of the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Violation:
    """One limit that a network breaks."""

    owner: str  # Who breaks it, for example ``core 3 (fc1)``
    rule: str  # Name of the limit in the target file, the chip's before it: ``CHIP.core.axons_in``
    # used, allowed: What was found and what is allowed: amounts, or words where the rule is no amount
    used: int | str
    allowed: int | str
    remedy: str  # What would make it fit

    def __str__(self) -> str:
        used = f"{self.used} used" if isinstance(self.used, int) else self.used
        return f"{self.owner}: {used}, {self.allowed} allowed ({self.rule}); {self.remedy}"


class CapacityError(SpikeloomError):
    """A network does not fit the chip; holds every violation, not the first."""

    def __init__(self, violations: tuple[Violation, ...]) -> None:
        self.violations = violations
        super().__init__("\n".join(str(violation) for violation in violations))

    def __reduce__(self) -> tuple[type[CapacityError], tuple[tuple[Violation, ...]]]:
        return type(self), (self.violations,)  # not of its text, as exceptions usually are
