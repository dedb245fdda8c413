"""How far a long work is, for programs: lines of JSON on standard error, where they are wanted."""

import json
import os
import sys

from spikeloom.compiler.errors import OptionError

FORM = "SPIKELOOM_PROGRESS"
"""Variable of the environment, so that processes that a work starts know it, too; ``--progress`` sets it."""

LINES = "json"


def lines_wanted() -> bool:
    """Whether progress is for a program."""
    return os.environ.get(FORM) == LINES


def require_form() -> None:
    """Refuse another form than that; an OptionError."""
    if (form := os.environ.get(FORM, "")) not in ("", LINES):
        raise OptionError(f"{FORM}={form}: no form of progress; allowed is {LINES}, or unset it")


def say(label: str, **numbers: float | None) -> None:
    """Say what is being done and how far it is: ``done`` of ``total``, ``left_s`` more seconds; None is not said."""
    if lines_wanted():
        known = {name: number for name, number in numbers.items() if number is not None}
        sys.stderr.write(json.dumps({"label": label} | known) + "\n")
        sys.stderr.flush()
