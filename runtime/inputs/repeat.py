"""What to type to get the same again."""

from __future__ import annotations

import argparse
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from spikeloom.compiler import DEFAULT_TARGET
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.events import BIN_S

NETWORK = ("graph", "taxels", "edges", "directed", "system", "run", "weights", "beta", "theta")
"""Options that say how a checkpoint is read."""


def words(options: Mapping[str, Any]) -> list[str]:
    """Options as they are typed; those that are None or False are omitted, as is what is usual.

    Examples
    --------
    >>> words({"weight_bits": "4,8", "directed": True, "run": 0, "beta": 0.0, "planes": None, "bin": 0.02})
    ['--weight-bits', '4,8', '--directed', '--beta', '0.0']
    """
    typed: list[str] = []
    for name, value in options.items():
        usual = (name == "run" and value == 0) or (name == "bin" and math.isclose(value, BIN_S))
        usual |= name == "target" and value == DEFAULT_TARGET
        if value is None or value is False or usual:
            continue
        typed.append(f"--{name.replace('_', '-')}")
        if value is not True:
            typed.append(f"{value:g}" if name == "bin" else str(value))
    return typed


def given(arguments: argparse.Namespace, names: Sequence[str]) -> JsonObject:
    """Some options of a command, by name."""
    return {name: getattr(arguments, name) for name in names}


def command(*typed: str) -> str:
    """A command line.

    Examples
    --------
    >>> command("run", "a b.loom")
    "spikeloom run 'a b.loom'"
    """
    return shlex.join(["spikeloom", *typed])
