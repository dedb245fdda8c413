"""Options as they are typed: to get the same again, or to refuse what does not apply."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.targets import DEFAULT_TARGET
from spikeloom.compiler.types import JsonObject
from spikeloom.runtime.requests.fields import Request, has_default

NETWORK = ("graph", "taxels", "edges", "directed", "run", "weights", "beta", "theta")
"""Options that say how a checkpoint is read."""

INPUT_LAYOUT = ("polarities", "polarities_first")
"""Options that say how the input of a NIR or ONNX file is read."""

LAYOUT = (*INPUT_LAYOUT, "dt", "convention")
"""Those, and options of NIR files."""

ROUNDING = ("weight_bits", "planes", "scale_groups", "spike_exact", "prune_unused", "keep", "share_lists")
"""Options of ``compile`` that say how a float network is stored."""

PLACING = ("keep_all", "cores_for", "chips", "free_running")
"""Options of ``compile`` that say where integers go, and who resets them."""

USUAL: Mapping[str, object] = {
    "run": 0,
    "target": DEFAULT_TARGET,
    "chips": 1,
    "engine": "spikeloom",
    **dict.fromkeys(
        ("directed", "spike_exact", "prune_unused", "share_lists", "keep_all", "free_running"), False
    ),
}
"""What options are where they are not given; others are None."""


def words(options: Mapping[str, Any]) -> list[str]:
    """Options as they are typed; those that are None or False are omitted, as is what is usual.

    >>> words({"weight_bits": "4,8", "directed": True, "run": 0, "beta": 0.0, "planes": None, "bin": 0.02})
    ['--weight-bits', '4,8', '--directed', '--beta', '0.0', '--bin', '0.02']
    >>> words({"bin": 1 / 60})
    ['--bin', '0.016666666666666666']
    """
    typed: list[str] = []
    for name, value in options.items():
        if value is None or value is False or value in ((), USUAL.get(name, ())):
            continue
        if isinstance(value, tuple | list):
            typed += [word for each in value for word in words({name: each})]
            continue
        typed.append(f"--{name.replace('_', '-')}")
        if value is not True:
            typed.append(str(getattr(value, "source", value)))
    return typed


def given(request: Request, names: Sequence[str]) -> JsonObject:
    """Some options of a command, by name."""
    return {name: getattr(request, name) for name in names}


def typed(request: Request, names: Sequence[str]) -> list[str]:
    """Options of a request as they are typed, those that are not as usual."""
    known = {each.name: each.metadata["constants"] for each in request.options()}
    line: list[str] = []
    for name in names:
        value = getattr(request, name, None)
        constants = known.get(name) or {}
        flags = [flag for flag, (meaning, _) in constants.items() if value is meaning]
        line += flags or words({name: value})
    return line


def refuse(request: Request, names: Sequence[str], why: str) -> None:
    """Refuse options that are given although they do not apply; OptionError naming the first of them."""
    usual = {each.name: each.default for each in request.options() if has_default(each)}
    for name in names:
        line = typed(request, [name])
        if line and getattr(request, name) != usual.get(name):
            raise OptionError(f"{' '.join(line)}: {why}; omit it")


def command(*typed: str) -> str:
    """A command line.

    >>> command("run", "a b.loom")
    "spikeloom run 'a b.loom'"
    """
    return shlex.join(["spikeloom", *typed])
